"""Archives that are not as they were written, by accident or on purpose: refused, or the same."""

from __future__ import annotations

import hashlib
import io
import json
import random
import sqlite3
import tarfile
from collections.abc import Callable
from contextlib import closing
from operator import methodcaller
from pathlib import Path
from typing import Any

import pytest

from sceneprint.errors import DamagedSnapshot, NewerSchema, SnapshotError, UnusableStore
from sceneprint.maintenance.snapshot.restoration import restore_snapshot, verify_snapshot

Members = list[tuple[tarfile.TarInfo, bytes]]


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture
def refused(tmp_path: Path) -> Callable[..., str]:
    """Check that bytes are refused as an archive and leave nothing; returns what is said."""

    def check(data: bytes, text: str = "bad.tar", kind: type[Exception] = DamagedSnapshot) -> str:
        path = tmp_path / "bad.tar"
        path.write_bytes(data)
        with pytest.raises(kind, match=text) as raised:
            restore_snapshot(path, tmp_path / "new")
        assert "\n" not in str(raised.value)
        assert names_in(tmp_path) == ["bad.tar"]
        with pytest.raises(kind, match=text):
            verify_snapshot(path)
        return str(raised.value)

    return check


@pytest.fixture(scope="session")
def places(archive: Path) -> dict[str, list[tuple[int, int]]]:
    """Where in the archive the bytes of each kind are."""
    found: dict[str, list[tuple[int, int]]] = {"header": [], "padding": []}
    with tarfile.open(archive) as tar:
        for member in tar:
            found["header"].append((member.offset, member.offset + 512))
            end = member.offset_data + member.size
            kind = member.name.partition("/")[0]
            if member.name == "manifest.json":
                text = len(tar.extractfile(member).read().rstrip())  # type: ignore[union-attr]
                found["blanks"] = [(member.offset_data + text, end)]
                found[kind] = [(member.offset_data, member.offset_data + text)]
            elif member.size:
                found.setdefault(kind, []).append((member.offset_data, end))
            if end % 512:
                found["padding"].append((end, -(-end // 512) * 512))
    size = archive.stat().st_size
    found["padding"].append((size - 1024, size))
    return found


def test_one_byte_is_another(archive, places, tmp_path, content):
    """Anywhere: what comes back is what was there, or nothing does."""
    rng, good = random.Random(8), archive.read_bytes()
    sound = restore_snapshot(archive, tmp_path / "sound")
    expected = content(tmp_path / "sound")
    harmless = 0
    for kind, n in (
        ("manifest.json", 24), ("blanks", 4), ("header", 24), ("sceneprint.db", 16), ("blobs", 16),
        ("padding", 8),
    ):  # fmt: skip
        for _ in range(n):
            first, last = rng.choice(places[kind])
            where = rng.randrange(first, last)
            flipped = bytearray(good)
            flipped[where] ^= rng.choice([1, 32, 128, rng.randrange(1, 256)])
            (tmp_path / "bad.tar").write_bytes(flipped)
            try:
                taken = restore_snapshot(tmp_path / "bad.tar", tmp_path / f"{kind}{where}")
            except SnapshotError:
                assert names_in(tmp_path) == ["bad.tar", "sound"]
                continue
            assert kind in ("manifest.json", "blanks", "header"), (
                where
            )  # all other bytes are held to
            assert taken.manifest == sound.manifest
            assert content(tmp_path / f"{kind}{where}") == expected
            (tmp_path / f"{kind}{where}").rename(tmp_path / "sound" / f"{kind}{where}")
            harmless += 1
    assert harmless < 14  # such as blanks of the manifest that become others


def test_the_end_is_missing(archive, refused):
    good, rng = archive.read_bytes(), random.Random(3)
    size = len(good)
    for length in (0, 1, 511, 512, 2559, 2560, size - 1, size - 512, size - 1024):
        refused(good[:length])
    for _ in range(12):
        refused(good[: rng.randrange(size)])


def test_something_follows(archive, refused):
    good = archive.read_bytes()
    for more in (b"x", bytes(1), bytes(512), good):
        refused(good + more)
    longer = rebuilt(members_of(archive), bytes=len(good) + 512)
    refused(longer + bytes(511) + b"x", "something follows its end")


def members_of(archive: Path) -> Members:
    with tarfile.open(archive) as tar:
        return [(one, tar.extractfile(one).read()) for one in tar]  # type: ignore[union-attr]


def rebuilt(members: Members, **changed: Any) -> bytes:
    """An archive whose manifest fits what is in it, as by somebody who means harm."""
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w", format=tarfile.GNU_FORMAT) as tar:
        for member, data in members:
            member.size = len(data) if member.isreg() else member.size
            tar.addfile(member, io.BytesIO(data))
        end = tar.offset + 1024
    data = bytearray(out.getvalue()[:end])
    held = {member.name: each for member, each in members}
    record = json.loads(held["manifest.json"])
    record |= {"bytes": end} | changed
    del record["sha256"]
    text = json.dumps(record, sort_keys=True, separators=(",", ":"))
    record["sha256"] = hashlib.sha256(text.encode()).hexdigest()
    line = json.dumps(record).encode()
    assert len(line) < len(held["manifest.json"])
    data[512 : 512 + len(held["manifest.json"])] = line.ljust(len(held["manifest.json"]))
    return bytes(data)


def entry(name: str, data: bytes = b"x", kind: bytes = tarfile.REGTYPE) -> tuple[Any, bytes]:
    member = tarfile.TarInfo(name)
    member.type = kind
    if kind in (tarfile.SYMTYPE, tarfile.LNKTYPE):
        member.linkname = "/etc/passwd"
    return member, data if kind == tarfile.REGTYPE else b""


def test_rebuilt_as_it_was_it_is_taken(archive, tmp_path, content):
    (tmp_path / "same.tar").write_bytes(rebuilt(members_of(archive)))
    for path, name in ((archive, "one"), (tmp_path / "same.tar", "two")):
        restore_snapshot(path, tmp_path / name)
    assert content(tmp_path / "one") == content(tmp_path / "two")


@pytest.mark.parametrize(
    "added",
    [
        entry("../evil"), entry("/tmp/evil"), entry("blobs/../../evil"), entry("blobs/" + "0" * 64),
        entry("blobs/" + "f" * 64), entry("sceneprint.db"), entry("sceneprint.db-wal"),
        entry("blobs", kind=tarfile.DIRTYPE), entry("link", kind=tarfile.SYMTYPE),
        entry("blobs/" + "0" * 64, kind=tarfile.SYMTYPE), entry("hard", kind=tarfile.LNKTYPE),
        entry("pipe", kind=tarfile.FIFOTYPE), entry("disk", kind=tarfile.BLKTYPE),
        entry("sparse", kind=tarfile.GNUTYPE_SPARSE), entry("x" * 300),
    ],
    ids=lambda one: f"{one[0].type.decode()} {one[0].name[:20]}",
)  # fmt: skip
def test_a_member_too_many(archive, refused, added):
    """Anywhere, and whatever the manifest says of how many there are."""
    members = members_of(archive)
    for place in (0, 1, 2, 5, len(members) - 1, len(members)):
        data = rebuilt([*members[:place], added, *members[place:]])
        refused(data)
    assert not Path("/tmp/evil").exists()


def test_blobs_that_are_not_as_the_database_says(archive, refused):
    members = members_of(archive)
    manifest = json.loads(members[0][1])
    blobs = manifest["blobs"]
    first, second = members[2], members[3]
    less = {"count": blobs["count"] - 1, "bytes": blobs["bytes"] - len(first[1])}
    refused(rebuilt([*members[:2], *members[3:]]))
    refused(rebuilt([*members[:2], *members[3:]], blobs=less), "a blob is missing")
    refused(rebuilt([*members[:2], second, first, *members[4:]]), "a blob is missing")
    more = {"count": blobs["count"] + 1, "bytes": blobs["bytes"] + len(first[1])}
    refused(rebuilt([*members[:3], first, *members[3:]], blobs=more))
    changed = [*members[:2], (first[0], b"?" * len(first[1])), *members[3:]]
    refused(rebuilt(changed), "has other bytes than were written")
    refused(rebuilt(members, blobs=less), "others than its manifest says")
    refused(rebuilt([*members[:-1], entry("other", members[-1][1])]), "that nothing refers to")


def test_a_list_of_damaged_blobs_that_lies(archive, tmp_path, refused):
    """One that is missing must be named, and one that is named must be missing."""
    members = members_of(archive)
    manifest = json.loads(members[0][1])
    blobs, (first, data) = manifest["blobs"], members[2]
    digest = first.name.removeprefix("blobs/")
    less = {"count": blobs["count"] - 1, "bytes": blobs["bytes"] - len(data)}

    def with_list(
        body: Members, named: str, blobs: dict[str, int], why: str = "missing", **told: object
    ) -> bytes:
        line = json.dumps({"digest": named, "why": why}).encode() + b"\n"
        fits = {"count": 1, "bytes": len(line), "sha256": hashlib.sha256(line).hexdigest()}
        return rebuilt([*body[:-1], (body[-1][0], line)], damaged=fits | told, blobs=blobs)

    without = [*members[:2], *members[3:]]
    (tmp_path / "ok.tar").write_bytes(with_list(without, digest, less))
    assert [one.digest for one in verify_snapshot(tmp_path / "ok.tar").damaged] == [digest]
    (tmp_path / "ok.tar").unlink()
    refused(with_list(without, "0" * 64, less), "other blobs are missing than it says")
    refused(with_list(without, digest, less, count=0), "a blob is missing")
    refused(with_list(members, digest, blobs), "other blobs are missing than it says")
    refused(with_list(without, digest, less, why="gone"), "its list of damaged blobs is none")
    refused(with_list(without, digest, less, sha256="0" * 64), "is not the one that was written")


def test_databases_that_are_none_of_ours(archive, tmp_path, refused):
    members = members_of(archive)

    def with_database(change: Callable[[sqlite3.Connection], object]) -> bytes:
        path = tmp_path / "changed.db"
        path.write_bytes(members[1][1])
        with closing(sqlite3.connect(path)) as database:
            change(database)
            database.commit()
        data = path.read_bytes()
        path.unlink()
        return with_bytes(data)

    def with_bytes(data: bytes) -> bytes:
        told = {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
        return rebuilt([members[0], (members[1][0], data), *members[2:]], database=told)

    def later(database: sqlite3.Connection) -> None:
        database.execute("UPDATE alembic_version SET version_num = '9999'")

    refused(with_database(later), "9999", NewerSchema)
    refused(
        with_database(lambda database: database.execute("DELETE FROM maps")),
        "a row of (frames|jobs) refers to one of maps that is missing",
    )
    sql = "UPDATE frames SET state = 'failed' WHERE state = 'received'"
    refused(with_database(lambda database: database.execute(sql)), "another than its manifest says")
    told = json.loads(members[0][1])["schema_revision"]
    refused(rebuilt(members, schema_revision=told + "x"), "another than its manifest says")
    for odd, name in (
        ("VIEW v AS SELECT 1", "view 'v'"),
        ("TRIGGER t AFTER INSERT ON models BEGIN DELETE FROM maps; END", "trigger 't'"),
        ("VIRTUAL TABLE r USING rtree(a, b, c)", "table 'r'"),
        ("TABLE g (a, b AS (zeroblob(900000000)))", "column 'b' of 'g' is generated"),
    ):
        made = with_database(methodcaller("execute", f"CREATE {odd}"))
        refused(made, rf"its database is none of sceneprint's \({name}")
    page = bytearray(members[1][1])
    page[4096 * 3 : 4096 * 4] = bytes(4096)
    refused(with_bytes(bytes(page)), "its database is not sound")
    refused(with_bytes(b"x" * 8192), "bad.tar", UnusableStore)


@pytest.mark.parametrize("name", ["{}/evil/x", "../x", b"ab", b"\xff", 5])
def test_what_is_no_digest_names_no_file(archive, tmp_path, refused, name):
    """Not the path of a file that is written before it is found to be another."""
    name = name.format(tmp_path / "..") if isinstance(name, str) else name
    members = members_of(archive)
    (tmp_path / "a.db").write_bytes(members[1][1])
    with closing(sqlite3.connect(tmp_path / "a.db")) as database:
        one = "(SELECT min(number) FROM frames WHERE state = 'indexed')"
        given = "CAST(? AS TEXT)" if name == b"\xff" else "?"
        database.execute(f"UPDATE frames SET blob = {given} WHERE number = {one}", (name,))
        database.commit()
    data = (tmp_path / "a.db").read_bytes()
    (tmp_path / "a.db").unlink()
    told = {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    body = [members[0], (members[1][0], data), entry(f"blobs/{name}", b"evil"), *members[2:]]
    refused(rebuilt(body, database=told))
    assert not (tmp_path / ".." / "evil").exists()


def test_a_later_version(archive, refused):
    members = members_of(archive)
    said = refused(rebuilt(members, version=3), "a snapshot of version 3", SnapshotError)
    assert "Restore it with the sceneprint that took it" in said
    refused(rebuilt(members, format="other"), "no snapshot of sceneprint")
    refused(rebuilt(members, more=1), "no snapshot of sceneprint, or its manifest is damaged")
    refused(rebuilt(members, maps="1"), "no snapshot of sceneprint, or its manifest is damaged")


def test_what_it_promises_must_fit(archive, refused):
    """Sizes are believed only as far as the file is long: nothing else is made room for."""
    members = members_of(archive)
    huge = {"bytes": 1 << 60, "sha256": "0" * 64}
    refused(rebuilt(members, database=huge), "promises more than it holds")
    with tarfile.open(archive) as tar:
        member = tar.getmembers()[2]  # a blob

    def with_header(size: int, kind: bytes = tarfile.REGTYPE) -> bytes:
        member.size, member.type = size, kind
        data = bytearray(archive.read_bytes())
        data[member.offset : member.offset + 512] = member.tobuf(tarfile.GNU_FORMAT)
        return bytes(data)

    sound = with_header(size := member.size)
    assert len(sound) == archive.stat().st_size
    refused(with_header(1 << 40), "it is cut short")
    refused(with_header(-1), "a member is no plain file")
    for kind in (tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE, tarfile.GNUTYPE_SPARSE):
        refused(with_header(size, kind), "a member is no plain file")
