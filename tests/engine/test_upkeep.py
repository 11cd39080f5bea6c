"""Tests that indexes are caches, and of answers while frames are deleted and published."""

import shutil
from importlib.resources import files

import numpy as np
import pytest
from sqlalchemy import update

from sceneprint.engine import signers
from sceneprint.engine.search import local_index, retrieval, verification
from sceneprint.engine.search.retrieval import Deadline, prepare_stored
from sceneprint.engine.signers import warm_signing, warm_validation
from sceneprint.engine.upkeep import index_upkeep
from sceneprint.errors import InvalidRequest, UnknownMap, UnreadableModel
from sceneprint.formats.artifact import read_geometry
from sceneprint.index.index_manifest import manifests, read_manifest
from sceneprint.models import read_model
from sceneprint.pipeline import associate
from sceneprint.settings import Settings
from sceneprint.signing import open_signer
from sceneprint.store.tables import models
from sceneprint_client.api import JobState, NewMap, Query

ALL = Query(stages=("retrieve",), k=50)


def fill(engine, uploads, which):
    added = [engine.add(uploads[i])[0] for i in which]
    assert engine.work_off() == [JobState.SUCCEEDED] * len(which)
    return [frame.frame_id for frame in added]


def test_an_index_of_a_history_that_was_undone_is_not_believed(make_engine, uploads, tmp_path):
    """Put back to two frames, the database gives the numbers of the next three out again."""
    data, aside = tmp_path / "data", tmp_path / "kept"
    engine = make_engine(data, unindexed_frames=2)
    engine.create_map(NewMap(name="hall", model="depth"))
    fill(engine, uploads, range(2))
    engine.close()
    shutil.copytree(data, aside)
    engine = make_engine(data, unindexed_frames=2)
    fill(engine, uploads, range(2, 5))
    assert engine.publish_due() == 1
    engine.close()
    shutil.copytree(data / "index", aside / "index", dirs_exist_ok=True)
    shutil.rmtree(data)
    aside.rename(data)
    engine = make_engine(data, unindexed_frames=2)
    names = fill(engine, uploads, range(5, 8))
    for name, i in zip(names, range(5, 8), strict=True):
        answer = engine.ask(uploads[i], ALL)
        assert (answer.index_version, answer.counts.map) == (0, 5)
        assert (answer.matches[0].frame_id, answer.matches[0].distance) == (name, 0)
    assert engine.publish_due() == 1  # anew, from nothing
    for fresh in (engine, make_engine(data, unindexed_frames=2)):
        answer = fresh.ask(uploads[5], ALL)
        assert (answer.matches[0].frame_id, answer.matches[0].distance) == (names[0], 0)
        assert answer.counts.map == 5
    assert answer.index_version == 2


def test_an_index_that_cannot_be_written_costs_no_frame(make_engine, uploads, tmp_path, caplog):
    (tmp_path / "file").write_text("in the way")
    engine = make_engine(index_dir=tmp_path / "file" / "index", unindexed_frames=1)
    engine.create_map(NewMap(name="hall", model="depth"))
    names = fill(engine, uploads, range(3))
    assert engine.publish_due() == 0
    assert [r.message for r in caplog.records if r.levelname == "ERROR"] == [
        "index publication failed"
    ]
    answer = engine.ask(uploads[1], ALL)
    assert (answer.matches[0].frame_id, answer.index_version) == (names[1], 0)


def test_indexes_of_deleted_maps_are_removed_and_nothing_else(make_engine, uploads, tmp_path):
    engine = make_engine(unindexed_frames=1)
    engine.create_map(NewMap(name="hall", model="depth"))
    fill(engine, uploads, range(3))
    assert engine.publish_due() == 1
    (folder,) = engine.settings.indexes.glob("[!.]*")
    (engine.settings.indexes / "notes").mkdir()
    shutil.copytree(
        folder, engine.settings.indexes / "hall-9-abc-0123456789ab.2"
    )  # of a map that is no more
    assert engine.publish_due() == 0
    left = [path.name for path in engine.settings.indexes.glob("[!.]*")]
    assert set(left) == {folder.name, "notes"}
    engine.delete_map("hall")
    assert engine.publish_due() == 0
    assert [path.name for path in engine.settings.indexes.glob("[!.]*")] == ["notes"]


