"""Tests of the installation by `make`: consistent locks, uv or pip, and type checkers."""

import os
import re
import subprocess
import sys
import tomllib
from itertools import chain
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
INSTALL = ROOT / "tools/install"


def names_of(requirements):
    return [re.split(r"[<>=;\[ ]", requirement)[0] for requirement in requirements]


def locked(path):
    """Version and hashes of each package of a lock; each has a hash at least."""
    text = path.read_text()
    assert "://" not in text
    versions = {}
    if text.startswith("-r "):
        first, _, text = text.partition("\n")
        versions = locked(path.with_name(first.removeprefix("-r ")))
    hashed = r"((?:\\\n    --hash=sha256:[0-9a-f]{64} ?)+)"
    entries = re.findall(rf"^([\w.-]+)(?:\[.*\])?==(\S+).*?{hashed}$", text, re.M)
    assert len(entries) == len(re.findall(r"^\S", text, re.M))
    return versions | {name: f"{version} {hashes}" for name, version, hashes in entries}


def test_every_dependency_has_a_reason_and_is_locked():
    read = tomllib.loads((ROOT / "pyproject.toml").read_text())
    project, groups = read["project"], read["dependency-groups"]
    extras, runtime = project["optional-dependencies"], project["dependencies"]
    lab, viewers = (
        tomllib.loads((ROOT / folder / "pyproject.toml").read_text())["project"]["dependencies"]
        for folder in ("lab", "viewers")
    )
    reasons = (ROOT / "docs/dependencies.md").read_text()
    named = names_of([*runtime, *lab, *viewers, *chain(*extras.values(), *groups.values())])
    assert [name for name in named if name not in reasons] == []
    running = [line for line in runtime if not line.startswith("open3d")]
    wanted = {
        "requirements.lock": running + extras["build"] + extras["ros"],
        "requirements-lab.lock": running + lab + viewers,
        "requirements-dev.lock": runtime + extras["dev"] + lab + viewers,
        "requirements-tools.lock": groups["tools"],
        "requirements-uv.lock": groups["uv"],
    }
    locks = {name: locked(ROOT / name) for name in wanted}
    ours = {"sceneprint", "sceneprint-client"}  # installed from this checkout
    for name, requirements in wanted.items():
        assert set(names_of(requirements)) - ours <= set(locks[name]), name
    assert locks["requirements-lab.lock"].items() <= locks["requirements-dev.lock"].items()
    served = set(locks["requirements.lock"])
    assert {"open3d", "pytest", "uv", "embreex", "foxglove-sdk", *ours} & served == set()


@pytest.fixture
def machine(tmp_path):
    """Stand-ins of the programs that `tools/install` calls: each call is a line of `calls`."""
    call = f'echo "${{0##*/}} $*" >> "{tmp_path}/calls"'
    scripts = {
        "environment/bin/python": 'case "$*" in *" -r $BROKEN"*) exit 1 ;; esac\n'
        'case "$*" in *"config get"*) echo $MIRROR ;; esac',
        "environment/bin/pip": "",
        "environment/bin/uv": 'case "$*" in *" -r $UV_FAILS"*) exit 1 ;; esac\n'
        "echo from $UV_DEFAULT_INDEX",
        "python-3.10": 'case "$2" in *version*) echo 3.10 ;; esac',
    }
    for name, script in scripts.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"#!/bin/sh\n{call}\n{script}\n")
        path.chmod(0o755)
    (tmp_path / "some.lock").write_text("numpy==2.0 \\\n    --hash=sha256:00\n")
    return tmp_path


def install(machine, python, environment, **variables):
    """Run `tools/install` and return what it did and each program that it called."""
    inherited = {key: value for key, value in os.environ.items() if "INDEX" not in key}
    done = subprocess.run(
        [INSTALL, f"./{python}", environment, "some.lock", "own"], cwd=machine, text=True,
        capture_output=True, env={**inherited, "BROKEN": "none", "UV_FAILS": "none", **variables},
    )  # fmt: skip
    calls = (machine / "calls").read_text().splitlines() if (machine / "calls").exists() else []
    return done, [call for call in calls if "install" in call]


EDITABLE = "--no-deps --no-build-isolation --config-settings editable_mode=compat -e own"


def test_uv_installs_the_lock_and_then_our_packages(machine):
    done, calls = install(machine, "python", "environment")
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[0] == "Installing some.lock into environment"
    bootstrap, *by_uv = calls
    assert bootstrap.startswith("python -m pip ")
    assert bootstrap.endswith("requirements-uv.lock")
    uv = "uv pip install --python environment/bin/python"
    assert by_uv == [f"{uv} --require-hashes -r some.lock", f"{uv} {EDITABLE}"]


@pytest.mark.parametrize(
    ("variables", "reason"),
    [
        ({"BROKEN": f"{INSTALL.parent}/../requirements-uv.lock"}, "uv cannot be installed"),
        ({"UV_FAILS": "some.lock"}, "uv failed"),
    ],
)
def test_pip_installs_where_uv_does_not(machine, variables, reason):
    done, calls = install(machine, "python", "environment", **variables)
    assert done.returncode == 0, done.stderr
    assert f"{reason} (see above): pip is used, which takes minutes" in done.stdout
    pip = "python -m pip --disable-pip-version-check install"
    assert calls[-2:] == [f"{pip} --require-hashes -r some.lock", f"{pip} {EDITABLE}"]


def test_a_python_that_is_too_old_is_named(machine):
    done, calls = install(machine, "python-3.10", "new")
    said = "sceneprint needs Python 3.11 or later, and ./python-3.10 is Python 3.10."
    assert (done.returncode, said in done.stderr) == (2, True)
    assert (calls, (machine / "new").exists()) == ([], False)


@pytest.mark.thorough
def test_type_checkers_find_the_client(tmp_path):
    """As of a user's script in the environment of `make demo`."""
    script = tmp_path / "script.py"
    script.write_text(
        "from sceneprint_client import Client\n\n\n"
        "def status(client: Client) -> int:\n"
        '    return client.query("hall", "frame.png")\n'
    )
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", "--config-file=", "--cache-dir=cache", script],
        cwd=tmp_path, capture_output=True, text=True,
    )  # fmt: skip
    assert done.stdout.splitlines() == [
        'script.py:5: error: Incompatible return value type (got "Answer", expected "int")'
        "  [return-value]",
        "Found 1 error in 1 file (checked 1 source file)",
    ], done.stderr
