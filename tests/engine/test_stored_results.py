"""Stored results: whole or absent, bounded, and a failure never costs a query its answer."""

from __future__ import annotations

import os
import struct
import threading
import uuid
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sceneprint.engine.results import stored_results
from sceneprint.engine.results import stored_results as module
from sceneprint.engine.results.stored_results import (
    SCHEMA_VERSION,
    ResultFolder,
    StoredResult,
    StoredResults,
)
from sceneprint.errors import UnknownQuery
from sceneprint.store.blobs.object_client import open_objects
from sceneprint.store.frame_queries import QueryOrigin
from sceneprint_client.api import Answer, Counts, Query, SeveralQuery

COUNTS = Counts(map=0, passed=0, compared=0, ranked=0, selected=0, validated=0, accepted=0)


def made(size: int = 1000, query: Query | None = None) -> StoredResult:
    """An answer whose file takes a little more than `size` bytes."""
    answer = Answer(
        query_id=uuid.uuid4().hex, status="not_found", matches=[], location=None, seed=3,
        model="m", index_generation=0, exact=True, counts=COUNTS,
        milliseconds={"total": 0.1 + 0.2}, maps=["hall"],
    )  # fmt: skip
    vector = np.frombuffer(os.urandom(64), np.uint8)
    return StoredResult(answer, query or Query(), "ab" * 32, vector, os.urandom(size), (7, 3))


def _kept(queries: StoredResults, one: StoredResult) -> str:
    assert queries.keep(one)
    return one.answer.query_id


def aged(folder: Path, query_id: str, seconds: float) -> None:
    """Make a file older than it is."""
    then = (folder / query_id).stat().st_mtime - seconds
    os.utime(folder / query_id, (then, then))


def there(folder: Path) -> set[str]:
    return {one.name for one in folder.iterdir()}


def test_an_answer_comes_back_as_it_was(tmp_path: Path) -> None:
    queries = ResultFolder(tmp_path / "new", 60.0, 1 << 20)
    asked = Query(k=2, seed=9, validation={"evidence": 0.35}, filter={"robot": "r1"})
    for one in (made(query=asked), replace(made(), geometry=None), replace(made(), geometry=b"")):
        assert queries.keep(one)
        again = queries.find(one.answer.query_id)
        assert again.answer.model_dump_json() == one.answer.model_dump_json()
        assert again.query == one.query
        assert (again.model_id, again.geometry, again.at) == (one.model_id, one.geometry, one.at)
        assert (again.ranked, again.vector.tobytes()) == ((7, 3), one.vector.tobytes())
        assert (again.taken, again.base) == (one.taken, None)
    # what was left out is as the map's model has it, and not as `paper`
    again = queries.find(_kept(queries, made(query=asked)))
    assert again.query.validation is not None
    assert again.query.validation.model_fields_set == {"evidence"}
    base = ("base_link", np.arange(16.0).reshape(4, 4))
    robot = replace(made(), taken=QueryOrigin("r1", "run", 12.5), base=base)
    again = queries.find(_kept(queries, robot))
    assert again.taken == QueryOrigin("r1", "run", 12.5)
    assert again.base is not None
    assert again.base[0] == "base_link"
    assert (again.base[1] == base[1]).all()
    several = made(query=SeveralQuery(maps=["hall", "attic"], k=4))
    assert queries.keep(several)
    assert queries.find(several.answer.query_id).query == Query(k=4)


@pytest.mark.parametrize(
    "name", ["", ".", "..", "../secret", "a" * 31, "A" * 32, "g" * 32, "a" * 32 + "\n", "b" * 32]
)
def test_no_other_name_is_opened(tmp_path: Path, name: str) -> None:
    queries = ResultFolder(tmp_path / "kept", 60.0, 1 << 20)
    one = made()
    assert queries.keep(one)
    data = (tmp_path / "kept" / one.answer.query_id).read_bytes()
    (tmp_path / "secret").write_bytes(data)
    for other in ("A" * 32, "a" * 32 + "\n"):
        (tmp_path / "kept" / other).write_bytes(data)
    with pytest.raises(UnknownQuery, match="expired"):
        queries.find(name)


def test_every_damaged_byte_is_noticed(tmp_path: Path) -> None:
    queries = ResultFolder(tmp_path, 60.0, 1 << 20)
    one = made(50)
    assert queries.keep(one)
    path = tmp_path / one.answer.query_id
    data = path.read_bytes()
    for place in range(0, len(data), 5):
        path.write_bytes(data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :])
        with pytest.raises(UnknownQuery):
            queries.find(path.name)
    for length in range(0, len(data), 7):
        path.write_bytes(data[:length])
        with pytest.raises(UnknownQuery):
            queries.find(path.name)
    path.write_bytes(data)
    assert queries.find(path.name).answer == one.answer


