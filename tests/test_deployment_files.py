"""Tests of the files of docs/deployment; each check also sees a faulty file."""

import os
import re
import shlex
import shutil
import socket
import subprocess
import threading
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import cast

import httpx
import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.decoders import sandbox
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


class _Api(ThreadingHTTPServer):
    """Stands in for an API process: it says which one it is, and holds `/hold` requests open."""

    daemon_threads = True
    request_queue_size = 128

    def __init__(self, name):
        super().__init__(("127.0.0.1", 0), _Answer)
        self.name, self.release, self.held = name, threading.Event(), threading.Semaphore(0)
        threading.Thread(target=self.serve_forever, kwargs={"poll_interval": 0.02}).start()

    def end(self):
        self.release.set()
        self.shutdown()
        self.server_close()


class _Answer(BaseHTTPRequestHandler):
    def do_GET(self):
        api = cast(_Api, self.server)
        if self.path.endswith("/hold"):
            api.held.release()
            api.release.wait(PATIENCE_S)
        body = api.name.encode()
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_):
        pass


@pytest.fixture
def proxied(tmp_path, until):
    """The file run by haproxy in front of three processes."""
    apis = {name: _Api(name) for name in ("a", "b", "c")}
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    text = (FOLDER / "haproxy.cfg").read_text().replace("bind :8008", f"bind 127.0.0.1:{port}")
    # few processes are named one by one, as the file says
    text = re.sub(r"(?ms)^resolvers names.*?(?=^frontend)", "", text)
    # a process that answers late on a busy machine is there still
    text = text.replace("inter 2s", "inter 300").replace(
        "    timeout queue 10s\n", "    timeout queue 10s\n    timeout check 10s\n"
    )
    assert "timeout check" in text
    lines = [f"    server {n} 127.0.0.1:{api.server_port} check" for n, api in apis.items()]
    text = re.sub(r"(?m)^ +server-template.*$", "\n".join(lines), text)
    path = tmp_path / "run.cfg"
    path.write_text(text)
    program = subprocess.Popen(
        [tool("haproxy", "haproxy"), "-db", "-f", str(path)], stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )  # fmt: skip
    transport = httpx.HTTPTransport(retries=20)  # until it listens
    try:
        with httpx.Client(base_url=f"http://127.0.0.1:{port}", transport=transport) as client:
            until(lambda: {client.get("/v1/jobs").text for _ in range(6)} == set(apis))
            yield client, apis
    finally:
        program.terminate()
        program.wait()
        for api in apis.values():
            api.end()


MAPS = [f"map-{i}" for i in range(60)]


def homes(client, rest="frames"):
    """Where each map is answered most: a request that has just ended may still count, and the next
    one go elsewhere.
    """
    asked = {
        name: Counter(client.get(f"/v1/maps/{name}/{rest}").text for _ in range(5)) for name in MAPS
    }
    return {name: counter.most_common(1)[0][0] for name, counter in asked.items()}


def test_a_map_stays_with_its_process_until_that_ends(proxied, until):
    client, apis = proxied
    first = homes(client)
    assert homes(client, "query?k=1") == first
    assert min(Counter(first.values())[name] for name in apis) >= 8  # of 20 on average
    apis["b"].end()
    until(lambda: "b" not in {client.get("/v1/jobs").text for _ in range(6)})
    after = homes(client)
    assert {name for name in MAPS if after[name] != first[name]} == {
        name for name in MAPS if first[name] == "b"
    }
    assert set(after.values()) == {"a", "c"}


def test_a_busy_map_spills_over_to_other_processes(proxied, until):
    """Of 30 open requests for one map, no process has more than 1.5 times the mean, rounded up."""
    client, apis = proxied
    ports = client.base_url.port
    with ThreadPoolExecutor(30) as pool:
        asked = [
            pool.submit(httpx.get, f"http://127.0.0.1:{ports}/v1/maps/busy/hold", timeout=40)
            for _ in range(30)
        ]
        taken = Counter()

        def all_taken():
            for name, api in apis.items():
                while api.held.acquire(blocking=False):
                    taken[name] += 1
            return taken.total() == 30

        until(all_taken)
        for api in apis.values():
            api.release.set()
        assert Counter(one.result().text for one in asked) == taken
    assert len(taken) >= 2
    assert max(taken.values()) <= 16


