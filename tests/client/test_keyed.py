"""Tests of every client method with a service that requires keys, by scope."""

from __future__ import annotations

import inspect
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.errors import (
    Conflict,
    Forbidden,
    InvalidRequest,
    KeyRequired,
    UnknownKey,
    UnknownMap,
    UnknownQuery,
)
from sceneprint.formats.dataset import FrameReference
from sceneprint.settings import Settings
from sceneprint_client import Client
from sceneprint_client.api import FrameState
from sceneprint_client.api.admin import Scope
from sceneprint_client.api.coverage import MapCoverage
from tests.whole_engine import Engine

ID = "0" * 32
KEYS: dict[str, dict[str, Scope]] = {
    "boss": {"*": "admin"}, "robot": {"hall": "write"}, "screen": {"hall": "read"},
    "other": {"yard": "admin"},
}  # fmt: skip


@pytest.fixture(scope="module")
def keyed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., Client]]:
    """Clients of one service that asks for keys, by the name of their key."""
    data = tmp_path_factory.mktemp("keyed")
    with Engine(Settings(data_dir=data, database_url=None)) as engine:
        secrets = {name: engine.create_key(name, grants).secret for name, grants in KEYS.items()}
    arguments = ["serve", "--host", "0.0.0.0", "--port", "0", "--data", str(data), "--workers", "1"]
    with (data / "log").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "sceneprint", *arguments], env=dict(os.environ),
            stdout=subprocess.PIPE, stderr=log,
        )  # fmt: skip
    clients: list[Client] = []
    try:
        assert process.stdout is not None
        line = process.stdout.readline().decode()
        assert line.startswith("sceneprint: serving http://"), (data / "log").read_text()
        url = line.split()[-1].replace("0.0.0.0", "127.0.0.1")

        def client(name: str | None) -> Client:
            clients.append(Client(url, None if name is None else secrets[name]))
            return clients[-1]

        yield client
    finally:
        for one in clients:
            one.close()
        process.terminate()
        process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0


#: Arguments of every call by their names in its signature.
GIVEN: dict[str, Any] = {
    "map_name": "hall", "name": "hall", "frame_id": ID, "job_id": ID, "query_id": ID,
    "before": "s", "after": "t", "kind": MapCoverage,
    "since": ID, "session": "s",
    "changes": {"title": "x"},
    "model": "depth", "grants": {"*": "read"}, "query": ID, "job_ids": [ID],
    "digest": ID, "records": [{}], "frame_ids": [ID],
    "a": ("hall", ID), "b": ("hall", ID),
}  # fmt: skip
#: Answered without a key, or of no service.
OPEN = {"healthy", "status", "close"}


def test_no_call_gets_by_without_a_key(
    keyed: Callable[..., Client], references: tuple[FrameReference, ...], tmp_path: Path
) -> None:
    """Each method of the client, by its signature: a new one is asked as well."""
    client = keyed(None)
    archive = tmp_path / "archive.zip"
    archive.write_bytes(b"PK")
    own = GIVEN | {
        "frame": references[0], "frames": [references[0]], "archive": archive,
        "file": archive, "path": archive, "target": tmp_path / "target", "into": tmp_path / "into",
        "deletion_id": "0",
    }  # fmt: skip
    asked = []
    for name, method in inspect.getmembers(Client, inspect.isfunction):
        if name.startswith("_") or name in OPEN | {"wait_for_product"}:
            continue
        needed = {
            one.name: own[one.name]
            for one in list(inspect.signature(method).parameters.values())[1:]
            if one.default is inspect.Parameter.empty
            and one.kind is not inspect.Parameter.VAR_KEYWORD
        }
        if name in ("query", "localize"):
            needed = {"map_name": "hall", "frame_id": ID}

        def call(name: str = name, needed: dict[str, Any] = needed) -> None:
            found = getattr(client, name)(**needed)
            if isinstance(found, Iterator):
                next(found)

        with pytest.raises(KeyRequired):
            call()
        asked.append(name)
    assert len(asked) > 50
    assert client.healthy()
    assert (client.status().frames, client.status().jobs) == (None, None)


