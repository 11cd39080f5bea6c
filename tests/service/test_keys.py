"""Tests of keys: required for remote callers, created by a command, and stored as hashes."""

import asyncio

import pytest

from sceneprint.engine.admin.operations import list_keys
from sceneprint.settings import Settings
from service.app import housekeeping
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
    ("shown", "detail"),
    [
        (None, NO_KEY), ("Bearer", NO_KEY), ("Basic {}", NO_KEY), ("{}", NO_KEY),
        ("Bearer sp_wrong", WRONG_KEY), ("Bearer {}x", WRONG_KEY), ("Bearer \xe9", WRONG_KEY),
    ],
)  # fmt: skip
def test_without_its_key_nothing_below_v1_is_told(walled, secret, refused, shown, detail):
    headers = {} if shown is None else {"Authorization": shown.format(secret).encode("latin-1")}
    for method, path in BELOW:
        answer = walled.server.client.request(method, path, headers=headers)
        refused(answer, 401, "key-required", detail)
        assert answer.headers["www-authenticate"] == "Bearer"


@pytest.mark.parametrize("shown", ["Basic YTpi", "Token sp_x", "sp_x", "Bearer"])
def test_on_loopback_an_authorization_without_a_key_is_refused(served, refused, shown):
    answer = served.client.get("/v1/maps", headers={"Authorization": shown})
    refused(answer, 401, "key-required", "contains no key in the scheme Bearer. Send the header")


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
            return {key.name: key.last_used_at is not None for key in list_keys(engine.store).items}

        async def serve():
            service = Service(engine.context, Metrics())
            async with housekeeping(service):
                assert service.find_key(secret).name == "busy"
                assert used() == {"busy": False, "idle": False}

        asyncio.run(serve())
        assert used() == {"busy": True, "idle": False}
