"""Rows that contradict each other: named, and brought together again."""

from __future__ import annotations

import zlib
from typing import Any

import pytest

from sceneprint.engine import Engine
from sceneprint.store.tables import frames
from sceneprint_client.api import Query

FIRST = "(SELECT MIN(number) FROM frames WHERE state = 'indexed')"
WAITING = "(SELECT number FROM frames WHERE state = 'received')"

#: What is done to the database; the finding; a question, and its answer after the repair.
FAULTS = {
    "no job": (
        f"UPDATE jobs SET state = 'cancelled' WHERE frame_number = {WAITING}",
        "frame-without-job",
        f"SELECT state FROM jobs WHERE frame_number = {WAITING} ORDER BY number",
        [("cancelled",), ("queued",)],
    ),
    "left by a worker": (
        (
            f"UPDATE frames SET state = 'signing' WHERE number = {WAITING}",
            "UPDATE jobs SET state = 'dead' WHERE state = 'queued'",
        ),
        "frame-without-job",
        "SELECT state FROM frames WHERE number = (SELECT MAX(number) FROM frames)",
        [("received",)],
    ),
    "no signature": (
        f"DELETE FROM signatures WHERE frame_number = {FIRST}",
        "frame-without-signature",
        # found no more until it is signed, and readers learn of it
        "SELECT state, frames.revision = maps.revision FROM frames "
        "JOIN maps ON map_number = maps.number WHERE frames.number = 1",
        [("received", 1)],
    ),
    "a signature of a frame that waits": (
        f"INSERT INTO signatures SELECT {WAITING}, model_id, vector, checksum, geometry,"
        f" n_patches, n_pairs FROM signatures WHERE frame_number = {FIRST}",
        "stray-signature",
        f"SELECT COUNT(*) FROM signatures WHERE frame_number = {WAITING}",
        [(0,)],
    ),
    "a signature of another model": (
        (
            "INSERT INTO models SELECT 'other', name, content, created_at FROM models",
            "INSERT INTO signatures SELECT frame_number, 'other', vector, checksum, geometry,"
            f" n_patches, n_pairs FROM signatures WHERE frame_number = {FIRST}",
        ),
        "stray-signature",
        f"SELECT COUNT(*) FROM signatures WHERE frame_number = {FIRST}",
        [(1,)],
    ),
    "a tag too many": (
        f"INSERT INTO frame_tags VALUES ({FIRST}, 'other')",
        "other-tags",
        f"SELECT tag FROM frame_tags WHERE frame_number = {FIRST} ORDER BY tag",
        [("all",), ("view-0",)],
    ),
    "a tag that is not there": (
        f"DELETE FROM frame_tags WHERE frame_number = {FIRST} AND tag = 'all'",
        "other-tags",
        f"SELECT tag FROM frame_tags WHERE frame_number = {FIRST} ORDER BY tag",
        [("all",), ("view-0",)],
    ),
    "another position": (
        f"UPDATE frames SET pose_y = pose_y + 1 WHERE number = {FIRST}",
        "other-position",
        # another sample of the same view
        "SELECT pose_y = (SELECT pose_y FROM frames WHERE number = 2) FROM frames WHERE number = 1",
        [(1,)],
    ),
    "a revision beyond the map's": (
        "UPDATE maps SET revision = 11 WHERE name = 'hall'",
        "revision-ahead",
        "SELECT revision FROM maps WHERE name = 'hall'",
        [(12,)],
    ),
    "a reason that holds no more": (
        "UPDATE frames SET reason = 'its upload is lost: it can be found, but not signed again;"
        f" upload it again to heal' WHERE number = {FIRST}",
        "found-upload",
        "SELECT reason FROM frames WHERE number = 1",
        [(None,)],
    ),
}


def told(outcomes: Any) -> list[Any]:
    """All but what a fault of these brings with it."""
    brought = ("damaged-model", "foreign-index")
    return [one for one in outcomes if one.finding.kind not in brought]


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_named_and_repaired(house: Any, fault: str) -> None:
    changes, kind, asked, after = FAULTS[fault]
    for change in changes if isinstance(changes, tuple) else (changes,):
        house.sql(change)
    before = house.files()
    found = told(house.look())
    assert [one.finding.kind for one in found] == [kind]
    assert found[0].finding.frame_id
    assert found[0].left
    assert house.files() == before
    assert [one.left for one in told(house.look(repair=True))] == [False]
    assert house.sql(asked) == after
    assert told(house.look()) == []


def test_what_a_map_is_counted_to_hold(house: Any) -> None:
    asked = "SELECT used_frames, used_bytes FROM maps ORDER BY number"
    before = house.sql(asked)
    house.sql("UPDATE maps SET used_frames = used_frames + 1 WHERE name = 'hall'")
    assert house.look(quick=True) == house.look(map_name="attic") == []
    [found] = house.look()
    assert (found.finding.kind, found.finding.map) == ("other-use", "hall")
    assert f"to hold {before[0][0] + 1} frames of {before[0][1]} bytes" in found.finding.means
    assert [one.left for one in house.look(repair=True)] == [False]
    assert (house.sql(asked), house.look()) == (before, [])


