"""Tests of re-encoding in the background, and of queries, workers and indexes at the switch."""

import hashlib
import json
import shutil
import subprocess
import sys
import threading
from dataclasses import replace

import numpy as np
import pytest
from sqlalchemy import select

from sceneprint.engine.jobs import signature_job as working
from sceneprint.engine.maps import map_lifecycle
from sceneprint.engine.search import local_index, query
from sceneprint.engine.search.local_index import index_folder
from sceneprint.engine.search.retrieval import Deadline
from sceneprint.errors import (
    Busy,
    Conflict,
    ModelMismatch,
    UnknownMap,
    UnreadableModel,
    UselessFrame,
)
from sceneprint.geometry.retrieval.ranking import distances
from sceneprint.models import save_model
from sceneprint.pipeline import open_signer, prepare
from sceneprint.settings import Settings
from sceneprint.store.tables import jobs, signatures
from sceneprint_client.api import FrameState, JobState, NewMap, Query
from tests.whole_engine import Engine

R = Query(stages=("retrieve",), k=50, exact=True)


@pytest.fixture(scope="module")
def short_sighted(small_model, tmp_path_factory):
    """A small model that sees nothing beyond 4.5 m."""
    depth = replace(small_model.parameters.depth, maximum_depth=4.5)
    model = replace(
        small_model, name="short", parameters=replace(small_model.parameters, depth=depth)
    )
    path = tmp_path_factory.mktemp("model") / "short.safetensors"
    save_model(model, path)
    return path


@pytest.fixture(scope="module")
def far_off(make_upload, room_views):
    """A view from so far off that the nearest of it is beyond 4.5 m."""
    frame = room_views(99, 0, 1).frames[0]
    depth = np.where(frame.depth > 0, frame.depth * 0.5 + 4.6, 0).astype(np.float32)
    return make_upload(replace(frame, depth=depth), "far")


@pytest.fixture(scope="module")
def paper_folder(uploads, work_off, tmp_path_factory):
    """A data folder whose map `hall` holds all uploads and never had a model but `paper`."""
    folder = tmp_path_factory.mktemp("paper") / "data"
    with Engine(Settings(data_dir=folder)) as engine:
        engine.create_map(NewMap(name="hall", model="paper"))
        for each in uploads:
            engine.add_frame("hall", each.data, each.meta)
        work_off(engine)
    return folder


def listed(engine, state=None):
    return [frame.frame_id for frame in engine.list_frames("hall", state=state).items]


def said(engine, answer):
    """All of an answer but what no two have in common, frames by their places in the map."""
    places = {name: str(i) for i, name in enumerate(listed(engine))}
    told = answer.model_dump_json(exclude={"query_id", "milliseconds", "index_version"})
    for name, place in places.items():
        told = told.replace(name, place)
    return json.loads(told)


def models_of(engine):
    """How many signatures each model has."""
    found = engine.fetch(select(signatures.c.model_id)).scalars().all()
    return {model_id: found.count(model_id) for model_id in set(found)}


def queued(engine):
    asked = select(jobs.c.kind, jobs.c.priority, jobs.c.model_id).where(
        jobs.c.state == JobState.QUEUED
    )
    return [tuple(row) for row in engine.fetch(asked)]