def test_a_model_that_cannot_be_read_costs_its_maps_alone(make_engine, uploads, caplog):
    engine = make_engine()
    for name, model in (("hall", "depth"), ("old", "paper")):
        engine.create_map(NewMap(name=name, model=model))
    old = engine.get_map("old").model_id
    engine.write(update(models).where(models.c.id == old).values(content=b"of old"))
    fresh = make_engine()
    fresh.signers.warm()
    (error,) = [r for r in caplog.records if r.levelname == "ERROR"]
    assert (error.name, error.__dict__["model"]) == (signers.__name__, old)
    fill(fresh, uploads, range(1))
    assert fresh.ask(uploads[0], ALL).counts.map == 1
    with pytest.raises(UnreadableModel):
        fresh.queries.upload(["old"], uploads[0].data, uploads[0].meta, ALL)


def test_purging_removes_what_a_publication_had_only_marked(make_engine, uploads):
    engine = make_engine(unindexed_frames=1, undo_window_s=0)
    engine.create_map(NewMap(name="hall", model="depth"))
    names = fill(engine, uploads, range(12))
    assert engine.publish_due() == 1
    (folder,) = engine.settings.indexes.glob("hall*")
    version = engine.view("hall")[2].version
    row = version.vectors_of(version.keys[2:3]).tobytes()
    for name in (names[2], names[3]):
        engine.delete_frame("hall", name)
    assert engine.publish_due() == 1
    ((_, newest), _) = manifests(folder)
    actual = read_manifest(newest)
    assert (actual.frames, len(actual.worn_keys)) == (10, 1)
    assert any(row in path.read_bytes() for path in folder.iterdir())
    assert engine.purging.now().indexes == 1
    assert all(row not in path.read_bytes() for path in folder.iterdir())
    assert engine.purging.now().indexes == 0
    fresh = make_engine(unindexed_frames=1)
    answer = fresh.ask(uploads[5], ALL)
    assert (answer.counts.map, answer.index_version) == (10, 3)


def test_purging_writes_an_index_again_whose_keys_are_damaged(make_engine, uploads):
    engine = make_engine(unindexed_frames=1, undo_window_s=0)
    engine.create_map(NewMap(name="hall", model="depth"))
    names = fill(engine, uploads, range(4))
    assert engine.publish_due() == 1
    (folder,) = engine.settings.indexes.glob("hall*")
    (path,) = folder.glob("*.keys")
    row = engine.view("hall")[2].version.vectors_of(np.array([2])).tobytes()
    engine.delete_frame("hall", names[1])
    keys = np.frombuffer(path.read_bytes(), "<i8").copy()
    keys[1] = 0  # that of the deleted frame
    path.write_bytes(keys.tobytes())
    assert engine.purging.now().indexes == 1
    assert all(row not in path.read_bytes() for path in folder.iterdir())
    ((number, _),) = manifests(folder)
    assert number == 2


def test_maps_of_whole_fisher_vectors_are_compared_by_l1_without_an_index(make_engine, uploads):
    engine = make_engine(unindexed_frames=1)
    engine.create_map(NewMap(name="hall", model="paper"))
    names = fill(engine, uploads, range(4))
    assert engine.publish_due() == 0
    assert list(engine.settings.indexes.glob("hall*/*.json")) == []
    with pytest.raises(InvalidRequest, match="has no index, because"):
        engine.rebuild_index("hall")
    answer = engine.ask(uploads[1], ALL)
    assert (answer.exact, answer.index_version) == (True, 0)
    rows = np.stack([list(engine.outputs.vector("hall", name).make()) for name in names])
    apart = np.abs(rows - rows[1]).sum(axis=1)
    actual = [(match.frame_id, match.distance) for match in answer.matches]
    assert actual == [(names[i], apart[i]) for i in np.argsort(apart, kind="stable")]


R = Query(stages=("retrieve",), k=50)