def test_each_key_does_what_it_may(
    keyed: Callable[..., Client], references: tuple[FrameReference, ...]
) -> None:
    boss, robot, screen, other = (keyed(name) for name in KEYS)
    boss.create_map("hall", model="depth")
    with pytest.raises(Forbidden, match="a map named 'yard'"):
        robot.create_map("yard")
    other.create_map("yard", model="depth")  # its own, though it was not there
    added = robot.upload("hall", references[0], wait_s=PATIENCE_S)
    assert added.state == FrameState.INDEXED
    assert [one.frame_id for one in screen.frames("hall")] == [added.frame_id]
    answer = screen.query("hall", references[0])
    assert answer.matches[0].frame_id == added.frame_id
    assert screen.answer(answer.query_id).query_id == answer.query_id
    with pytest.raises(UnknownQuery):
        other.answer(answer.query_id)
    assert screen.localize("hall", references[0]).query_id
    assert [job.frame_id for job in screen.jobs()] == [added.frame_id]
    assert list(other.jobs()) == []
    with pytest.raises(Forbidden, match="'write' for map 'hall'"):
        screen.upload("hall", references[1])
    with pytest.raises(Forbidden, match="'admin' for map 'hall'"):
        robot.delete_map("hall")
    for call in (other.map, other.delete_map):
        with pytest.raises(UnknownMap, match="'hall'"):
            call("hall")
    assert [one.name for one in other.maps()] == ["yard"]
    assert [one.name for one in boss.maps()] == ["hall", "yard"]
    assert boss.status().frames == {"indexed": 1}
    robot.delete_frame("hall", added.frame_id)
    other.delete_map("yard")
    with pytest.raises(Forbidden, match="all maps"):
        other.keys()
    lines = [(one.actor, one.action, one.map) for one in boss.audit()]
    assert [one for one in lines if one[1] != "refused"] == [
        ("other", "map.deleted", "yard"), ("robot", "frame.deleted", "hall"),
        ("robot", "frame.received", "hall"), ("other", "map.created", "yard"),
        ("boss", "map.created", "hall"),
    ]  # fmt: skip
    own = [one.target for one in boss.audit(actor="robot") if one.action != "refused"]
    assert own == [added.frame_id] * 2
    assert [one.actor for one in boss.audit(map_name="yard")] == ["other", "other"]


@pytest.mark.parametrize("where", ["keyed", "embedded"])
def test_keys_are_made_listed_and_revoked_alike(request: pytest.FixtureRequest, where: str) -> None:
    given = request.getfixturevalue(where)
    client: Client = given("boss") if where == "keyed" else given
    until = datetime.now(UTC) + timedelta(hours=1)
    made = client.create_key("cart 9", {"hall": "write", "yard": "read"}, until)
    assert made.secret.startswith("sp_")
    assert (made.name, made.grants) == ("cart 9", {"hall": "write", "yard": "read"})
    assert made.expires_at == until
    found = client.keys()
    (listed,) = [key for key in found if key.name == "cart 9"]
    assert listed.model_dump() == made.model_dump(exclude={"secret"})
    with pytest.raises(Conflict, match="A key named 'cart 9' already exists"):
        client.create_key("cart 9", {"*": "read"})
    with pytest.raises(InvalidRequest, match="grants"):
        client.create_key("empty", {})
    me = client.me()
    assert (me.name, me.grants) == ("boss" if where == "keyed" else None, {"*": "admin"})
    turned = client.rotate_key("cart 9", 60)
    assert (turned.secret != made.secret, turned.grants) == (True, made.grants)
    assert turned.previous_until is not None
    assert turned.previous_until - datetime.now(UTC) <= timedelta(seconds=60)
    with pytest.raises(UnknownKey, match="'cart 10'"):
        client.rotate_key("cart 10")
    with pytest.raises(InvalidRequest, match="overlap_s"):
        client.rotate_key("cart 9", -1)
    client.revoke_key("cart 9")
    found = client.keys()
    assert "cart 9" not in [key.name for key in found]
    with pytest.raises(UnknownKey, match="'cart 9'"):
        client.revoke_key("cart 9")
