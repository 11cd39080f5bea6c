"""Tests that no file and no table contains bytes of a deleted frame.

A test first finds the bytes in each possible place, and then none after the deletion.
"""

import hashlib
import re
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import inspect, text

from sceneprint.atomic_files import folder_turn
from sceneprint.engine.ingest.uploads import Upload
from sceneprint.engine.search.local_index import index_folder
from sceneprint.engine.upkeep import purge
from sceneprint.engine.upkeep.purge import Purging
from sceneprint.errors import BusyIndex, UnknownJob, UnknownQuery
from sceneprint.index.index_manifest import newest_number
from sceneprint.index.index_version import newest
from sceneprint.maintenance.fsck.check import fsck
from sceneprint.store.frames import delete_frame, write_frame
from sceneprint.store.maps import find_frame, find_map, geometry_blobs
from sceneprint.store.signatures import stored_vector
from sceneprint_client.api import NewMap, Query
from sceneprint_client.api.surface import NewReconstruction

#: Bytes of a piece that is looked for, and pieces of each thing.
PIECE, MANY = 24, 40


def pieces(data, others):
    results = []
    for start in np.linspace(0, len(data) - PIECE, 8 * MANY).astype(int).tolist():
        piece = data[start : start + PIECE]
        if len(set(piece)) > PIECE // 3 and not any(piece in other for other in others):
            results.append(piece)
    assert len(results) > MANY // 2
    return results[:: max(len(results) // MANY, 1)]


def files(folder):
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            yield str(path.relative_to(folder)), path.read_bytes()


def rows(engine):
    if engine.store.database.is_sqlite:
        return  # it is one of the files
    with engine.store.database.read() as connection:
        for table in inspect(connection).get_table_names():
            result = connection.execute(text(f'SELECT t::text FROM "{table}" t')).scalars()
            for row in result:
                raw = b"".join(map(bytes.fromhex, re.findall(r"x([0-9a-f]{40,})", row)))
                yield f"table {table}", row.encode() + raw


def places(engine, folder, wanted):
    """Kinds of files, and tables, in which any of some pieces is."""
    results = set()
    for name, data in (*files(folder), *rows(engine)):
        if any(piece in data for piece in wanted):
            kind = name.removeprefix("data/").partition("/")[0].removesuffix("-wal")
            results.add(f"{kind} {Path(name).suffix}" if kind == "index" else kind)
    return results


@pytest.fixture
def lived_in(make_engine, store_url, uploads, tmp_path):
    """A map whose index was published twice."""
    (tmp_path / "data" / "blobs").mkdir(parents=True)  # of a database that is there nobody makes it
    settings = {"database_url": store_url, "unindexed_frames": 2}
    engine = make_engine(tmp_path / "data", **settings)
    engine.create_map(NewMap(name="hall", model="depth"))
    for upload in uploads[:6]:
        meta = upload.meta.model_copy(update={"tags": ["by-the-door"], "session": "one-morning"})
        engine.uploads.add("hall", Upload(upload.data, meta))
        if upload in (uploads[2], uploads[5]):
            engine.work_off()
            assert engine.publish_due() == 1
    return engine


@pytest.fixture
def secret(lived_in, uploads):
    """What of the first frame is looked for."""
    engine = lived_in
    with engine.store.database.read() as connection:
        row = find_map(connection, "hall")
        numbers = [find_frame(connection, row, name).number for name in engine.ids()]
        vectors = [stored_vector(connection, n, row.model_id) or b"" for n in numbers]
        blobs = geometry_blobs(connection, numbers, row.model_id)
    artifacts = [engine.store.blobs.get(blobs[n]) for n in numbers]
    folder = index_folder(engine.settings.indexes, row)
    version = newest(folder, row.model_id, len(vectors[0]))
    assert len(version) == len(numbers)
    return {
        "upload": pieces(uploads[0].data, [upload.data for upload in uploads[1:]]),
        "signature": pieces(vectors[0], vectors[1:]),
        "artifact": pieces(artifacts[0], artifacts[1:]),
        "tag": [b"by-the-door"],
    }


def answers_of(engine, frame_id, uploads):
    options = Query(stages="retrieve,diversify,validate", seed=1)
    own = engine.query_frame("hall", frame_id, options)
    other = engine.ask(uploads[1], options)
    assert frame_id in {match.frame_id for match in other.matches}
    fused = engine.reconstructions.begin_for(
        engine.query_log.find(own.query_id), NewReconstruction()
    )
    return own.query_id, other.query_id, fused.job_id


def test_no_byte_is_left(lived_in, secret, uploads, tmp_path):
    engine, frame_id = lived_in, lived_in.ids()[0]
    own, shows, fused = answers_of(engine, frame_id, uploads)
    third = engine.query_frame("hall", frame_id, Query(seed=1)).query_id
    for one in (shows, third):
        assert engine.query_log.keep(one, None).kept_at is not None
    truth = "sceneprint.db" if engine.store.database.is_sqlite else "table signatures"
    actual = {what: places(engine, tmp_path, wanted) for what, wanted in secret.items()}
    assert actual["upload"] == {"blobs"}
    is_sqlite = engine.store.database.is_sqlite
    answers = {"queries", "sceneprint.db" if is_sqlite else "table queries"}  # one is kept
    assert actual["signature"] == {truth, *answers, "index .faiss"}
    assert actual["artifact"] == {"blobs", *answers}
    with engine.store.database.write() as connection:  # of the others, which stay
        row = find_map(connection, "hall")
        for name in engine.ids()[1:]:
            write_frame(connection, row, find_frame(connection, row, name), {"tags": []})
    engine.delete_frame("hall", frame_id)
    assert places(engine, tmp_path, secret["upload"]) == {"blobs"}  # it can be restored
    with pytest.raises(UnknownQuery):
        engine.inspection.answer(own)
    assert engine.inspection.answer(shows).query_id == shows
    purged = engine.purging.now()
    assert (purged.answers, purged.products, purged.indexes) == (3, 1, 1)
    for what, wanted in secret.items():
        assert places(engine, tmp_path, wanted) == set(), what
    with pytest.raises(UnknownQuery):
        engine.inspection.answer(shows)
    with pytest.raises(UnknownJob):
        engine.reconstructions.get(None, fused)
    result = engine.ask(uploads[4], Query(seed=1))
    assert result.matches[0].frame_id == engine.ids()[3]
    # part of an index whose removal failed after that of its manifest
    (part,) = tmp_path.rglob("*.keys")
    left = part.with_name("0" * 64 + part.suffix)
    left.write_bytes(b"signature of the deleted frame")
    assert engine.purging.now().indexes == 0
    assert (left.exists(), part.exists()) == (False, True)


def test_no_byte_of_a_map_is_left(lived_in, secret, uploads, tmp_path):
    engine, frame_id = lived_in, lived_in.ids()[0]
    _, shows, _ = answers_of(engine, frame_id, uploads)
    engine.query_log.keep(shows, None)
    engine.delete_frame("hall", engine.ids()[1])
    engine.delete_map("hall")
    engine.publish_due()
    engine.purging.now()
    for what, wanted in secret.items():
        assert places(engine, tmp_path, wanted) == set(), what
    assert list(engine.store.blobs.digests()) == []


@pytest.mark.sqlite_only("the files of a data folder are damaged")
def test_bytes_in_quarantine_go_with_their_frame(full):
    with full.store.database.read() as connection:
        frame = find_frame(connection, find_map(connection, "hall"), full.ids()[0])
    full.store.blobs.path(frame.blob).write_bytes(b"damaged" * 100)
    assert len(list(fsck(full.settings, repair=True, grace_s=0))) == 1
    aside = full.settings.quarantine_dir
    (aside / "notes.txt").write_text("of an operator")
    names = sorted(path.name for path in aside.iterdir())
    assert names == [f"blob-{frame.blob}", "notes.txt"]
    full.purging.now()
    assert sorted(path.name for path in aside.iterdir()) == names  # its frame is there
    full.delete_frame("hall", frame.id)
    full.purging.now()
    assert [path.name for path in aside.iterdir()] == ["notes.txt"]


def test_readers_let_go_of_what_was_deleted(empty, uploads):
    engine = empty
    for upload in uploads[:3]:
        engine.add(upload)
    engine.work_off()
    view = engine.view("hall")[2]
    gone = bytes(view.tail.signatures[0])
    engine.delete_frame("hall", engine.list_frames("hall").items[0].frame_id)
    held = engine.view("hall")[2]
    assert (held.size, len(held.tail), bytes(held.tail.signatures[0])) == (2, 3, gone)
    with engine.store.database.read() as connection:
        engine.readers.purge(connection)
    now = engine.view("hall")[2]
    assert (now.size, len(now.tail), now.revision) == (2, 2, held.revision)
    assert gone not in now.tail.signatures.tobytes()
    assert now.tail.signatures.tobytes() == view.tail.signatures[1:].tobytes()


def test_what_a_snapshot_or_a_crash_left_goes_later(empty, uploads):
    engine, (a, b, *_) = empty, uploads
    for shot in (a, b):
        engine.add(shot)
    first, second = (frame.frame_id for frame in engine.list_frames("hall").items)
    with engine.store.blobs.locks.block_removals():  # as while a snapshot is being taken
        engine.delete_frame("hall", first)
        assert len(list(engine.store.blobs.digests())) == 2
        assert engine.purging.now().blobs == 1
    assert len(list(engine.store.blobs.digests())) == 2
    with engine.store.database.write() as connection:  # and then the process died
        row = find_map(connection, "hall")
        delete_frame(connection, row, find_frame(connection, row, second))
    engine.add(b)  # the same upload has come again
    assert engine.purging.now().blobs == 2
    assert list(engine.store.blobs.digests()) == [hashlib.sha256(b.data).hexdigest()]
    assert engine.purging.now().blobs == 0


def test_an_index_that_another_process_builds_is_not_said_to_be_purged(lived_in, monkeypatch):
    monkeypatch.setattr(purge, "PAUSE", 1e4)
    engine, names = lived_in, lived_in.ids()
    worker = Purging(engine.context, engine.upkeep)
    worker._every_s = worker._next = 0.0
    folder = index_folder(engine.settings.indexes, engine.row("hall"))
    before = newest_number(folder)
    engine.delete_frame("hall", names[0])
    with folder_turn(folder):
        with pytest.raises(BusyIndex, match="may still contain bytes of deleted frames"):
            engine.purging.now()
        assert worker.run().indexes == 0
    assert worker.run().indexes == 1
    assert newest_number(folder) == before + 1
    engine.delete_frame("hall", names[1])
    assert worker.run().indexes == 0  # it rests
    assert engine.purging.now().indexes == 1  # whoever asks for it need not wait