def test_without_a_process_that_is_ready_clients_are_told_to_come_back(proxied, until):
    client, apis = proxied
    for api in apis.values():
        api.end()
    until(lambda: client.get("/v1/maps").status_code == 503)
    answer = client.get("/v1/maps")
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
def test_units_confine_what_they_run(path):
    lines = set(path.read_text().splitlines())
    assert lines >= {
        "SystemCallFilter=@system-service", "SystemCallFilter=~@privileged", "ProtectClock=yes",
        "ProtectKernelLogs=yes", "ProtectHostname=yes", "ProtectProc=invisible",
        "RestrictRealtime=yes", "NoNewPrivileges=yes", "CapabilityBoundingSet=", "UMask=0077",
    }  # fmt: skip
    assert {"MemoryMax", "TasksMax"} <= {line.partition("=")[0] for line in lines}


@pytest.mark.parametrize("path", UNITS, ids=lambda path: path.name)
def test_units_let_decoders_lock_themselves_in(path):
    """What they call for it is in no group of systemd 252."""
    filters = re.findall(r"(?m)^SystemCallFilter=([^~].*)$", path.read_text())
    named = {name for line in filters for name in line.split()}
    needed = {"seccomp": 317, "landlock_create_ruleset": 444, "landlock_restrict_self": 446}
    assert named == {"@system-service", *needed}
    used = {sandbox._SECCOMP["x86_64"], sandbox._CREATE_RULESET, sandbox._RESTRICT_SELF}
    assert set(needed.values()) == used


def settings_of(text):
    """NAME=value of a unit's `Environment=` lines, or of a file of the environment."""
    found = []
    for line in text.splitlines():
        if line.startswith("Environment="):
            found += line.removeprefix("Environment=").split()
        elif re.match(r"(# )?[A-Z_]+=", line):
            found += shlex.split(line.removeprefix("# "))
    return dict(one.split("=", 1) for one in found)


def test_units_and_environment_set_what_is_read():
    read = {f"SCENEPRINT_{name.upper()}" for name in Settings.model_fields}
    read |= {"NUMBA_CACHE_DIR", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "PGPASSWORD"}
    read |= {
        f"AWS_{name}" for name in ("REGION", "ACCESS_KEY_ID", "SECRET_ACCESS_KEY", "ENDPOINT_URL")
    }
    given = {}
    for path in (*UNITS, FOLDER / "sceneprint.env"):
        given |= settings_of(path.read_text())
    assert given.keys() - read == set()
    own = {k.removeprefix("SCENEPRINT_").lower(): v for k, v in given.items() if k[:5] == "SCENE"}
    told = Settings(**own)  # as the environment has them: texts
    assert told.workers == 0
    assert told.asks_for_keys
    assert "change-me" not in told.database  # in no URL is a secret


def test_a_shell_reads_the_environment_as_systemd_does():
    """docs/deployment.md has operators source it; in an unquoted URL `&` ends a command."""
    path = FOLDER / "sceneprint.env"
    expected = {line for line in path.read_text().splitlines() if re.match("[A-Z_]+=", line)}
    block = f"set -a && . {path} && set +a && env -0"
    env = {"PATH": os.environ["PATH"]}
    done = subprocess.run(["bash", "-euc", block], env=env, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    sourced = dict(one.split("=", 1) for one in done.stdout.split("\0") if one)
    assert sourced.items() >= settings_of("\n".join(expected)).items()
    url = "postgresql+psycopg://sceneprint@/sceneprint?host=db1.example:5432&host=db2.example:5432"
    assert sourced["SCENEPRINT_DATABASE_URL"] == f"{url}&target_session_attrs=read-write"