def test_after_the_switch_the_map_is_as_if_made_with_that_model(
    full, make_engine, paper_folder, uploads, told, work_off, tmp_path
):
    shutil.copytree(paper_folder, tmp_path / "paper")
    fresh = make_engine(tmp_path / "paper")
    before, paper = full.get_map("hall"), fresh.get_map("hall")
    seen = said(full, full.queries.upload(["hall"], uploads[4].data, uploads[4].meta, R))
    now = full.reencode("hall", "paper").reencoding
    assert (now.model, now.model_id) == (paper.model, paper.model_id)
    assert (now.done, now.left, now.failed, now.dead) == (0, 12, 0, 0)
    assert queued(full) == [("reencode", -10, paper.model_id)] * 12
    for done in range(12):  # nobody who asks sees anything of it
        frames = full.list_frames("hall").items
        assert {frame.state for frame in frames} == {FrameState.INDEXED}
        assert full.publish_due() == 0
        claimed = full.claim("w")
        during = full.get_map("hall")
        assert during.model_copy(update={"reencoding": None}) == before
        assert (during.reencoding.done, during.reencoding.left) == (done, 12 - done)
        if done % 4 == 0:
            again = full.queries.upload(["hall"], uploads[4].data, uploads[4].meta, R)
            assert said(full, again) == seen
        assert full.get_frame("hall", claimed.frame.id).state == FrameState.INDEXED
        assert full.run(claimed) == JobState.SUCCEEDED
    assert [frame.job_id for frame in full.list_frames("hall").items] == [f.job_id for f in frames]
    assert models_of(full) == {before.model_id: 12, paper.model_id: 12}
    assert len(list(full.store.blobs.digests())) == 36
    full.publish_due()
    after = full.get_map("hall")
    changed = {"model": paper.model, "model_id": paper.model_id}
    assert after == before.model_copy(update=changed)
    assert models_of(full) == {paper.model_id: 12}
    assert set(full.store.blobs.digests()) == set(fresh.store.blobs.digests())
    assert told(full)[-13:] == ["frame.reencoded"] * 12 + ["map.reencoded"]
    other = make_engine(full.settings.data_dir)  # beside one that held the former signatures
    names, others = listed(full), listed(fresh)
    for how, which in ((R, (0, 4, 9)), (Query(seed=3), (4,))):
        for i in which:
            for asked in (full, other):
                answer = asked.queries.upload(["hall"], uploads[i].data, uploads[i].meta, how)
                wanted = fresh.queries.upload(["hall"], uploads[i].data, uploads[i].meta, how)
                assert said(full, answer) == said(fresh, wanted)
            answer = full.query_frame("hall", names[i], how)
            assert said(full, answer) == said(fresh, fresh.query_frame("hall", others[i], how))
    assert work_off(full) == []
    full.publish_due()
    assert full.get_map("hall") == after


def test_what_comes_and_goes_meanwhile(full, uploads, far_off, short_sighted, work_off):
    names = listed(full)
    full.reencode("hall", short_sighted)
    full.delete_frame("hall", names[2])
    full.publish_due()
    claimed = full.claim("w")
    full.delete_frame("hall", claimed.frame.id)  # while it is signed
    assert full.run(claimed) is None
    added, new = full.add_frame("hall", far_off.data, far_off.meta)
    assert new
    first = full.claim("w")
    assert first.frame.id == added.frame_id  # what robots send goes first
    assert full.run(first) == JobState.SUCCEEDED
    job = full.get_job(added.job_id)
    assert (job.kind, job.state) == ("sign", JobState.SUCCEEDED)
    assert full.get_frame("hall", added.frame_id).job_id == added.job_id
    assert work_off(full) == [JobState.SUCCEEDED] * 10 + [JobState.FAILED]
    now = full.get_map("hall").reencoding
    assert (now.done, now.left, now.failed, now.dead) == (10, 0, 1, 0)
    assert full.get_frame("hall", added.frame_id).state == FrameState.INDEXED
    full.publish_due()
    told = full.get_map("hall")
    assert told.model_id == now.model_id
    assert told.reencoding is None
    assert told.frames == {"deleted": 2, "indexed": 10, "rejected": 1}
    frame = full.get_frame("hall", added.frame_id)
    assert frame.state == FrameState.REJECTED
    assert "range" in frame.reason
    answer = full.queries.upload(["hall"], uploads[4].data, uploads[4].meta, R)
    assert {match.frame_id for match in answer.matches} == set(listed(full, FrameState.INDEXED))
    assert (answer.counts.map, answer.matches[0].distance) == (10, 0)
    assert models_of(full) == {now.model_id: 10}