def test_what_is_deleted_while_a_query_runs_is_not_told(full, uploads, monkeypatch):
    names, search = full.ids(), local_index.search
    gone = [names[6], names[1]]

    def then_delete(*args, **more):
        hits = search(*args, **more)
        if gone:
            full.delete_frame("hall", gone.pop())
        return hits

    monkeypatch.setattr(local_index, "search", then_delete)
    for query, missing in ((Query(), names[1]), (R, names[6])):
        answer = full.ask(uploads[1], query)
        assert missing not in [m.frame_id for m in answer.matches]
        assert len(answer.matches) == (9 if query != R else 10)
    assert gone == []


def test_a_map_made_anew_while_it_was_asked_is_not_answered_for(empty, uploads):
    empty.add(uploads[0])
    empty.work_off()
    row = empty.row("hall")
    request = prepare_stored(empty.store, empty.signers, "hall", empty.ids()[0], Query())
    empty.delete_map("hall")
    empty.create_map(NewMap(name="hall", model="paper"))  # whose signatures are longer
    with pytest.raises(UnknownMap, match="created again during the query"):
        empty.queries.answer([row], request, Query(), Deadline(None))


def test_matches_that_are_deleted_while_they_are_validated_are_not_found(
    empty, uploads, monkeypatch
):
    empty.add(uploads[0])
    empty.work_off()
    (name,) = empty.ids()

    def then_delete(*arguments, **named):
        results = associate(*arguments, **named)
        assert [match.validation.status for match in results] == ["accepted"]
        empty.delete_frame("hall", name)
        return results

    monkeypatch.setattr(verification, "associate", then_delete)
    answer = empty.ask(uploads[0])
    assert (answer.status, answer.matches, answer.location) == ("not_found", [], None)
    assert (answer.counts.validated, answer.counts.accepted) == (0, 0)


def test_what_is_deleted_while_an_index_is_published_stays_deleted(
    full, make_engine, uploads, monkeypatch
):
    monkeypatch.setattr(local_index, "_LOOK_S", 0.0)
    reader, builder = make_engine(unindexed_frames=5), make_engine(unindexed_frames=5)
    names, publish = full.ids(), index_upkeep.publish
    assert full.get_map("hall").revision == 12
    reader.query_frame("hall", names[0], R)
    meta = uploads[3].meta
    camera = meta.intrinsics.model_copy(update={"cx": meta.intrinsics.cx + 1})
    own_meta = meta.model_copy(update={"intrinsics": camera})
    gone = full.add_frame("hall", uploads[3].data, own_meta)[0].frame_id
    full.work_off()

    def slowly(*args, **more):
        full.delete_frame("hall", gone)
        assert len(reader.query_frame("hall", names[0], R).matches) == 11
        return publish(*args, **more)

    monkeypatch.setattr(index_upkeep, "publish", slowly)
    assert builder.publish_due() == 1
    full.delete_frame("hall", names[11])
    for engine in (reader, make_engine(unindexed_frames=5)):
        answer = engine.query_frame("hall", names[0], R)
        assert answer.index_version == 1
        assert answer.counts.map == answer.counts.ranked == len(answer.matches) == 10
        assert {m.frame_id for m in answer.matches} == set(names[1:11])


def test_the_corner_is_what_signing_leaves_of_it():
    """Or validation would be compiled for another kind of geometry than it gets."""
    kept = files("sceneprint.engine").joinpath("corner.artifact").read_bytes()
    model = read_model("depth")
    signer = open_signer(model, Settings().cache_dir)
    assert warm_signing(signer) == kept
    assert warm_validation(read_geometry(kept), model.parameters.validation)


def test_maps_beyond_the_memory_bound_are_closed(make_engine, uploads, monkeypatch):
    engine = make_engine()
    for name in ("hall", "other"):
        engine.create_map(NewMap(name=name, model="depth"))
        engine.add(uploads[0], name)
    engine.work_off()

    def held():
        for name in ("hall", "other", "hall"):
            assert engine.ask(uploads[0], ALL, [name]).matches[0].distance == 0
        return list(engine.readers._open)

    assert held() == ["other", "hall"]
    monkeypatch.setattr(retrieval, "HELD_BYTES", 2 * 64 * 448 - 1)  # 64 rows are set aside at once
    assert held() == ["hall"]
