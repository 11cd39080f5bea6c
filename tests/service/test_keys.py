"""Tests of keys: required for remote callers, created by a command, and stored as hashes."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from anyio import fail_after, to_thread
from fastapi.security import HTTPAuthorizationCredentials
from starlette.requests import Request

from benchmarks.waiting import PATIENCE_S
from sceneprint.cli import main
from sceneprint.engine.admin.operations import create_key, list_keys
from sceneprint.settings import Settings
from service.app import create_app, housekeeping
from service.auth import authenticate
from service.limits import RequestBody
from service.metrics import Metrics
from service.running_service import Service
from tests.whole_engine import Engine

BELOW = (
    ("GET", "/v1/maps"),
    ("GET", "/v1/jobs/a"),
    ("DELETE", "/v1/maps/a"),
    ("POST", "/v1/maps/a/frames"),
    ("POST", "/v1/maps/a/queries"),
)
COMMAND = Path(sys.executable).parent / "sceneprint"


def make(folder: Path, name: str) -> subprocess.CompletedProcess[str]:
    arguments = [COMMAND, "keys", "--create", name, "--data", folder]
    return subprocess.run(
        arguments, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )


@pytest.fixture(scope="module")
def wide(begin):
    return begin("--host", "0.0.0.0", "--workers", "0")


@pytest.fixture(scope="module")
def secret(wide) -> str:
    done = make(wide.folder, "robot 7")
    assert done.returncode == 0
    assert done.stdout.startswith("sp_")
    assert len(done.stdout.split()) == 1
    assert done.stderr == "save this secret now: it is not stored and cannot be shown again\n"
    return done.stdout.strip()


@pytest.fixture(scope="module", autouse=True)
def nearby(wide):
    """The address that is printed is that of every interface; asked from here it is this one."""
    assert wide.url.startswith("http://0.0.0.0:")
    wide.client.base_url = wide.url.replace("0.0.0.0", "127.0.0.1")


NO_KEY = "This service requires a key. Send the header Authorization: Bearer KEY"
WRONG_KEY = "The key that was sent is unknown, revoked or expired."


@pytest.mark.parametrize(
    ("shown", "told"),
    [
        (None, NO_KEY), ("Bearer", NO_KEY), ("Basic {}", NO_KEY), ("{}", NO_KEY),
        ("Bearer sp_wrong", WRONG_KEY), ("Bearer {}x", WRONG_KEY), ("Bearer \xe9", WRONG_KEY),
    ],
)  # fmt: skip
def test_without_its_key_nothing_below_v1_is_told(wide, secret, refused, shown, told):
    headers = {} if shown is None else {"Authorization": shown.format(secret).encode("latin-1")}
    for method, path in BELOW:
        answer = wide.client.request(method, path, headers=headers)
        refused(answer, 401, "key-required", told)
        assert answer.headers["www-authenticate"] == "Bearer"
    answer = wide.client.post("/v1/maps", json={"name": "a"}, headers=headers)
    refused(answer, 401, "key-required")


@pytest.mark.parametrize("scheme", ["Bearer", "bearer"])
def test_with_a_key_all_is_open(wide, secret, scheme):
    headers = {"Authorization": f"{scheme} {secret}"}
    assert wide.client.get("/v1/maps", headers=headers).json() == {
        "items": [], "next_cursor": None,
    }  # fmt: skip
    assert wide.client.get("/v1/maps").status_code == 401


@pytest.mark.parametrize("path", ["/healthz", "/readyz", "/openapi.json"])
def test_whether_it_lives_is_told_to_all(wide, path):
    assert wide.client.get(path).status_code == 200


def test_on_this_machine_alone_no_key_is_asked_for(served):
    assert served.url.startswith("http://127.0.0.1:")
    assert served.client.get("/v1/maps").status_code == 200


@pytest.mark.sqlite_only("the files of the database are in the data folder")
def test_the_secret_is_in_no_file_and_no_line(wide, secret):
    wide.client.get("/v1/maps", headers={"Authorization": f"Bearer {secret}"})
    bare = secret.removeprefix("sp_").encode()
    files = [path for path in wide.folder.rglob("*") if path.is_file()]
    assert {"sceneprint.db", "sceneprint.db-wal"} <= {path.name for path in files}
    for path in [*files, wide.errors]:
        data = path.read_bytes()
        assert all(bare[i : i + 16] not in data for i in range(len(bare) - 15)), path
    assert any(b"robot 7" in path.read_bytes() for path in files)


def test_a_name_is_given_once(wide, secret, capsys):
    assert main(["keys", "--create", "robot 7", "--data", str(wide.folder)]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err == (
        "sceneprint keys: A key named 'robot 7' already exists. Choose another name.\n"
    )
    headers = {"Authorization": f"Bearer {secret}"}
    assert wide.client.get("/v1/maps", headers=headers).status_code == 200


@pytest.mark.parametrize("name", ["", "two\nlines", "x" * 129])
def test_a_key_has_a_name_that_can_be_printed(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["keys", "--create", name, "--data", str(tmp_path)]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert len(said.err.splitlines()) == 1
    assert "is not a valid key name" in said.err


def test_who_uses_a_key_waits_for_no_note_of_it(tmp_path):
    """It is written later, by whoever keeps house, and at the latest when the service ends."""
    with Engine(Settings(data_dir=tmp_path, database_url=None)) as engine:
        engine.create_key("idle")
        secret = engine.create_key("busy").secret

        def used() -> dict[str, bool]:
            return {one.name: one.last_used_at is not None for one in list_keys(engine.store).items}

        async def serve() -> None:
            service = Service(engine.context, Metrics())
            async with housekeeping(service):
                assert service.find_key(secret).name == "busy"
                assert used() == {"busy": False, "idle": False}

        asyncio.run(serve())
        assert used() == {"busy": True, "idle": False}


def test_a_key_is_looked_up_while_every_shared_thread_is_taken(tmp_path):
    """Slow requests of some keep nobody from being told who they are."""
    app = create_app(Settings(data_dir=tmp_path, host="0.0.0.0", workers=0))

    async def ask() -> str:
        async with app.router.lifespan_context(app):
            here = app.state.service
            secret = create_key(here.context.store, "robot").secret
            shared = to_thread.current_default_thread_limiter()
            slow = [object() for _ in range(int(shared.total_tokens))]
            for one in slow:
                shared.acquire_on_behalf_of_nowait(one)
            body = RequestBody(Request({"type": "http"}).receive, 0)
            request = Request(
                {
                    "type": "http", "app": app, "method": "GET", "path": "/v1/keys/me",
                    "query_string": b"", "headers": [], "route": SimpleNamespace(endpoint=ask),
                    "state": {"forwarded": None, "at_end": [], "body": body},
                }
            )  # fmt: skip
            shown = HTTPAuthorizationCredentials(scheme="Bearer", credentials=secret)
            try:
                with fail_after(30):
                    return (await authenticate(request, here, shown)).name
            finally:
                for one in slow:
                    shared.release_on_behalf_of(one)

    assert asyncio.run(ask()) == "robot"