def test_a_frame_that_breaks_down_holds_the_switch_up(
    full, uploads, short_sighted, due_now, work_off
):
    """Until it is tried again with success, or deleted."""
    before = full.get_map("hall").model_id
    lost = [full.store.blobs.put(uploads[i].data) for i in (3, 5)]
    for blob in lost:
        full.store.blobs.remove(blob)
    full.reencode("hall", short_sighted)
    states = work_off(full)
    for _ in range(2):
        due_now(full)
        states += work_off(full)
    assert states.count(JobState.DEAD) == 2
    for _ in range(2):
        full.publish_due()
        told = full.get_map("hall")
        assert (told.model_id, told.frames) == (before, {"indexed": 12})
        assert (told.reencoding.done, told.reencoding.left, told.reencoding.dead) == (10, 0, 2)
        assert queued(full) == []  # nobody tries it again unasked
    full.store.blobs.put(uploads[3].data)
    now = full.reencode("hall", short_sighted).reencoding
    assert (now.done, now.left, now.dead) == (10, 2, 0)
    assert work_off(full) == [JobState.SUCCEEDED, JobState.QUEUED]
    full.delete_frame("hall", listed(full)[5])
    full.publish_due()
    told = full.get_map("hall")
    assert (told.model_id, told.reencoding) == (now.model_id, None)
    assert told.frames == {"deleted": 1, "indexed": 11}


def test_what_is_given_up_leaves_nothing(full, short_sighted, uploads, work_off, told):
    before, blobs = full.get_map("hall"), set(full.store.blobs.digests())
    full.reencode("hall", short_sighted)
    for _ in range(5):
        claimed = full.claim("w")
        assert full.run(claimed) == JobState.SUCCEEDED
    held = full.claim("w")
    assert map_lifecycle.cancel_reencoding(full.store, "hall") == before
    assert full.run(held) is None
    assert full.claim("w") is None
    assert models_of(full) == {before.model_id: 12}
    assert set(full.store.blobs.digests()) == blobs
    assert told(full)[-1] == "map.reencoding_cancelled"
    full.publish_due()
    assert full.get_map("hall") == before
    # it can be begun once more
    full.reencode("hall", short_sighted)
    assert work_off(full) == [JobState.SUCCEEDED] * 12
    full.publish_due()
    assert full.get_map("hall").model.startswith("short-")


def test_what_cannot_be_begun(full, short_sighted):
    with pytest.raises(UnknownMap):
        full.reencode("nowhere", "paper")
    with pytest.raises(UnreadableModel):
        full.reencode("hall", "/nowhere.safetensors")
    with pytest.raises(Conflict, match=r"already uses the model depth-.*\."):
        full.reencode("hall", "depth")
    with pytest.raises(Conflict, match="not switching to another model"):
        map_lifecycle.cancel_reencoding(full.store, "hall")
    full.reencode("hall", short_sighted)
    assert full.reencode("hall", short_sighted).reencoding is not None  # the same again
    assert len(queued(full)) == 12
    for other in ("paper", "depth"):
        with pytest.raises(Conflict, match=r"is already switching to short-.* --cancel"):
            full.reencode("hall", other)


DEPTH = "depth"


@pytest.fixture(scope="module")
def whitened_signer(whitened_model):
    return open_signer(whitened_model, cached=False)


