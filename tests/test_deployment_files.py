"""Files of docs/deployment are held to what reads them; each check is shown what it is against."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from sceneprint.cli import parser
from sceneprint.decoders import sandbox
from sceneprint.settings import Settings

FOLDER = Path(__file__).resolve().parent.parent / "docs" / "deployment"
UNITS = sorted(FOLDER.glob("*.service"))
PAGE = (FOLDER.parent / "deployment.md").read_text()


def tool(name: str, package: str) -> str:
    """A program that is no Python package; tests of it are skipped where it is not installed."""
    path = shutil.which(name)
    if path is None:
        pytest.skip(f"{name} is not installed (apt install {package})")
    return path


def said_by_haproxy(text: str, folder: Path) -> tuple[int, str]:
    """How haproxy checks a configuration, and what it says."""
    path = folder / "haproxy.cfg"
    path.write_text(text)
    done = subprocess.run(
        [tool("haproxy", "haproxy"), "-c", "-f", str(path)],
        env={**os.environ, "API_HOST": "localhost"}, capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    return done.returncode, done.stdout + done.stderr


def test_haproxy_takes_its_file(tmp_path: Path) -> None:
    text = (FOLDER / "haproxy.cfg").read_text()
    returned, said = said_by_haproxy(text, tmp_path)
    assert (returned, said.strip()) == (0, "Configuration file is valid")
    returned, said = said_by_haproxy(text.replace("option httpchk", "option httpcheck"), tmp_path)
    assert returned != 0
    assert "httpcheck" in said


def said_of_unit(text: str, name: str, folder: Path) -> str:
    """What systemd has against a unit, whose program is not installed here."""
    path = folder / name
    path.write_text(text.replace("/opt/sceneprint/bin/sceneprint", "/bin/true"))
    done = subprocess.run(
        [tool("systemd-analyze", "systemd"), "verify", "--man=no", str(path)],
        capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    return done.stdout + done.stderr


@pytest.mark.parametrize("path", UNITS, ids=lambda path: path.name)
def test_systemd_takes_the_units(path: Path, tmp_path: Path) -> None:
    text = path.read_text()
    assert said_of_unit(text, path.name, tmp_path) == ""
    assert "Restrat" in said_of_unit(text.replace("Restart=", "Restrat="), path.name, tmp_path)


@pytest.mark.parametrize("path", UNITS, ids=lambda path: path.name)
def test_units_confine_what_they_run(path: Path) -> None:
    lines = set(path.read_text().splitlines())
    assert lines >= {
        "SystemCallFilter=@system-service", "SystemCallFilter=~@privileged", "ProtectClock=yes",
        "ProtectKernelLogs=yes", "ProtectHostname=yes", "ProtectProc=invisible",
        "RestrictRealtime=yes", "NoNewPrivileges=yes", "CapabilityBoundingSet=", "UMask=0077",
    }  # fmt: skip
    assert {"MemoryMax", "TasksMax"} <= {line.partition("=")[0] for line in lines}


@pytest.mark.parametrize("path", UNITS, ids=lambda path: path.name)
def test_units_let_decoders_lock_themselves_in(path: Path) -> None:
    """What they call for it is in no group of systemd 252."""
    filters = re.findall(r"(?m)^SystemCallFilter=([^~].*)$", path.read_text())
    named = {name for line in filters for name in line.split()}
    needed = {"seccomp": 317, "landlock_create_ruleset": 444, "landlock_restrict_self": 446}
    assert named == {"@system-service", *needed}
    used = {sandbox._SECCOMP["x86_64"], sandbox._CREATE_RULESET, sandbox._RESTRICT_SELF}
    assert set(needed.values()) == used


def settings_of(text: str) -> dict[str, str]:
    """NAME=value of a unit's `Environment=` lines, or of a file of the environment."""
    found = []
    for line in text.splitlines():
        if line.startswith("Environment="):
            found += line.removeprefix("Environment=").split()
        elif re.match(r"(# )?[A-Z_]+=", line):
            found.append(line.removeprefix("# "))
    return dict(one.split("=", 1) for one in found)


def test_units_and_environment_set_what_is_read() -> None:
    read = {f"SCENEPRINT_{name.upper()}" for name in Settings.model_fields}
    read |= {"NUMBA_CACHE_DIR", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "PGPASSWORD"}
    read |= {
        f"AWS_{name}" for name in ("REGION", "ACCESS_KEY_ID", "SECRET_ACCESS_KEY", "ENDPOINT_URL")
    }
    given: dict[str, str] = {}
    for path in (*UNITS, FOLDER / "sceneprint.env"):
        given |= settings_of(path.read_text())
    assert given.keys() - read == set()
    own = {k.removeprefix("SCENEPRINT_").lower(): v for k, v in given.items() if k[:5] == "SCENE"}
    told = Settings(**own)  # type: ignore[arg-type]  # as the environment has them: texts
    assert told.workers == 0
    assert told.asks_for_keys
    assert "change-me" not in told.database  # in no URL is a secret


def test_units_are_alike_but_for_what_they_run() -> None:
    api, worker = (path.read_text().splitlines() for path in UNITS)
    assert set(api) ^ set(worker) == {
        api[0],
        worker[0],
        "Description=sceneprint: place recognition over HTTP",
        "Description=sceneprint: workers that sign frames",
        "Environment=SCENEPRINT_WORKERS=0",
        "ExecStart=/opt/sceneprint/bin/sceneprint serve",
        "ExecStart=/opt/sceneprint/bin/sceneprint work",
    }
    known = parser().format_help()
    assert re.search(r"^ +serve ", known, re.MULTILINE)
    assert re.search(r"^ +work ", known, re.MULTILINE)


def test_the_page_names_every_file() -> None:
    missing = [path.name for path in FOLDER.iterdir() if f"deployment/{path.name}" not in PAGE]
    assert missing == []
