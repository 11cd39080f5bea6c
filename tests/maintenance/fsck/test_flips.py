"""One flipped byte, anywhere: named, and nothing else is; then healed, or quarantined."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sceneprint.engine import Engine
from sceneprint.maintenance.fsck.findings import Finding

HALL = 12
INDEX = ("keys", "faiss", "json")


def flip(path: Path, at: int, bit: int = 0) -> None:
    with path.open("r+b") as file:
        file.seek(at)
        (byte,) = file.read(1)
        file.seek(at)
        file.write(bytes([byte ^ 1 << bit]))


def place_of(house: Any, kind: str, rng: np.random.Generator) -> tuple[Path, int, str]:
    """A byte of a file of that kind, and the frame, or the path, that fsck should name."""
    frames = house.sql(
        "SELECT f.id, f.blob, s.geometry, s.vector FROM frames f JOIN signatures s"
        " ON s.frame_number = f.number JOIN maps m ON m.number = f.map_number"
        " WHERE m.name = 'hall' ORDER BY f.number"
    )
    frame_id, upload, artifact, _ = frames[rng.integers(len(frames))]
    if kind == "signature":
        path = house.data / "sceneprint.db"
        data = path.read_bytes()
        # whichever lies there alone, and on one page: some are split, or like another's
        alone = [(one[0], one[3]) for one in frames if data.count(one[3]) == 1]
        frame_id, vector = alone[rng.integers(len(alone))]
        return path, data.index(vector) + int(rng.integers(len(vector))), frame_id
    if kind in ("upload", "artifact"):
        path = house.blob(upload if kind == "upload" else artifact)
        return path, int(rng.integers(path.stat().st_size)), frame_id
    where = house.place / "cache" if kind == "table" else house.data / "index"
    found = sorted(where.rglob("table-*" if kind == "table" else f"*.{kind}"))
    path = found[rng.integers(len(found))]
    return path, int(rng.integers(path.stat().st_size)), str(path)


def kind_of(kind: str) -> str:
    return "damaged-index" if kind in INDEX else f"damaged-{kind}"


def named(finding: Finding) -> str | None:
    return finding.frame_id or str(finding.path)


@pytest.mark.sqlite_only("looks at the database as a file of the data folder")
@pytest.mark.parametrize("times", [4, pytest.param(12, marks=pytest.mark.thorough)])
@pytest.mark.parametrize("kind", [*INDEX, "table", "artifact", "upload", "signature"])
def test_a_flipped_byte_is_named_and_nothing_else_is(house: Any, kind: str, times: int) -> None:
    rng = np.random.default_rng(7)
    assert house.look() == []
    before = house.files()
    for _ in range(times):
        path, at, what = place_of(house, kind, rng)
        bit = int(rng.integers(8))
        flip(path, at, bit)
        flipped = house.files()
        (found,) = house.look()
        assert (found.finding.kind, named(found.finding)) == (kind_of(kind), what)
        assert (found.finding.severity, found.done, found.left) == ("damage", None, True)
        assert found.finding.would
        assert house.files() == flipped  # to look changes nothing
        flip(path, at, bit)
    assert house.files() == before
    assert house.look() == []


@pytest.mark.parametrize("kind", INDEX)
def test_a_damaged_index_is_removed_and_made_again(
    house: Any, kind: str, truth: Any, uploads: Any
) -> None:
    path, at, _ = place_of(house, kind, np.random.default_rng(3))
    flip(path, at)
    (found,) = house.look(repair=True)
    assert found.done is not None
    assert not path.exists()
    assert house.look() == []
    assert house.answers(uploads[:HALL]) == truth
    with Engine(house.settings) as engine:
        engine.publish_due()
        answer = engine.queries.upload(["hall"], uploads[0].data, uploads[0].meta, ask())
    assert answer.index_generation > 0
    assert house.look() == []
    assert house.answers(uploads[:HALL]) == truth


def ask() -> Any:
    from sceneprint_client.api import Query

    return Query(stages=("retrieve",))


def test_a_damaged_table_is_removed_and_built_again(house: Any) -> None:
    path, at, _ = place_of(house, "table", np.random.default_rng(3))
    sound = path.read_bytes()
    flip(path, at)
    (found,) = house.look(repair=True)
    assert found.done == "removed"
    assert not path.exists()
    with Engine(house.settings) as engine:
        engine.warm()
    assert path.read_bytes() == sound


def test_a_damaged_artifact_is_quarantined_and_made_again(
    house: Any, truth: Any, uploads: Any
) -> None:
    path, at, frame_id = place_of(house, "artifact", np.random.default_rng(3))
    sound = path.read_bytes()
    flip(path, at)
    damaged = path.read_bytes()
    (found,) = house.look(repair=True)
    assert found.done is not None
    (kept,) = (house.data / "quarantine").iterdir()
    assert kept.read_bytes() == damaged
    assert str(kept) in found.done
    (known,) = house.look()  # nothing is left to be done but the job
    assert (known.finding.severity, known.finding.frame_id) == ("note", frame_id)
    assert not known.left
    assert house.answers(uploads[:HALL]) == truth  # found meanwhile
    before = house.sql("SELECT revision FROM maps WHERE name = 'hall'")
    assert set(house.work()) == {"succeeded"}
    assert path.read_bytes() == sound
    assert house.look() == []
    # the same signature: no reader and no index has anything to learn
    assert house.sql("SELECT revision FROM maps WHERE name = 'hall'") == before


@pytest.mark.sqlite_only("looks at the database as a file of the data folder")
def test_a_damaged_signature_is_quarantined_and_made_again(
    house: Any, truth: Any, uploads: Any
) -> None:
    path, at, frame_id = place_of(house, "signature", np.random.default_rng(3))
    vector = "SELECT vector FROM signatures JOIN frames ON number = frame_number WHERE id = ?"
    ((sound,),) = house.sql(vector, frame_id)
    flip(path, at)
    ((damaged,),) = house.sql(vector, frame_id)
    (found,) = house.look(repair=True)
    assert found.done is not None
    (kept,) = (house.data / "quarantine").iterdir()
    assert kept.read_bytes() == damaged != sound
    assert house.sql("SELECT state FROM frames WHERE id = ?", frame_id) == [("received",)]
    assert house.look() == []
    for index in (house.data / "index").glob("hall*"):
        index.rename(house.place / "away")  # else it answers, which holds the sound bytes
    others = [[one for one in each if one[0] != frame_id] for each in truth]
    assert house.answers(uploads[:HALL]) == others
    assert set(house.work()) == {"succeeded"}
    assert house.sql(vector, frame_id) == [(sound,)]
    assert house.look() == []
    assert house.answers(uploads[:HALL]) == truth


def test_a_damaged_upload_costs_no_search_and_may_come_again(
    house: Any, truth: Any, uploads: Any
) -> None:
    path, at, frame_id = place_of(house, "upload", np.random.default_rng(3))
    sound = path.read_bytes()
    flip(path, at)
    damaged = path.read_bytes()
    (found,) = house.look(repair=True)
    assert found.done is not None
    (kept,) = (house.data / "quarantine").iterdir()
    assert kept.read_bytes() == damaged
    assert not path.exists()
    with Engine(house.settings) as engine:
        frame = engine.get_frame("hall", frame_id)
        assert (frame.state, frame.reason) == (
            "indexed",
            "its upload is damaged: it can be found, but not signed again; upload it again to heal",
        )
    assert house.answers(uploads[:HALL]) == truth
    (known,) = house.look()
    assert (known.finding.severity, known.finding.frame_id, known.left) == ("note", frame_id, False)
    (own,) = (each for each in uploads if each.data == sound)
    with Engine(house.settings) as engine:
        added, new = engine.add_frame("hall", own.data, own.meta)
        assert (added.frame_id, added.reason, new) == (frame_id, None, False)
        assert engine.get_frame("hall", frame_id).reason is None
    assert path.read_bytes() == sound
    assert house.look() == []


def test_the_upload_of_a_frame_that_is_not_signed_yet_fails_it(house: Any, uploads: Any) -> None:
    asked = "SELECT id, blob FROM frames WHERE state = 'received'"
    ((frame_id, blob),) = house.sql(asked)
    sound = house.blob(blob).read_bytes()
    flip(house.blob(blob), 100)
    (found,) = house.look(repair=True)
    assert found.finding.frame_id == frame_id
    assert house.sql("SELECT state, reason FROM frames WHERE id = ?", frame_id) == [
        ("failed", "its upload is damaged: it cannot be signed; upload it again to heal")
    ]
    assert house.work() == []  # its job is over
    (known,) = house.look()
    assert (known.finding.severity, known.finding.frame_id) == ("note", frame_id)
    (own,) = (each for each in uploads if each.data == sound)
    with Engine(house.settings) as engine:
        added, new = engine.add_frame("attic", own.data, own.meta)
    assert (added.frame_id, new) == (frame_id, True)
    assert house.work() == ["succeeded"]
    assert house.look() == []


@pytest.mark.sqlite_only("looks at the database as a file of the data folder")
@pytest.mark.parametrize("others", ["artifact", "signature"])
def test_what_was_made_of_a_lost_upload_cannot_be_made_again(
    house: Any, others: str, truth: Any, uploads: Any
) -> None:
    """Two faults at once: nothing is left but to say so, until the upload comes again."""
    rng = np.random.default_rng(5)
    path, at, frame_id = place_of(house, others, rng)
    flip(path, at)
    ((blob,),) = house.sql("SELECT blob FROM frames WHERE id = ?", frame_id)
    house.blob(blob).unlink()
    kinds = [each.finding.kind for each in house.look(repair=True)]
    ((state, reason),) = house.sql("SELECT state, reason FROM frames WHERE id = ?", frame_id)
    assert "its upload is lost" in reason
    if others == "artifact":
        assert kinds == ["missing-upload", "damaged-artifact"]
        assert state == "indexed"
    else:  # not found any more either, though the index holds a sound copy
        assert kinds == ["damaged-signature", "missing-upload"]
        assert state == "failed"
        truth = [[one for one in each if one[0] != frame_id] for each in truth]
    assert house.answers(uploads[:HALL]) == truth
    assert house.work() == ["succeeded"]  # that of the frame which waited anyway
    again = house.look()
    assert {each.finding.severity for each in again} == {"note"}
    assert {each.finding.frame_id for each in again} == {frame_id}
