"""Tests of deletions during a backup, which is complete and can be restored."""

import threading
import time

import pytest

from sceneprint.bundle.backup import take_backup
from sceneprint.bundle.restoration import verify_bundle
from tests.whole_engine import Engine


@pytest.mark.sqlite_only("looks at the database as a file of the data folder")
def test_what_is_deleted_meanwhile_is_in_it(data, tmp_path, settings, rows):
    """All frames go as soon as the database was copied, and no blob has been."""
    with Engine(settings(data)) as engine:
        before = set(engine.store.blobs.digests())
        frames = [one.frame_id for one in engine.list_frames("hall").items]

        def delete(_done, _total):
            while frames:
                engine.delete_frame("hall", frames.pop())

        taken = take_backup(settings(data), str(tmp_path / "place"), delete)
        assert frames == []
        assert taken.lost == ()
        assert taken.manifest.blobs == 9
        assert set(engine.store.blobs.digests()) == before
        assert verify_bundle(str(tmp_path / "place")).lost == ()
        assert rows(data, "SELECT DISTINCT state FROM frames") == [("deleted",)]


def test_after_it_deletions_remove_blobs_again(data, tmp_path, settings):
    with Engine(settings(data)) as engine:
        blobs = engine.store.blobs
        count = len(list(blobs.digests()))
        first, second, *_ = [one.frame_id for one in engine.list_frames("hall").items]
        with blobs.block_removals(), blobs.block_removals():  # two backups do not mind each other
            engine.delete_frame("hall", first)
        assert len(list(blobs.digests())) == count
        engine.delete_frame("hall", second)
        assert len(list(blobs.digests())) == count - 2  # those of the first are for fsck
        take_backup(settings(data), str(tmp_path / "place"))
        engine.delete_map("hall")
        assert len(list(blobs.digests())) == 2  # the artifact of the first, and the orphan


def test_a_sweep_under_way_is_waited_for(data, tmp_path, settings):
    """Before the database is copied: the copy must not refer to what the sweep removes."""
    taken = []
    with Engine(settings(data)) as engine:
        (frame, *_) = [one.frame_id for one in engine.list_frames("hall").items]

        def take():
            taken.append(take_backup(settings(data), str(tmp_path / "place")))

        thread = threading.Thread(target=take)
        with engine.store.blobs.removing() as allowed:
            assert allowed
            with engine.store.blobs.removing() as second:
                assert not second
            thread.start()
            while not (tmp_path / "place").exists():
                time.sleep(0.01)
            time.sleep(0.3)
            assert list((tmp_path / "place").glob("parts/??")) == []
            assert thread.is_alive()
            engine.delete_frame("hall", frame)
        thread.join()
    assert taken[0].lost == ()
    assert taken[0].manifest.frames == {"deleted": 2, "indexed": 3, "received": 1}
    assert taken[0].manifest.blobs == 7