def test_what_is_old_is_not_found_and_goes(tmp_path: Path) -> None:
    queries = ResultFolder(tmp_path, 60.0, 1 << 20)
    old, young, new = made(), made(), made()
    assert queries.keep(old)
    assert queries.keep(young)
    aged(tmp_path, old.answer.query_id, 61.0)
    aged(tmp_path, young.answer.query_id, 50.0)
    (tmp_path / ".abandoned.part").write_bytes(b"half")
    aged(tmp_path, ".abandoned.part", 61.0)
    (tmp_path / ".begun.part").write_bytes(b"half")
    with pytest.raises(UnknownQuery):
        queries.find(old.answer.query_id)
    assert queries.find(young.answer.query_id).answer == young.answer
    assert ResultFolder(tmp_path, 60.0, 1 << 20).keep(new)  # another process looks at once
    assert there(tmp_path) == {young.answer.query_id, new.answer.query_id, ".begun.part"}


def test_the_oldest_go_when_there_is_no_room(tmp_path: Path) -> None:
    most = 20_500
    queries = ResultFolder(tmp_path, 3600.0, most)
    names = []
    for age in range(60, 0, -1):
        one = made(1000)
        assert queries.keep(one)
        aged(tmp_path, one.answer.query_id, age)
        names.append(one.answer.query_id)
        assert sum(path.stat().st_size for path in tmp_path.iterdir()) <= most
    left = there(tmp_path)
    assert left == set(names[-len(left) :])
    assert 8 <= len(left) <= 20
    assert not queries.keep(made(most))  # would push out all, and not fit
    assert there(tmp_path) == left
    assert not ResultFolder(tmp_path, 3600.0, 0).keep(made(1))


def test_two_processes_share_the_room(tmp_path: Path) -> None:
    most = 100_000
    both = [ResultFolder(tmp_path, 3600.0, most) for _ in range(2)]
    for turn in range(180):
        assert both[turn % 2].keep(made(1000))
        # each puts at most 16 there before it looks at what the other did
        assert sum(path.stat().st_size for path in tmp_path.iterdir()) <= most + 17 * 2000


def test_their_number_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_QUERIES", 40)
    queries = ResultFolder(tmp_path, 3600.0, 1 << 30)
    for _ in range(100):
        assert queries.keep(made(1))
    assert 20 <= len(there(tmp_path)) <= 40 + 16


def test_a_folder_that_cannot_be_written_costs_nothing(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    queries = ResultFolder(tmp_path / "file" / "kept", 60.0, 1 << 20)
    one = made()
    assert not queries.keep(one)
    with pytest.raises(UnknownQuery):
        queries.find(one.answer.query_id)


def test_answers_go_when_they_are_old_or_too_many(monkeypatch: pytest.MonkeyPatch) -> None:
    objects = open_objects("memory:///")
    kept = stored_results.ResultObjects(objects, 3600.0, 10_000, purge_s=3600.0)
    many = [made(1000) for _ in range(12)]
    assert all(kept.keep(one) for one in many)
    left = {key.rpartition("/")[2] for key in [one.key for one in objects.list("queries/")]}
    assert left == {one.answer.query_id for one in many[-len(left) :]}  # the newest
    assert 4 <= len(left) < 10
    newest = many[-1].answer.query_id
    again = kept.find(newest)
    assert (again.answer, again.geometry) == (many[-1].answer, many[-1].geometry)
    assert not kept.keep(made(10_000))
    for name in (many[0].answer.query_id, "../sceneprint.json", "0" * 32):
        with pytest.raises(UnknownQuery):
            kept.find(name)
    # of another process, that died: whoever goes through them all removes them
    other = stored_results.ResultObjects(objects, 3600.0, 10_000, purge_s=3600.0)
    assert other.forget(lambda one: one.answer.query_id != newest) == 1
    with pytest.raises(UnknownQuery):
        kept.find(newest)
    assert other.forget(lambda _: False) == 0  # it was done just now
    objects.delete("queries/.looked")
    short = stored_results.ResultObjects(objects, 0.0, 10_000)
    assert short.forget(lambda _: True) == len(left) - 1
    assert [one.key for one in objects.list("queries/")] == ["queries/.looked"]
    one = made(10)
    assert short.keep(one)
    with pytest.raises(UnknownQuery):
        short.find(one.answer.query_id)
    monkeypatch.setattr(stored_results, "_UNDER_WAY", 0)
    assert not stored_results.ResultObjects(objects, 1.0, 10_000).keep(one)


def test_what_cannot_be_kept_costs_no_answer(bucket: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    monkeypatch.setattr("sceneprint.store.blobs.object_client.TRIED_S", 0)
    kept = stored_results.ResultObjects(open_objects(bucket), 60.0, 10_000)
    assert not kept.keep(made(10))
    for one in threading.enumerate():
        if one.name == "keep":
            one.join()


def test_what_is_no_answer_keeps_no_other_from_being_forgotten() -> None:
    objects = open_objects("memory:///")
    kept = stored_results.ResultObjects(objects, 3600.0, 1 << 20)
    assert kept.keep(made(10))
    longer = struct.pack("<5sHIIII", b"SPQRY", SCHEMA_VERSION, 0, 1 << 30, 0, 0)
    for name, data in (("a", b""), ("b", longer)):  # without a byte, and shorter than it says
        objects.put(f"queries/{32 * name}", data)
    assert kept.forget(lambda _: False) == 3