def test_what_is_repaired_is_signed(house: Any, truth: Any, uploads: Any) -> None:
    house.sql(f"DELETE FROM signatures WHERE frame_number = {FIRST}")
    house.sql(f"UPDATE jobs SET state = 'cancelled' WHERE frame_number = {WAITING}")
    assert [one.left for one in house.look(repair=True)] == [False, False]
    assert house.work() == ["succeeded", "succeeded"]
    assert house.look() == []
    assert house.answers(uploads[:12]) == truth


def test_one_map_is_looked_at_alone(house: Any) -> None:
    house.sql(f"INSERT INTO frame_tags VALUES ({FIRST}, 'other')")  # of `hall`
    house.sql(f"UPDATE jobs SET state = 'cancelled' WHERE frame_number = {WAITING}")  # of `attic`
    (house.data / "blobs" / "notes.txt").write_text("mine")
    kinds = {
        name: [one.finding.kind for one in house.look(map_name=name)]
        for name in ("hall", "attic", None)
    }
    assert kinds == {
        "hall": ["other-tags"],
        "attic": ["frame-without-job"],
        None: ["other-tags", "frame-without-job", "foreign-file"],
    }


@pytest.mark.sqlite_only("PostgreSQL holds no such row")
def test_a_row_that_cannot_be_read_does_not_hide_the_others(house: Any) -> None:
    """Its tags are no JSON; nothing can say what they were."""
    house.sql("UPDATE frames SET tags = '[\"all' WHERE number = 3")
    house.sql("UPDATE frames SET state = 'indexee' WHERE number = 4")
    house.sql("UPDATE frames SET pose_x = 7 WHERE number = 5")
    (tags, state, position) = house.look(repair=True)
    assert [tags.finding.kind, state.finding.kind] == ["unreadable-row"] * 2
    assert (tags.finding.what, state.finding.what) == ("frame number 3", "frame number 4")
    assert (tags.left, state.left, position.left) == (True, True, False)
    assert position.finding.kind == "other-position"


@pytest.mark.sqlite_only("PostgreSQL holds no such row")
def test_a_signature_whose_counts_cannot_be_read_is_made_again(house: Any) -> None:
    sound = house.sql("SELECT * FROM signatures ORDER BY frame_number")
    house.sql("UPDATE signatures SET n_pairs = CAST(x'5b31ff5d' AS TEXT) WHERE frame_number = 3")
    house.sql("UPDATE signatures SET n_patches = '[1, 2, 3]' WHERE frame_number = 5")
    checksum = zlib.crc32(b"\0")  # which fits: the length alone does not
    house.sql("UPDATE signatures SET vector = x'00', checksum = ? WHERE frame_number = 7", checksum)
    found = house.look(repair=True)
    assert [one.finding.kind for one in found] == ["damaged-signature"] * 3
    assert [one.left for one in found] == [False] * 3
    assert house.look() == []
    assert set(house.work()) == {"succeeded"}
    made = house.sql("SELECT * FROM signatures ORDER BY frame_number")
    assert [one for one in made if one[0] <= 13] == [one for one in sound if one[0] <= 13]


def test_an_index_that_differs_from_the_database_is_made_again(
    house: Any, truth: Any, uploads: Any
) -> None:
    """All its checksums hold: it was made of other signatures, or lacks one."""
    house.sql(  # both frames have the signature of the second, with its checksum
        "UPDATE signatures SET (vector, checksum) = (SELECT vector, checksum FROM signatures"
        " WHERE frame_number = 2) WHERE frame_number = 1"
    )
    house.sql("UPDATE frames SET revision = 1 WHERE number = 14")  # of `attic`: no index there
    (found,) = house.look(repair=True)
    assert found.finding.kind == "other-index"
    ((first,),) = house.sql("SELECT id FROM frames WHERE number = 1")
    assert found.finding.means.endswith(f": frames {first}")
    assert not found.left
    assert house.look() == []
    with Engine(house.settings) as engine:
        assert engine.publish_due() == 1
        query = Query(stages=("retrieve",), k=2)
        answer = engine.queries.upload(["hall"], uploads[1].data, uploads[1].meta, query)
    assert [match.distance for match in answer.matches] == [0, 0]
    assert answer.index_generation == 1
    assert house.look() == []


def test_an_index_that_lacks_a_frame_is_made_again(house: Any) -> None:
    """As one that was published while a signature was damaged."""
    columns = {column.name: column.name for column in frames.columns}
    columns |= {"number": "99", "id": "'ff'", "content_id": "'ff'"}
    house.sql(  # a frame of `hall` that its index has never heard of, though as old as others
        f"INSERT INTO frames ({', '.join(columns)})"
        f" SELECT {', '.join(columns.values())} FROM frames WHERE number = 1"
    )
    house.sql(
        "INSERT INTO signatures SELECT 99, model_id, vector, checksum, geometry, n_patches,"
        " n_pairs FROM signatures WHERE frame_number = 1"
    )
    house.sql("INSERT INTO frame_tags SELECT 99, tag FROM frame_tags WHERE frame_number = 1")
    house.sql(
        "UPDATE maps SET used_frames = used_frames + 1,"
        " used_bytes = used_bytes + (SELECT bytes FROM frames WHERE number = 99)"
        " WHERE name = 'hall'"
    )
    (found,) = house.look(repair=True)
    assert (found.finding.kind, found.left) == ("other-index", False)
    assert found.finding.means.endswith(": frames ff")
    assert list((house.data / "index").glob("hall*/*.json")) == []
