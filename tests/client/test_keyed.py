"""Tests that every client method requires a key, and of the methods that manage keys."""

import inspect
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta

import pytest

from sceneprint.errors import Conflict, KeyRequired, UnknownKey
from sceneprint_client import Client
from sceneprint_client.api.coverage import MapCoverage

ID = "0" * 32
#: Arguments of every call by their names in its signature.
GIVEN = {
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


def test_no_call_gets_by_without_a_key(remote, references, tmp_path):
    """Each method of the client, by its signature: a new one is asked as well."""
    remote._http.headers["X-Forwarded-For"] = "192.0.2.7"  # as behind a proxy
    archive = tmp_path / "archive.zip"
    archive.write_bytes(b"PK")
    own = GIVEN | {
        "frame": references[0], "frames": [references[0]], "archive": archive,
        "file": archive, "path": archive, "target": tmp_path / "target", "into": tmp_path / "into",
        "deletion_id": "0",
    }  # fmt: skip
    names = []
    for name, method in inspect.getmembers(Client, inspect.isfunction):
        if name.startswith("_") or name in OPEN | {"wait_for_product"}:
            continue
        needed = {
            parameter.name: own[parameter.name]
            for parameter in list(inspect.signature(method).parameters.values())[1:]
            if parameter.default is inspect.Parameter.empty
            and parameter.kind is not inspect.Parameter.VAR_KEYWORD
        }
        if name in ("query", "localize"):
            needed = {"map_name": "hall", "frame_id": ID}

        def call(name=name, needed=needed):
            result = getattr(remote, name)(**needed)
            if isinstance(result, Iterator):
                next(result)

        with pytest.raises(KeyRequired):
            call()
        names.append(name)
    assert len(names) > 50
    assert remote.healthy()
    assert (remote.status().frames, remote.status().jobs) == (None, None)


def test_keys_are_made_listed_rotated_and_revoked(embedded):
    until = datetime.now(UTC) + timedelta(hours=1)
    key = embedded.create_key("cart 9", {"hall": "write", "yard": "read"}, until)
    assert (key.name, key.grants) == ("cart 9", {"hall": "write", "yard": "read"})
    assert key.expires_at == until
    keys = embedded.keys()
    (listed,) = [key for key in keys if key.name == "cart 9"]
    assert listed.model_dump() == key.model_dump(exclude={"secret"})
    with pytest.raises(Conflict, match="A key named 'cart 9' already exists"):
        embedded.create_key("cart 9", {"*": "read"})
    me = embedded.me()
    assert (me.name, me.grants) == (None, {"*": "admin"})
    turned = embedded.rotate_key("cart 9", 60)
    assert (turned.secret != key.secret, turned.grants) == (True, key.grants)
    assert turned.previous_until - datetime.now(UTC) <= timedelta(seconds=60)
    embedded.revoke_key("cart 9")
    keys = embedded.keys()
    assert "cart 9" not in [key.name for key in keys]
    with pytest.raises(UnknownKey, match="'cart 9'"):
        embedded.revoke_key("cart 9")
    embedded.create_map("yard", model="depth")
    assert [line.action for line in embedded.audit(map_name="yard")] == ["map.created"]
