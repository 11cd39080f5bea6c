"""Tests of damaged or contradictory rows and signatures."""

import zlib

import pytest

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
    "a tag too many": (
        f"INSERT INTO frame_tags VALUES ({FIRST}, 'other')",
        "stale-value",
        f"SELECT tag FROM frame_tags WHERE frame_number = {FIRST} ORDER BY tag",
        [("all",), ("view-0",)],
    ),
    "a revision beyond the map's": (
        "UPDATE maps SET revision = 11 WHERE name = 'hall'",
        "revision-ahead",
        "SELECT revision FROM maps WHERE name = 'hall'",
        [(12,)],
    ),
    "a revision that no map can have": (
        f"UPDATE frames SET revision = 9223372036854775807 WHERE number = {FIRST}",
        "revision-ahead",
        "SELECT MAX(frames.revision), maps.revision FROM frames JOIN maps"
        " ON map_number = maps.number WHERE maps.name = 'hall' GROUP BY maps.revision",
        [(13, 13)],
    ),
}


def faults(findings):
    return [finding for finding in findings if finding.kind != "damaged-model"]


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_named_and_repaired(house, fault):
    changes, kind, request, after = FAULTS[fault]
    for change in changes if isinstance(changes, tuple) else (changes,):
        house.sql(change)
    before = house.files()
    actual = faults(house.look())
    assert [item.kind for item in actual] == [kind]
    assert actual[0].frame_id
    assert actual[0].left
    assert house.files() == before
    assert [fault.left for fault in faults(house.look(repair=True))] == [False]
    assert house.sql(request) == after
    assert faults(house.look()) == []


def test_what_a_map_is_counted_to_hold(house):
    statement = "SELECT used_frames, used_bytes FROM maps ORDER BY number"
    before = house.sql(statement)
    house.sql("UPDATE maps SET used_frames = used_frames + 1 WHERE name = 'hall'")
    assert house.look(quick=True) == house.look(map_name="attic") == []
    [actual] = house.look()
    assert (actual.kind, actual.map) == ("stale-value", "hall")
    assert f"usage is {before[0][0] + 1} frames with {before[0][1]} bytes" in actual.means
    assert [finding.left for finding in house.look(repair=True)] == [False]
    assert (house.sql(statement), house.look()) == (before, [])


def test_one_map_is_looked_at_alone(house):
    house.sql(f"INSERT INTO frame_tags VALUES ({FIRST}, 'other')")  # of `hall`
    house.sql(f"UPDATE jobs SET state = 'cancelled' WHERE frame_number = {WAITING}")  # of `attic`
    (house.data / "blobs" / "notes.txt").write_text("mine")
    kinds = {
        name: [one.kind for one in house.look(map_name=name)] for name in ("hall", "attic", None)
    }
    assert kinds == {
        "hall": ["stale-value"],
        "attic": ["frame-without-job"],
        None: ["foreign-file", "stale-value", "frame-without-job"],
    }


@pytest.mark.sqlite_only("PostgreSQL holds no such row")
def test_a_row_that_cannot_be_read_does_not_hide_the_others(house):
    house.sql("UPDATE frames SET tags = '[\"all' WHERE number = 3")
    house.sql("UPDATE frames SET state = 'indexee' WHERE number = 4")
    house.sql("UPDATE frames SET pose_x = 7 WHERE number = 5")
    (tags, state, position) = house.look(repair=True)
    assert [tags.kind, state.kind] == ["unreadable-row"] * 2
    assert (tags.what, state.what) == ("frame number 3", "frame number 4")
    assert (tags.left, state.left, position.left) == (True, True, False)
    assert position.kind == "stale-value"


def test_a_damaged_signature_is_made_again(house, truth, uploads):
    statement = "SELECT * FROM signatures ORDER BY frame_number"
    sound, checksum = house.sql(statement), zlib.crc32(b"\0")  # which fits: the length does not
    change = "UPDATE signatures SET {} WHERE frame_number = {}".format
    house.sql(change("vector = SUBSTR(vector, 2) || SUBSTR(vector, 1, 1)", 1))
    house.sql(change("vector = ?, checksum = ?", 3), b"\0", checksum)
    numbers = [1, 3]
    if house.is_sqlite:  # PostgreSQL holds no such row
        house.sql(change("n_pairs = CAST(x'5b31ff5d' AS TEXT)", 5))
        numbers.append(5)
    house.sql("UPDATE frames SET novelty = 1.0 WHERE number = 1")  # others like it came since
    actual = house.look(repair=True)
    assert [(item.kind, item.done) for item in actual] == [
        ("damaged-signature", "a worker signs it again from its upload")
    ] * len(numbers)
    assert house.look() == []
    assert house.sql("SELECT COUNT(*) FROM doomed") == [(len(numbers),)]  # their artifacts
    rows = house.sql(f"SELECT id FROM frames WHERE number IN {tuple(numbers)}")
    others = {frame_id for each in house.answers(uploads[:12]) for frame_id, _ in each}
    assert others
    assert not others & {frame_id for (frame_id,) in rows}
    assert set(house.work()) == {"succeeded"}
    assert [row for row in house.sql(statement) if row[0] <= 13] == [o for o in sound if o[0] <= 13]
    assert house.look() == []
    assert house.answers(uploads[:12]) == truth
