"""Tests of damaged database files and indexes, and of missing folders."""

import shutil

import pytest

from sceneprint.errors import UnusableStore
from sceneprint_client.api import NewMap, Query
from tests.whole_engine import Engine


@pytest.mark.sqlite_only("looks at the database as a file of the data folder")
def test_an_index_that_contradicts_its_table_keeps_all_hands_off(house):
    """Else a frame whose row names another blob would seem to have lost its upload."""
    ((blob,),) = house.sql("SELECT blob FROM frames WHERE number = 1")
    path = house.data / "sceneprint.db"
    data = bytearray(path.read_bytes())
    places, at = [], data.find(blob.encode())
    while at >= 0:
        places.append(at)
        at = data.find(blob.encode(), at + 1)
    assert len(places) >= 2  # the table, and the index over its blobs
    for place in places:
        changed = bytearray(data)
        changed[place] = ord("0") if data[place] != ord("0") else ord("1")
        path.write_bytes(changed)
        before = house.files()
        actual = house.look(repair=True)
        assert actual[0].kind == "damaged-database"
        assert all(item.done is None for item in actual)
        now = house.files()
        assert {k: v for k, v in now.items() if "sceneprint.db" not in k} == {
            k: v for k, v in before.items() if "sceneprint.db" not in k
        }


def test_a_row_that_refers_to_none_keeps_all_hands_off(house):
    house.sql("UPDATE maps SET model_id = 'ff' || SUBSTR(model_id, 3) WHERE name = 'hall'")
    actual = house.look(repair=True)
    assert actual[0].kind == "dangling-row"
    assert actual[0].what == "row 1 of table maps"
    assert all(item.done is None for item in actual)
    assert house.sql("SELECT COUNT(*) FROM signatures") == [(13,)]


def test_a_damaged_model_that_ships_is_put_back(house):
    with Engine(house.settings) as engine:
        engine.create_map(NewMap(name="other", model="depth"))
    ((sound,),) = house.sql("SELECT content FROM models WHERE name = 'depth'")
    damaged = bytearray(sound)
    damaged[-3] ^= 4
    house.sql("UPDATE models SET content = ? WHERE name = 'depth'", bytes(damaged))
    (actual,) = house.look()
    assert (actual.kind, actual.left) == ("damaged-model", True)
    assert [finding.left for finding in house.look(repair=True)] == [False]
    assert house.sql("SELECT content FROM models WHERE name = 'depth'") == [(sound,)]
    assert house.look() == []


@pytest.mark.sqlite_only("looks at the database as a file of the data folder")
@pytest.mark.parametrize("name", ["blobs", "sceneprint.db"])
def test_a_folder_that_is_not_there_is_not_taken_for_one_that_has_lost_all(house, name):
    (house.data / name).rename(house.place / "away")
    before = house.files()
    for repair in (False, True):
        with pytest.raises(UnusableStore, match=r"The folder does not exist|There is no database"):
            house.look(repair=repair, grace_s=0)
    assert house.files() == before
    (house.place / "away").rename(house.data / name)
    assert house.look() == []


def test_an_empty_folder_of_blobs_is_not_taken_for_the_loss_of_all(house):
    (house.data / "blobs").rename(house.place / "away")
    (house.data / "blobs").mkdir()  # the mount point of a disk that is not mounted
    before = house.sql("SELECT state, reason FROM frames ORDER BY number")
    with pytest.raises(UnusableStore, match="has no uploads"):
        house.look(repair=True)
    assert house.sql("SELECT state, reason FROM frames ORDER BY number") == before
    assert {finding.kind for finding in house.look()} >= {"missing-upload"}  # looking goes on


def test_a_quick_look_sees_what_is_missing(house):
    ((blob, other),) = house.sql(
        "SELECT a.blob, b.blob FROM frames a, frames b WHERE a.number = 1 AND b.number = 2"
    )
    house.blob(blob).unlink()
    house.blob(other).write_bytes(b"other bytes")
    actual = [finding.kind for finding in house.look(quick=True)]
    assert actual == ["missing-upload"]


@pytest.mark.sqlite_only("looks at the database as a file of the data folder")
def test_a_log_that_was_not_emptied_is_read_and_left(house, tmp_path):
    with Engine(house.settings) as engine:
        engine.get_map("hall")
        with engine.store.database.write() as connection:
            connection.exec_driver_sql("DELETE FROM frame_tags WHERE tag = 'all'")
        killed = tmp_path / "killed"
        shutil.copytree(house.place, killed)
    assert {path.name for path in (killed / "data").glob("sceneprint.db-*")} == {
        "sceneprint.db-shm",
        "sceneprint.db-wal",
    }
    other = type(house)(killed)
    before = other.files()
    assert {finding.kind for finding in other.look()} == {"stale-value"}
    assert other.files() == before
    (killed / "data" / "sceneprint.db-shm").unlink()  # as in a copy
    assert {finding.kind for finding in other.look()} == {"stale-value"}
    now = other.files()
    assert now.pop("data/sceneprint.db-shm", None)
    assert now == {k: v for k, v in before.items() if not k.endswith("-shm")}


@pytest.mark.parametrize("kind", ["keys", "faiss", "json"])
def test_a_damaged_index_is_removed_and_made_again(house, kind, truth, uploads):
    path = house.index_files(kind)[0]
    house.damage(path)
    (actual,) = house.look(repair=True)
    assert (actual.kind, actual.path, actual.done) == (
        "damaged-index", path.parent, "the index is removed"
    )  # fmt: skip
    assert [path.suffix for path in path.parent.iterdir() if path.name != ".lock"] == []
    assert house.look() == []
    assert house.answers(uploads[:12]) == truth
    with Engine(house.settings) as engine:
        engine.publish_due()
        ask = Query(stages=("retrieve",))
        answer = engine.queries.upload(["hall"], uploads[0].data, uploads[0].meta, ask)
    assert answer.index_version > 0
    assert house.look() == []
    assert house.answers(uploads[:12]) == truth


def test_an_index_that_differs_from_the_database_is_made_again(house, uploads):
    house.sql(  # both frames have the signature of the second, with its checksum
        "UPDATE signatures SET (vector, checksum) = (SELECT vector, checksum FROM signatures"
        " WHERE frame_number = 2) WHERE frame_number = 1"
    )
    house.sql("UPDATE frames SET revision = 1 WHERE number = 14")  # of `attic`: no index there
    (actual,) = house.look(repair=True)
    ((first,),) = house.sql("SELECT id FROM frames WHERE number = 1")
    assert (actual.kind, actual.left) == ("damaged-index", False)
    assert actual.means == f"lacks the signatures of frames {first}"
    assert house.look() == []
    with Engine(house.settings) as engine:
        assert engine.publish_due() == 1
        query = Query(stages=("retrieve",), k=2)
        answer = engine.queries.upload(["hall"], uploads[1].data, uploads[1].meta, query)
    assert [match.distance for match in answer.matches] == [0, 0]
    assert answer.index_version == 1
    assert house.look() == []
