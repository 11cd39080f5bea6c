"""Tests of a wheel with compiled kernels, which need no compilation after installation."""

import os
import platform
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.geometry.kernel import runs_here

ROOT = Path(__file__).parents[1]

pytestmark = [
    pytest.mark.thorough,
    pytest.mark.skipif(not runs_here(), reason="machine code is for x86-64-v3"),
]

#: Loads what a service with clouds needs, then says how many kernels were compiled and loaded.
COUNT = """
import gc, sys
from pathlib import Path
from sceneprint.engine.signers import warm
from sceneprint.signing import open_signer
assert warm(open_signer("depth", Path(sys.argv[1])), clouds=True)
from numba.core.dispatcher import Dispatcher
ours = [one for one in gc.get_objects() if isinstance(one, Dispatcher)
        and one.py_func.__module__.startswith("sceneprint.")]
print(sum(sum(one._cache_misses.values()) for one in ours),
      sum(sum(one._cache_hits.values()) for one in ours))
"""


#: The bytes of a signature and of an artifact.
BYTES = """
import hashlib, sys
from pathlib import Path
from sceneprint.engine.signers import _corner, warm_signing
from sceneprint.pipeline import prepare
from sceneprint.signing import open_signer
signer = open_signer("depth", Path(sys.argv[1]))
print(hashlib.sha256(prepare(_corner(), signer)[0].vector.tobytes()).hexdigest(),
      hashlib.sha256(warm_signing(signer)).hexdigest())
"""


def environment_without_us(folder):
    """The Python of an environment with all libraries of this one, and no sceneprint yet."""
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder)], check=True)
    (there,) = folder.glob("lib/python*/site-packages")
    for libraries in (Path(folder) for folder in sys.path if folder.endswith("site-packages")):
        for path in libraries.iterdir():
            if (
                "sceneprint" not in path.name
                and path.suffix != ".pth"
                and path.name != "__pycache__"
            ):
                (there / path.name).symlink_to(path)
    return folder / "bin" / "python"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Built from what git knows of this checkout, as on a node where nothing of it is installed."""
    folder = tmp_path_factory.mktemp("wheel")
    python = environment_without_us(folder / "environment")
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT, capture_output=True, text=True, check=True,
    )  # fmt: skip
    wanted = ("sceneprint/", "service/", "worker/", "migrations/", "client/", "setup.py",
              "pyproject.toml", "README.md", "LICENSE")  # fmt: skip
    for name in listed.stdout.split("\0"):
        if name.startswith(wanted) and (ROOT / name).is_file():
            to = folder / "source" / name
            to.parent.mkdir(parents=True, exist_ok=True)
            to.write_bytes((ROOT / name).read_bytes())
    command = [str(python), "-m", "pip", "wheel", "--quiet", "--no-deps",
               "--no-build-isolation", "--wheel-dir", str(folder / "wheels"), "."]  # fmt: skip
    env = {**os.environ, "SCENEPRINT_COMPILE": "1"}
    done = subprocess.run(
        command, cwd=folder / "source", env=env, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stdout + done.stderr
    (built,) = (folder / "wheels").glob("sceneprint-*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    folder = tmp_path_factory.mktemp("installed")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    for path in folder.rglob("*"):
        if path.is_dir():
            path.chmod(0o555)
    return folder


def run(program, installed, folder, *arguments, **env):
    """What a program of an installation prints, with cache folders of its own."""
    variables = {
        **os.environ, "PYTHONPATH": os.pathsep.join((str(installed), str(ROOT / "client"))),
        "NUMBA_CACHE_DIR": str(folder / "numba"), "SCENEPRINT_CACHE_DIR": str(folder / "tables"),
        **env,
    }  # fmt: skip
    done = subprocess.run(
        [sys.executable, "-c", program, str(folder), *arguments], cwd=folder, env=variables,
        capture_output=True, text=True, timeout=PATIENCE_S,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()[-1]


def test_it_says_for_whom_it_is_and_brings_code_for_every_kernel(wheel):
    python = f"cp{sys.version_info.major}{sys.version_info.minor}"
    system = sysconfig.get_platform().replace("-", "_").replace(".", "_")
    assert wheel.stem.endswith(f"-{python}-{python}-{system}")
    assert system.endswith(platform.machine())
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    lists = [name for name in names if name.endswith(".nbi")]
    codes = [name for name in names if name.endswith(".nbc")]
    assert len(lists) > 70
    assert len(codes) >= len(lists)
    assert all("/__pycache__/" in name for name in lists + codes)
    assert "sceneprint/engine/corner.artifact" in names


def test_a_first_use_of_clouds_compiles_nothing(installed, tmp_path):
    compiled, loaded = map(int, run(COUNT, installed, tmp_path).split())
    assert compiled == 0
    assert loaded > 25
    assert [*(tmp_path / "numba").rglob("*.nb?")] == []


def test_signatures_are_those_of_code_for_this_processor(installed, tmp_path):
    brought = run(BYTES, installed, tmp_path)
    assert run(BYTES, ROOT, tmp_path, NUMBA_CACHE_DIR="") == brought
