"""`sceneprint audit`: verified against itself and a copy, exported to a file and a log server."""

from __future__ import annotations

import hashlib
import json
import re
import socket
import sqlite3
import threading
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from sceneprint.cli import audit, main
from sceneprint.engine import Engine
from sceneprint.settings import Settings
from sceneprint.store.audit_chain import KeyChange
from sceneprint.store.blobs.object_client import Objects, open_objects

Run = Callable[..., Any]


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A data folder with three lines of two keys."""
    with Engine(Settings(data_dir=tmp_path / "data", database_url=None)) as engine:
        engine.audit.note(KeyChange("create_map", "robot", "192.0.2.7", "hall", at=1e9))
        engine.audit.note(KeyChange("delete_map", "screen", "192.0.2.8", "hall", refused=True))
        engine.audit.note(KeyChange("delete_map", "robot", "192.0.2.7", "hall"))
    return tmp_path / "data"


def _change(data: Path, statement: str) -> None:
    with closing(sqlite3.connect(data / "sceneprint.db")) as database, database:
        database.execute(statement)


@pytest.mark.sqlite_only("changes its file")
def test_a_changed_line_is_named(sceneprint: Run, data: Path) -> None:
    done = sceneprint("audit", "verify", "--data", data)
    assert re.fullmatch(
        r"no change found in 3 entries of 2 chains; head [0-9a-f]{64}\n", done.stdout
    )
    assert sceneprint("audit", "verify", "--data", data).stdout == done.stdout
    _change(data, "UPDATE audit SET map = 'yard' WHERE number = 3")
    found = sceneprint("audit", "verify", "--data", data, expect=1)
    assert found.stdout == (
        "entry 2 of the changes of robot (line 3): its content or its hash was changed\n"
    )
    assert "compare it with an exported copy" in found.stderr
    _change(data, "DELETE FROM audit WHERE number = 2")
    lines = sceneprint("audit", "verify", "--data", data, expect=1).stdout.splitlines()
    assert lines[1] == "entry 1 of the refusals of screen: it was removed"


@pytest.mark.sqlite_only("changes its file")
def test_a_file_gets_what_it_lacks_and_is_compared(
    sceneprint: Run, data: Path, tmp_path: Path
) -> None:
    copy = tmp_path / "audit.jsonl"
    export = ("audit", "--export", copy, "--data", data)
    assert sceneprint(*export).stdout == f"3 entries exported to {copy}\n"
    assert copy.stat().st_mode & 0o777 == 0o600
    assert sceneprint(*export).stdout == f"0 entries exported to {copy}\n"
    with Engine(Settings(data_dir=data, database_url=None)) as engine:
        engine.audit.note(KeyChange("edit_map", "screen"))
    with copy.open("a") as file:
        file.write('{"at": "2026')  # whoever wrote it died
    assert sceneprint(*export).stdout == f"1 entry exported to {copy}\n"
    lines = [json.loads(line) for line in copy.read_text().splitlines()]
    assert [(one["actor"], one["refused"], one["sequence"]) for one in lines] == [
        ("robot", False, 1), ("screen", True, 1), ("robot", False, 2), ("screen", False, 1),
    ]  # fmt: skip
    against = ("audit", "verify", "--against", copy, "--data", data)
    assert "no change found in 4 entries of 3 chains; " in sceneprint(*against).stdout
    # somebody rewrites all of it, hashes and all
    for table in ("audit", "audit_chains"):
        _change(data, f"DELETE FROM {table}")
    with Engine(Settings(data_dir=data, database_url=None)) as engine:
        engine.audit.note(KeyChange("create_map", "robot", "192.0.2.7", "hall", at=1e9))
    verified = sceneprint("audit", "verify", "--data", data).stdout
    assert verified.startswith("no change found in 1 entry of 1 chain; ")
    told = sceneprint(*against, expect=1).stdout.splitlines()
    assert [line.rpartition(": ")[2] for line in told] == [
        "its chain is gone", "it is gone", "its chain is gone",
    ]  # fmt: skip
    copy.write_text("no line\n")
    done = sceneprint(*against, expect=2)
    assert "line 1: it is not an exported audit entry" in done.stderr


def _stored(objects: Objects) -> dict[str, list[tuple[str | None, int | None]]]:
    """Actor and place of the entries of each object, by its key."""
    found = {}
    for one in objects.list(""):
        lines = [json.loads(line) for line in objects.get(one.key).splitlines()]
        found[one.key] = [(line["actor"], line["sequence"]) for line in lines]
    return found


def _chain(tenant: str, kind: str) -> str:
    return f"audit/{hashlib.sha256(tenant.encode()).hexdigest()[:32]}-{kind}"


def test_an_object_store_gets_each_entry_once(
    sceneprint: Run, data: Path, bucket: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = f"{bucket}/log"
    export = ("audit", "--export", url, "--data", data)
    assert sceneprint(*export).stdout == f"3 entries exported to {url}\n"
    objects = open_objects(url)
    robot, screen = _chain("robot", "changes"), _chain("screen", "refusals")
    first = {
        f"{robot}/000000000001-000000000002.jsonl": [("robot", 1), ("robot", 2)],
        f"{screen}/000000000001-000000000001.jsonl": [("screen", 1)],
    }
    assert _stored(objects) == first
    assert sceneprint(*export).stdout == f"0 entries exported to {url}\n"
    with Engine(Settings(data_dir=data, database_url=None)) as engine:
        for _ in range(5):
            engine.audit.note(KeyChange("edit_map", "robot"))
    monkeypatch.setattr(audit, "_OBJECT_LINES", 2)
    put = Objects.put

    def die(*given: Any, **how: Any) -> bool:
        """As a process that is killed between two objects."""
        monkeypatch.setattr(Objects, "put", _killed)
        return put(*given, **how)

    def _killed(*_: Any, **__: Any) -> bool:
        raise KeyboardInterrupt

    monkeypatch.setattr(Objects, "put", die)
    assert main([str(one) for one in export]) == 130
    monkeypatch.setattr(Objects, "put", put)
    assert sceneprint(*export).stdout == f"3 entries exported to {url}\n"
    assert _stored(objects) == first | {
        f"{robot}/{a:012d}-{b:012d}.jsonl": [("robot", n) for n in range(a, b + 1)]
        for a, b in ((3, 4), (5, 6), (7, 7))
    }
    objects.delete(f"{robot}/000000000005-000000000006.jsonl")
    against = ("audit", "verify", "--against", url, "--data", data)
    assert "the 2 entries before it are missing" in sceneprint(*against, expect=2).stderr
    assert sceneprint(*export).stdout == f"2 entries exported to {url}\n"
    assert "no change found in 8 entries of 2 chains; " in sceneprint(*against).stdout


@pytest.mark.sqlite_only("changes its file")
def test_the_objects_reveal_a_log_that_was_rewritten(
    sceneprint: Run, data: Path, bucket: str
) -> None:
    sceneprint("audit", "--export", bucket, "--data", data)
    against = ("audit", "verify", "--against", bucket, "--data", data)
    assert sceneprint(*against).stdout.startswith("no change found in 3 entries of 2 chains; ")
    for table in ("audit", "audit_chains"):
        _change(data, f"DELETE FROM {table}")
    with Engine(Settings(data_dir=data, database_url=None)) as engine:
        engine.audit.note(KeyChange("create_map", "robot", "192.0.2.7", "yard", at=1e9))
    told = sceneprint(*against, expect=1).stdout.splitlines()
    assert sorted(line.rpartition(": ")[2] for line in told) == [
        "it has another hash", "it is gone", "its chain is gone",
    ]  # fmt: skip
    objects = open_objects(bucket)
    key = f"{_chain('robot', 'changes')}/000000000001-000000000002.jsonl"
    objects.put(key, objects.get(key).splitlines(keepends=True)[0])
    done = sceneprint(*against, expect=2)
    assert f"{bucket}/{key}: it does not hold the entries that its name says" in done.stderr


def test_a_log_server_gets_messages_of_rfc_5424(sceneprint: Run, data: Path) -> None:
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as server:
        server.settimeout(30)
        server.bind(("127.0.0.1", 0))
        url = f"syslog://127.0.0.1:{server.getsockname()[1]}"
        sceneprint("audit", "--export", url, "--since", "1h", "--data", data)
        sent = [server.recv(65536).decode() for _ in range(2)]
    head = re.compile(r"<109>1 \d{4}-\d\d-\d\dT[\d:.]{12}Z \S+ sceneprint - audit - (\{.*\})")
    found = [json.loads(head.fullmatch(one)[1]) for one in sent]  # type: ignore[index]
    assert [(one["actor"], one["refused"]) for one in found] == [("screen", True), ("robot", False)]


def test_over_tcp_each_message_has_its_length(sceneprint: Run, data: Path) -> None:
    with closing(socket.create_server(("127.0.0.1", 0))) as server:
        taken: list[bytes] = []

        def serve() -> None:
            connection, _ = server.accept()
            with connection, connection.makefile("rb") as file:
                taken.append(file.read())

        thread = threading.Thread(target=serve)
        thread.start()
        url = f"syslog+tcp://127.0.0.1:{server.getsockname()[1]}"
        sceneprint("audit", "--export", url, "--actor", "robot", "--data", data)
        thread.join()
    (left,), count = taken, 0
    while left:
        length, _, rest = left.partition(b" ")
        assert rest.startswith(b"<109>1 ")
        assert json.loads(rest[: int(length)].partition(b" audit - ")[2])["actor"] == "robot"
        left, count = rest[int(length) :], count + 1
    assert count == 2


@pytest.mark.parametrize("url", ["syslog://", "syslog://host:none"])
def test_a_log_server_needs_a_host(sceneprint: Run, data: Path, url: str) -> None:
    done = sceneprint("audit", "--export", url, "--data", data, expect=2)
    assert "Use syslog://HOST or syslog+tcp://HOST." in done.stderr


def test_a_log_server_that_is_not_there_is_named(sceneprint: Run, data: Path) -> None:
    with closing(socket.socket()) as unheard:
        unheard.bind(("127.0.0.1", 0))  # and listens not
        url = f"syslog+tcp://127.0.0.1:{unheard.getsockname()[1]}"
        done = sceneprint("audit", "--export", url, "--data", data, expect=2)
    assert f"{url}: Connection refused after 0 entries. Check host and port" in done.stderr


@pytest.mark.parametrize(
    ("given", "why"),
    [
        (["--against", "copy"], "--against applies to a check only."),
        (["--since", "1h"], "--since applies to an export only."),
        (["--export", "s3://bucket", "--actor", "robot"], "--actor would leave gaps"),
        (["verify", "--export", "copy"], "`verify` checks and --export copies."),
    ],
)
def test_options_that_would_be_ignored_are_refused(
    sceneprint: Run, data: Path, given: list[str], why: str
) -> None:
    assert why in sceneprint("audit", *given, "--data", data, expect=2).stderr
