"""Tests of keys: required for remote callers, created by a command, and stored as hashes."""

import asyncio
from types import SimpleNamespace

import pytest
from anyio import fail_after, to_thread
from fastapi.security import HTTPAuthorizationCredentials
from starlette.requests import Request

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


@pytest.fixture
def secret(walled):
    return str(walled.secrets["boss"])


NO_KEY = "This service requires a key. Send the header Authorization: Bearer KEY"
WRONG_KEY = "The key that was sent is unknown, revoked or expired."


@pytest.mark.parametrize(
    ("shown", "told"),
    [
        (None, NO_KEY), ("Bearer", NO_KEY), ("Basic {}", NO_KEY), ("{}", NO_KEY),
        ("Bearer sp_wrong", WRONG_KEY), ("Bearer {}x", WRONG_KEY), ("Bearer \xe9", WRONG_KEY),
    ],
)  # fmt: skip
def test_without_its_key_nothing_below_v1_is_told(walled, secret, refused, shown, told):
    headers = {} if shown is None else {"Authorization": shown.format(secret).encode("latin-1")}
    for method, path in BELOW:
        answer = walled.server.client.request(method, path, headers=headers)
        refused(answer, 401, "key-required", told)
        assert answer.headers["www-authenticate"] == "Bearer"


def test_the_name_of_the_scheme_may_be_in_any_case(walled, secret):
    for scheme in ("Bearer", "bearer"):
        headers = {"Authorization": f"{scheme} {secret}"}
        assert walled.server.client.get("/v1/maps", headers=headers).status_code == 200


def test_whether_it_lives_is_told_to_all(walled):
    for path in ("/healthz", "/readyz", "/openapi.json"):
        assert walled.server.client.get(path).status_code == 200


def test_on_this_machine_alone_no_key_is_asked_for(served):
    assert served.url.startswith("http://127.0.0.1:")
    assert served.client.get("/v1/maps").status_code == 200


@pytest.mark.sqlite_only("the files of the database are in the data folder")
def test_the_secret_is_in_no_file_and_no_line(walled, secret):
    server = walled.server
    server.client.get("/v1/maps", headers={"Authorization": f"Bearer {secret}"})
    bare = secret.removeprefix("sp_").encode()
    files = [path for path in server.folder.rglob("*") if path.is_file()]
    assert {"sceneprint.db", "sceneprint.db-wal"} <= {path.name for path in files}
    for path in [*files, server.errors]:
        data = path.read_bytes()
        assert all(bare[i : i + 16] not in data for i in range(len(bare) - 15)), path
    assert any(b"watcher" in path.read_bytes() for path in files)


def test_who_uses_a_key_waits_for_no_note_of_it(tmp_path):
    """It is written later, by whoever keeps house, and at the latest when the service ends."""
    with Engine(Settings(data_dir=tmp_path, database_url=None)) as engine:
        engine.create_key("idle")
        secret = engine.create_key("busy").secret

        def used():
            return {one.name: one.last_used_at is not None for one in list_keys(engine.store).items}

        async def serve():
            service = Service(engine.context, Metrics())
            async with housekeeping(service):
                assert service.find_key(secret).name == "busy"
                assert used() == {"busy": False, "idle": False}

        asyncio.run(serve())
        assert used() == {"busy": True, "idle": False}


async def authenticated(app, secret):
    """Authenticate a request to an endpoint that needs no shared thread."""
    body = RequestBody(Request({"type": "http"}).receive, 0)
    request = Request(
        {
            "type": "http", "app": app, "method": "GET", "path": "/v1/keys/me",
            "query_string": b"", "headers": [], "route": SimpleNamespace(endpoint=authenticated),
            "state": {"forwarded": None, "at_end": [], "body": body},
        }
    )  # fmt: skip
    shown = HTTPAuthorizationCredentials(scheme="Bearer", credentials=secret)
    return await authenticate(request, app.state.service, shown)


def test_a_key_is_looked_up_while_every_shared_thread_is_taken(tmp_path):
    """Slow requests of some keep nobody from being told who they are."""
    app = create_app(Settings(data_dir=tmp_path, host="0.0.0.0", workers=0))

    async def ask():
        async with app.router.lifespan_context(app):
            secret = create_key(app.state.service.context.store, "robot").secret
            shared = to_thread.current_default_thread_limiter()
            slow = [object() for _ in range(int(shared.total_tokens))]
            for one in slow:
                shared.acquire_on_behalf_of_nowait(one)
            try:
                with fail_after(30):
                    return (await authenticated(app, secret)).name
            finally:
                for one in slow:
                    shared.release_on_behalf_of(one)

    assert asyncio.run(ask()) == "robot"


def test_lists_of_a_tenant_make_way_for_one_that_lists_nothing(tmp_path):
    app = create_app(Settings(data_dir=tmp_path, host="0.0.0.0", workers=0))

    async def ask():
        async with app.router.lifespan_context(app):
            here = app.state.service
            secret = create_key(here.context.store, "robot").secret
            order, admitted = here.reads.order, []
            for lists in (("first", "second"), ("third", "fourth")):
                for waiter in lists:
                    order.enter("another", waiter)
                admitted.append(order.admit())
                for _ in admitted[-1]:
                    order.release("another")
                await authenticated(app, secret)
            return admitted

    # alone both of its lists run at once, and beside the robot one after the other
    assert asyncio.run(ask()) == [["first", "second"], ["third"]]
