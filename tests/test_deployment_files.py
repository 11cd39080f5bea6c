"""Tests of the files of docs/deployment; each check also sees a faulty file."""

import os
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import httpx
import pytest

from benchmarks.waiting import PATIENCE_S, answers, free_port
from sceneprint.settings import Settings
from sceneprint_client.errors import StoreAway
from sceneprint_client.http import error_of

FOLDER = Path(__file__).resolve().parent.parent / "docs" / "deployment"
UNITS = sorted(FOLDER.glob("*.service"))
PAGE = (FOLDER.parent / "deployment.md").read_text()


def tool(name, package):
    """A program that is no Python package; tests of it are skipped where it is not installed."""
    path = shutil.which(name)
    if path is None:
        pytest.skip(f"{name} is not installed (apt install {package})")
    return path


def test_haproxy_takes_its_file():
    done = subprocess.run(
        [tool("haproxy", "haproxy"), "-c", "-f", str(FOLDER / "haproxy.cfg")],
        env={**os.environ, "API_HOST": "localhost"}, capture_output=True, text=True,
        timeout=PATIENCE_S,
    )  # fmt: skip
    assert (done.returncode, done.stdout + done.stderr) == (0, "Configuration file is valid\n")


def test_without_a_process_that_is_ready_clients_retry_later(tmp_path, until):
    port = free_port()
    text = (FOLDER / "haproxy.cfg").read_text().replace("bind :8008", f"bind 127.0.0.1:{port}")
    # servers may be named one by one instead of looked up, as the file says
    text = re.sub(r"(?ms)^resolvers names.*?(?=^frontend)", "", text)
    text = re.sub(r"(?m)^ +server-template.*$", f"    server a 127.0.0.1:{free_port()} check", text)
    path = tmp_path / "run.cfg"
    path.write_text(text)
    with subprocess.Popen(
        [tool("haproxy", "haproxy"), "-db", "-f", str(path)], stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as program:  # fmt: skip
        try:
            until(lambda: answers(f"http://127.0.0.1:{port}/proxy"))
            answer = httpx.get(f"http://127.0.0.1:{port}/v1/maps", trust_env=False)
        finally:
            program.terminate()
    assert answer.status_code == 503
    assert answer.headers["content-type"] == "application/problem+json"
    error = error_of(answer)
    assert (type(error), error.retry_after_s) == (StoreAway, 2.0)
    assert str(error) == "No process of the service is ready. Retry later."


@pytest.mark.parametrize("path", UNITS, ids=lambda path: path.name)
def test_systemd_takes_the_units(path, tmp_path):
    unit = tmp_path / path.name  # its program is not installed here
    unit.write_text(path.read_text().replace("/opt/sceneprint/bin/sceneprint", "/bin/true"))
    done = subprocess.run(
        [tool("systemd-analyze", "systemd"), "verify", "--man=no", str(unit)],
        capture_output=True, text=True, timeout=PATIENCE_S,
    )  # fmt: skip
    assert done.stdout + done.stderr == ""


@pytest.mark.parametrize("path", UNITS, ids=lambda path: path.name)
def test_units_let_decoders_lock_themselves_in(path):
    """What they call for it is in no group of systemd 252."""
    filters = re.findall(r"(?m)^SystemCallFilter=([^~].*)$", path.read_text())
    named = {name for line in filters for name in line.split()}
    assert named == {"@system-service", "seccomp"}


def settings_of(text):
    """NAME=value of a unit's `Environment=` lines, or of a file of the environment."""
    assignments = []
    for line in text.splitlines():
        if line.startswith("Environment="):
            assignments += line.removeprefix("Environment=").split()
        elif re.match(r"(# )?[A-Z_]+=", line):
            assignments += shlex.split(line.removeprefix("# "))
    return dict(assignment.split("=", 1) for assignment in assignments)


def test_units_and_environment_set_what_is_read():
    read = {f"SCENEPRINT_{name.upper()}" for name in Settings.model_fields}
    read |= {"NUMBA_CACHE_DIR", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "PGPASSWORD"}
    read |= {
        f"AWS_{name}" for name in ("REGION", "ACCESS_KEY_ID", "SECRET_ACCESS_KEY", "ENDPOINT_URL")
    }
    variables = {}
    for path in (*UNITS, FOLDER / "sceneprint.env"):
        variables |= settings_of(path.read_text())
    assert variables.keys() - read == set()
    own = {
        k.removeprefix("SCENEPRINT_").lower(): v for k, v in variables.items() if k[:5] == "SCENE"
    }
    settings = Settings(**own)  # as the environment has them: texts
    assert settings.workers == 0
    assert settings.asks_for_keys
    assert "change-me" not in settings.database  # in no URL is a secret


def test_a_shell_reads_the_environment_as_systemd_does():
    """docs/deployment.md has operators source it; in an unquoted URL `&` ends a command."""
    path = FOLDER / "sceneprint.env"
    expected = {line for line in path.read_text().splitlines() if re.match("[A-Z_]+=", line)}
    block = f"set -a && . {path} && set +a && env -0"
    env = {"PATH": os.environ["PATH"]}
    done = subprocess.run(["bash", "-euc", block], env=env, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    sourced = dict(part.split("=", 1) for part in done.stdout.split("\0") if part)
    assert sourced.items() >= settings_of("\n".join(expected)).items()
    url = "postgresql+psycopg://sceneprint@/sceneprint?host=db1.example:5432&host=db2.example:5432"
    assert sourced["SCENEPRINT_DATABASE_URL"] == f"{url}&target_session_attrs=read-write"