@pytest.fixture(scope="module")
def small_file(whitened_model, tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "small.safetensors"
    save_model(whitened_model, path)
    return str(path)


@pytest.fixture(scope="module")
def by_model(uploads, signer, whitened_signer):
    """By the label of each model its signer, and its signatures of all uploads."""
    return {
        one.model.label: (one, np.stack([prepare(each.frame, one)[0].vector for each in uploads]))
        for one in (signer, whitened_signer)
    }


def switch(engine, model, work_off):
    """Begin, work off, switch."""
    engine.reencode("hall", model)
    work_off(engine)
    engine.publish_due()
    assert engine.get_map("hall").reencoding is None


def useless(*_):
    raise UselessFrame("nothing")


def found(answer):
    return [(match.frame_id, match.distance) for match in answer.matches]


def right(names, by_model, label, asked):
    """What a query by upload must find in a map of the model."""
    vectors = by_model[label][1]
    apart = distances(vectors[asked].copy(), vectors, "l2")
    return [(names[i], int(apart[i])) for i in np.argsort(apart, kind="stable")]


def test_a_query_signed_before_the_switch_is_signed_again(
    full, uploads, ids, work_off, small_file, by_model, monkeypatch
):
    """The map switches between the signing of a query and its search, and behind the search."""
    names, models = ids(full), [small_file, DEPTH, small_file, DEPTH]

    def then_switch(step):
        def run(*given, **more):
            made = step(*given, **more)
            if models:
                switch(full, models.pop(0), work_off)
            return made

        return run

    for name in ("prepare_upload", "prepare_stored", "answer"):
        monkeypatch.setattr(query, name, then_switch(getattr(query, name)))
    del models[1:]
    answer = full.queries.upload(["hall"], uploads[4].data, uploads[4].meta, Query())
    assert answer.model.startswith("small-")
    assert found(full.queries.upload(["hall"], uploads[4].data, uploads[4].meta, R)) == right(
        names, by_model, answer.model, 4
    )
    models[:] = [DEPTH]
    answer = full.query_frame("hall", names[4], R)
    assert answer.model.startswith("depth-")
    assert found(answer) == right(names, by_model, answer.model, 4)[1:]
    monkeypatch.undo()
    monkeypatch.setattr(query, "answer", then_switch(query.answer))
    models[:] = [small_file]
    answer = full.queries.upload(["hall"], uploads[4].data, uploads[4].meta, R)
    assert answer.model.startswith("small-")
    models[:] = [DEPTH, small_file] * 5
    with pytest.raises(Busy, match="switched its model repeatedly"):
        full.queries.upload(["hall"], uploads[4].data, uploads[4].meta, R)


def test_signatures_of_two_models_are_not_compared_whatever_their_length(
    full, uploads, whitened_model, signer
):
    row = full.row("hall")
    decoders = full.store.decoders
    asked = query.prepare_upload(uploads[0].data, uploads[0].meta, signer, R, decoders)
    given = ([row], asked, R, Deadline(None))
    assert full.queries.answer(*given).matches[0].distance == 0
    with pytest.raises(ModelMismatch, match="two models cannot be compared"):
        full.queries.answer([row], replace(asked, model_id=whitened_model.id), R, Deadline(None))


def test_what_was_being_signed_at_the_switch_is_signed_with_the_new_model(
    empty, uploads, work_off, small_file, whitened_model, monkeypatch
):
    for each in uploads[:2]:
        empty.add_frame("hall", each.data, each.meta)
    work_off(empty)
    added, _ = empty.add_frame("hall", uploads[2].data, uploads[2].meta)
    held = empty.claim("slow")
    switch(empty, small_file, work_off)  # it is not indexed: nobody waits for it
    assert empty.run(held) == JobState.QUEUED
    assert empty.get_frame("hall", added.frame_id).state == FrameState.RECEIVED
    assert len(list(empty.store.blobs.digests())) == 3 + 2
    assert work_off(empty) == [JobState.SUCCEEDED]
    answer = empty.queries.upload(["hall"], uploads[2].data, uploads[2].meta, R)
    assert (answer.counts.map, found(answer)[0]) == (3, (added.frame_id, 0))
    # and one in which the former model finds nothing is not rejected for it
    added, _ = empty.add_frame("hall", uploads[3].data, uploads[3].meta)
    held = empty.claim("slow")
    switch(empty, DEPTH, work_off)
    with monkeypatch.context() as patch:
        patch.setattr(working, "prepare", useless)
        assert empty.run(held) == JobState.QUEUED
    assert work_off(empty) == [JobState.SUCCEEDED]
    assert empty.get_map("hall").frames == {"indexed": 4}


def test_the_index_of_the_next_model_is_there_at_the_switch(
    full, make_engine, uploads, ids, work_off, small_file, by_model, monkeypatch
):
    monkeypatch.setattr(local_index, "_LOOK_S", 0.0)
    engine, names = make_engine(full.settings.data_dir, unindexed_frames=5), ids(full)
    assert engine.publish_due() == 1
    before = index_folder(engine.settings.indexes, engine.row("hall"))
    engine.reencode("hall", small_file)
    assert set(work_off(engine)) == {JobState.SUCCEEDED}
    for asked in (engine, full):
        answer = asked.query_frame("hall", names[1], R)
        assert (answer.index_version, answer.model[:6]) == (1, "depth-")
    engine.publish_due()
    answer = engine.queries.upload(["hall"], uploads[4].data, uploads[4].meta, R)
    assert (answer.index_version, answer.counts.map) == (1, 12)
    assert found(answer) == right(names, by_model, answer.model, 4)
    assert not before.exists()
    after = index_folder(engine.settings.indexes, engine.row("hall"))
    assert [one for one in engine.settings.indexes.iterdir() if one.is_dir()] == [after]
    # the next version is due again after as many frames, and not before
    assert engine.publish_due() == 0


def test_a_rejected_frame_is_gone_for_readers_that_knew_it(
    full, make_engine, uploads, ids, work_off, small_file, by_model, monkeypatch
):
    """One that slept while the map went to another model, which rejected a frame, and back."""
    sleeper, names = make_engine(full.settings.data_dir), ids(full)
    assert sleeper.query_frame("hall", names[0], R).counts.map == 11
    full.reencode("hall", small_file)
    blind = full.claim("w")
    with monkeypatch.context() as patch:
        patch.setattr(working, "prepare", useless)
        full.run(blind)
    work_off(full)
    full.publish_due()
    assert full.get_frame("hall", blind.frame.id).reason == "nothing"
    switch(full, DEPTH, work_off)
    at = names.index(blind.frame.id)
    asked = (at + 1) % 12
    wanted = right(names, by_model, full.get_map("hall").model, asked)
    answer = sleeper.queries.upload(["hall"], uploads[asked].data, uploads[asked].meta, R)
    assert found(answer) == [one for one in wanted if one[0] != blind.frame.id]
    # what one model rejects another has to look at: it is found again
    assert full.get_frame("hall", blind.frame.id).state == FrameState.RECEIVED
    assert work_off(full) == [JobState.SUCCEEDED]
    answer = sleeper.queries.upload(["hall"], uploads[asked].data, uploads[asked].meta, R)
    assert found(answer) == wanted


#: Works as a worker does, and stands still after a step of which it tells.
WORKER = """
import sys, time
from importlib import import_module
from pathlib import Path
from tests.whole_engine import Engine
from sceneprint.settings import Settings

module, name = import_module(sys.argv[2]), sys.argv[3]
step, calls = getattr(module, name), 0

def stand_still(*given, **more):
    global calls
    calls += 1
    if calls < int(sys.argv[4]):
        return step(*given, **more)
    step(*given, **more)
    print(name, flush=True)
    time.sleep(600)

setattr(module, name, stand_still)
engine = Engine(Settings(data_dir=Path(sys.argv[1]), job_lease_s=0.3, unindexed_frames=5))
while True:
    held = engine.claim("doomed")
    if held is None:
        engine.publish_due()
    else:
        engine.run(held)
"""


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("stop", "switched"),
    [
        (("sceneprint.engine.jobs.signature_job", "replace_signature", 5), False),
        (("sceneprint.engine.upkeep.index_upkeep", "publish", 1), False),
        (("sceneprint.store.reencoding_rows", "switch_model", 1), False),  # not committed
        (("sceneprint.store.signatures", "remove_signature", 4), True),
    ],
)
def test_whoever_is_killed_on_the_way_leaves_what_another_ends(
    full, make_engine, uploads, ids, due_now, work_off, small_file, by_model, stop, switched
):
    module, step, call = stop
    names, folder = ids(full), str(full.settings.data_dir)
    full.reencode("hall", small_file)
    command = [sys.executable, "-c", WORKER, folder, module, step, str(call)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as worker:
        late = threading.Timer(90, worker.kill)
        late.start()
        try:
            assert worker.stdout.readline() == f"{step}\n"
        finally:
            late.cancel()
            worker.kill()
    label = full.get_map("hall").model
    assert label.startswith("small-") == switched
    answer = full.queries.upload(["hall"], uploads[7].data, uploads[7].meta, R)
    assert found(answer) == right(names, by_model, label, 7)
    due_now(full)
    other = make_engine(full.settings.data_dir, unindexed_frames=5)
    work_off(other)
    for _ in range(2):
        other.publish_due()
    assert other.get_map("hall").frames == {"indexed": 12}
    for asked in (full, other):
        answer = asked.queries.upload(["hall"], uploads[7].data, uploads[7].meta, R)
        assert answer.model.startswith("small-")
        assert found(answer) == right(names, by_model, answer.model, 7)
    assert models_of(other) == {other.get_map("hall").model_id: 12}
    digests = set(other.store.blobs.digests())
    assert {hashlib.sha256(each.data).hexdigest() for each in uploads} <= digests
    assert len(digests) >= 24  # an artifact may be left that nothing refers to
