"""Tests that other users of the machine cannot read a data folder, whatever the umask."""

import os
from contextlib import suppress

import pytest

from sceneprint.atomic_files import make_folder, public_mode
from sceneprint.bundle.backup import take_backup
from sceneprint.bundle.restoration import restore_to_folder
from sceneprint_client.api import NewMap, Query
from tests.whole_engine import Engine


@pytest.fixture
def no_umask():
    before = os.umask(0)
    yield
    os.umask(before)


def public_paths(folder):
    """What in a folder anybody but its owner may read, write or enter; its own name is `.`."""
    results = set[str]()
    for path in (folder, *folder.rglob("*")):
        with suppress(FileNotFoundError):  # an answer that is being written gets its name
            results |= {str(path.relative_to(folder))} if path.stat().st_mode & 0o077 else set()
    return results


@pytest.mark.sqlite_only("looks at the database as a file of the data folder")
def test_all_that_is_made_is_its_owners_alone(no_umask, tmp_path, uploads, settings):
    data = tmp_path / "new" / "data"
    with Engine(settings(data)) as engine:
        engine.create_map(NewMap(name="hall", model="depth"))
        for each in uploads[:3]:
            engine.add_frame("hall", each.data, each.meta)
        engine.work_off()
        engine.rebuild_index("hall")
        engine.queries.upload(["hall"], uploads[0].data, uploads[0].meta, Query(keep=True))
        assert {path.name for path in data.iterdir()} >= {
            "sceneprint.db", "sceneprint.db-wal", "sceneprint.db-shm", "blobs", "index",
        }  # fmt: skip
        assert len(list((data / "index").rglob("*.json"))) == 1
        assert public_paths(data.parent) == set()
    assert list((data / "queries").iterdir())  # written by then
    assert public_paths(data.parent) == set()
    take_backup(settings(data), str(tmp_path / "place"))
    restore_to_folder(str(tmp_path / "place"), tmp_path / "restored")
    closed = [tmp_path / "place", *(tmp_path / "place").glob("[bp]*s")]
    assert [path.stat().st_mode & 0o777 for path in closed] == [0o700] * 3
    assert len(list((tmp_path / "restored").rglob("*"))) > 6
    assert public_paths(tmp_path / "restored") == set()


def test_a_folder_that_is_there_keeps_its_permissions(no_umask, tmp_path):
    (tmp_path / "data").mkdir(0o755)
    make_folder(tmp_path / "data" / "blobs")
    assert public_paths(tmp_path / "data") == {"."}
    assert public_mode(tmp_path / "data") == 0o755
    (tmp_path / "data").chmod(0o750)  # a group is somebody's decision
    assert public_mode(tmp_path / "data") is None
    (tmp_path / "file").touch()
    with pytest.raises(FileExistsError):
        make_folder(tmp_path / "file")
