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
from sceneprint.errors import Busy, ModelMismatch, UselessFrame
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
def paper_folder(uploads, tmp_path_factory):
    """A data folder whose map `hall` holds all uploads and never had a model but `paper`."""
    folder = tmp_path_factory.mktemp("paper") / "data"
    with Engine(Settings(data_dir=folder)) as engine:
        engine.create_map(NewMap(name="hall", model="paper"))
        for each in uploads:
            engine.add(each)
        engine.work_off()
    return folder


def listed(engine, state=None):
    return [frame.frame_id for frame in engine.list_frames("hall", state=state).items]


def said(engine, answer):
    """All of an answer but what no two have in common, frames by their places in the map."""
    places = {name: str(i) for i, name in enumerate(listed(engine))}
    result = answer.model_dump_json(exclude={"query_id", "milliseconds", "index_version"})
    for name, place in places.items():
        result = result.replace(name, place)
    return json.loads(result)


def models_of(engine):
    """How many signatures each model has."""
    rows = engine.fetch(select(signatures.c.model_id)).scalars().all()
    return {model_id: rows.count(model_id) for model_id in set(rows)}


def queued(engine):
    statement = select(jobs.c.kind, jobs.c.priority, jobs.c.model_id).where(
        jobs.c.state == JobState.QUEUED
    )
    return [tuple(row) for row in engine.fetch(statement)]


def test_after_the_switch_the_map_is_as_if_made_with_that_model(
    full, make_engine, paper_folder, uploads, tmp_path
):
    shutil.copytree(paper_folder, tmp_path / "paper")
    fresh = make_engine(tmp_path / "paper")
    before, paper = full.get_map("hall"), fresh.get_map("hall")
    seen = said(full, full.ask(uploads[4], R))
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
            again = full.ask(uploads[4], R)
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
    assert full.event_kinds()[-13:] == ["frame.reencoded"] * 12 + ["map.reencoded"]
    other = make_engine(full.settings.data_dir)  # beside one that held the former signatures
    names, others = listed(full), listed(fresh)
    for how, which in ((R, (0, 4, 9)), (Query(seed=3), (4,))):
        for i in which:
            for engine in (full, other):
                answer = engine.ask(uploads[i], how)
                wanted = fresh.ask(uploads[i], how)
                assert said(full, answer) == said(fresh, wanted)
            answer = full.query_frame("hall", names[i], how)
            assert said(full, answer) == said(fresh, fresh.query_frame("hall", others[i], how))
    assert full.work_off() == []
    full.publish_due()
    assert full.get_map("hall") == after


def test_what_comes_and_goes_meanwhile(full, uploads, far_off, short_sighted):
    names = listed(full)
    full.reencode("hall", short_sighted)
    full.delete_frame("hall", names[2])
    full.publish_due()
    claimed = full.claim("w")
    full.delete_frame("hall", claimed.frame.id)  # while it is signed
    assert full.run(claimed) is None
    added, new = full.add(far_off)
    assert new
    first = full.claim("w")
    assert first.frame.id == added.frame_id  # what robots send goes first
    assert full.run(first) == JobState.SUCCEEDED
    job = full.get_job(added.job_id)
    assert (job.kind, job.state) == ("sign", JobState.SUCCEEDED)
    assert full.get_frame("hall", added.frame_id).job_id == added.job_id
    assert full.work_off() == [JobState.SUCCEEDED] * 10 + [JobState.FAILED]
    now = full.get_map("hall").reencoding
    assert (now.done, now.left, now.failed, now.dead) == (10, 0, 1, 0)
    assert full.get_frame("hall", added.frame_id).state == FrameState.INDEXED
    full.publish_due()
    result = full.get_map("hall")
    assert result.model_id == now.model_id
    assert result.reencoding is None
    assert result.frames == {"deleted": 2, "indexed": 10, "rejected": 1}
    frame = full.get_frame("hall", added.frame_id)
    assert frame.state == FrameState.REJECTED
    assert "range" in frame.reason
    answer = full.ask(uploads[4], R)
    assert {match.frame_id for match in answer.matches} == set(listed(full, FrameState.INDEXED))
    assert (answer.counts.map, answer.matches[0].distance) == (10, 0)
    assert models_of(full) == {now.model_id: 10}


def test_a_frame_that_breaks_down_holds_the_switch_up(full, uploads, short_sighted):
    before = full.get_map("hall").model_id
    lost = [full.store.blobs.put(uploads[i].data) for i in (3, 5)]
    for blob in lost:
        full.store.blobs.remove(blob)
    full.reencode("hall", short_sighted)
    states = full.work_off()
    for _ in range(2):
        full.make_due()
        states += full.work_off()
    assert states.count(JobState.DEAD) == 2
    for _ in range(2):
        full.publish_due()
        result = full.get_map("hall")
        assert (result.model_id, result.frames) == (before, {"indexed": 12})
        assert (result.reencoding.done, result.reencoding.left, result.reencoding.dead) == (
            10,
            0,
            2,
        )
        assert queued(full) == []  # nobody tries it again unasked
    full.store.blobs.put(uploads[3].data)
    now = full.reencode("hall", short_sighted).reencoding
    assert (now.done, now.left, now.dead) == (10, 2, 0)
    assert full.work_off() == [JobState.SUCCEEDED, JobState.QUEUED]
    full.delete_frame("hall", listed(full)[5])
    full.publish_due()
    result = full.get_map("hall")
    assert (result.model_id, result.reencoding) == (now.model_id, None)
    assert result.frames == {"deleted": 1, "indexed": 11}


def test_what_is_given_up_leaves_nothing(full, short_sighted, uploads):
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
    assert full.event_kinds()[-1] == "map.reencoding_cancelled"
    full.publish_due()
    assert full.get_map("hall") == before


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


def switch(engine, model):
    """Begin, work off, switch."""
    engine.reencode("hall", model)
    engine.work_off()
    engine.publish_due()
    assert engine.get_map("hall").reencoding is None


def useless(*_):
    raise UselessFrame("nothing")


def matches_of(answer):
    return [(match.frame_id, match.distance) for match in answer.matches]


def right(names, by_model, label, number):
    """What a query by upload must find in a map of the model."""
    vectors = by_model[label][1]
    apart = distances(vectors[number].copy(), vectors, "l2")
    return [(names[i], int(apart[i])) for i in np.argsort(apart, kind="stable")]


def test_a_query_signed_before_the_switch_is_signed_again(
    full, uploads, small_file, by_model, monkeypatch
):
    names, models = full.ids(), [small_file, "depth", small_file, "depth"]

    def then_switch(step):
        def run(*args, **more):
            result = step(*args, **more)
            if models:
                switch(full, models.pop(0))
            return result

        return run

    for name in ("prepare_upload", "prepare_stored", "answer"):
        monkeypatch.setattr(query, name, then_switch(getattr(query, name)))
    del models[1:]
    answer = full.ask(uploads[4])
    assert answer.model.startswith("small-")
    assert matches_of(full.ask(uploads[4], R)) == right(names, by_model, answer.model, 4)
    models[:] = ["depth"]
    answer = full.query_frame("hall", names[4], R)
    assert answer.model.startswith("depth-")
    assert matches_of(answer) == right(names, by_model, answer.model, 4)[1:]
    monkeypatch.undo()
    monkeypatch.setattr(query, "answer", then_switch(query.answer))
    models[:] = [small_file]
    answer = full.ask(uploads[4], R)
    assert answer.model.startswith("small-")
    models[:] = ["depth", small_file] * 5
    with pytest.raises(Busy, match="switched its model repeatedly"):
        full.ask(uploads[4], R)


def test_signatures_of_two_models_are_not_compared_whatever_their_length(
    full, uploads, whitened_model, signer
):
    row = full.row("hall")
    decoders = full.store.decoders
    request = query.prepare_upload(uploads[0].data, uploads[0].meta, signer, R, decoders)
    values = ([row], request, R, Deadline(None))
    assert full.queries.answer(*values).matches[0].distance == 0
    with pytest.raises(ModelMismatch, match="two models cannot be compared"):
        full.queries.answer([row], replace(request, model_id=whitened_model.id), R, Deadline(None))


def test_what_was_being_signed_at_the_switch_is_signed_with_the_new_model(
    empty, uploads, small_file, whitened_model, monkeypatch
):
    for each in uploads[:2]:
        empty.add(each)
    empty.work_off()
    added, _ = empty.add(uploads[2])
    held = empty.claim("slow")
    switch(empty, small_file)  # it is not indexed: nobody waits for it
    assert empty.run(held) == JobState.QUEUED
    assert empty.get_frame("hall", added.frame_id).state == FrameState.RECEIVED
    assert len(list(empty.store.blobs.digests())) == 3 + 2
    assert empty.work_off() == [JobState.SUCCEEDED]
    answer = empty.ask(uploads[2], R)
    assert (answer.counts.map, matches_of(answer)[0]) == (3, (added.frame_id, 0))
    # and one in which the former model finds nothing is not rejected for it
    added, _ = empty.add(uploads[3])
    held = empty.claim("slow")
    switch(empty, "depth")
    with monkeypatch.context() as patch:
        patch.setattr(working, "prepare", useless)
        assert empty.run(held) == JobState.QUEUED
    assert empty.work_off() == [JobState.SUCCEEDED]
    assert empty.get_map("hall").frames == {"indexed": 4}


def test_the_index_of_the_next_model_is_there_at_the_switch(
    full, make_engine, uploads, small_file, by_model, monkeypatch
):
    monkeypatch.setattr(local_index, "_LOOK_S", 0.0)
    engine, names = make_engine(full.settings.data_dir, unindexed_frames=5), full.ids()
    assert engine.publish_due() == 1
    before = index_folder(engine.settings.indexes, engine.row("hall"))
    engine.reencode("hall", small_file)
    assert set(engine.work_off()) == {JobState.SUCCEEDED}
    for node in (engine, full):
        answer = node.query_frame("hall", names[1], R)
        assert (answer.index_version, answer.model[:6]) == (1, "depth-")
    engine.publish_due()
    answer = engine.ask(uploads[4], R)
    assert (answer.index_version, answer.counts.map) == (1, 12)
    assert matches_of(answer) == right(names, by_model, answer.model, 4)
    assert not before.exists()
    after = index_folder(engine.settings.indexes, engine.row("hall"))
    assert [path for path in engine.settings.indexes.iterdir() if path.is_dir()] == [after]
    # the next version is due again after as many frames, and not before
    assert engine.publish_due() == 0


def test_a_rejected_frame_is_gone_for_readers_that_knew_it(
    full, make_engine, uploads, small_file, by_model, monkeypatch
):
    sleeper, names = make_engine(full.settings.data_dir), full.ids()
    assert sleeper.query_frame("hall", names[0], R).counts.map == 11
    full.reencode("hall", small_file)
    blind = full.claim("w")
    with monkeypatch.context() as patch:
        patch.setattr(working, "prepare", useless)
        full.run(blind)
    full.work_off()
    full.publish_due()
    assert full.get_frame("hall", blind.frame.id).reason == "nothing"
    switch(full, "depth")
    at = names.index(blind.frame.id)
    other = (at + 1) % 12
    wanted = right(names, by_model, full.get_map("hall").model, other)
    answer = sleeper.ask(uploads[other], R)
    assert matches_of(answer) == [item for item in wanted if item[0] != blind.frame.id]
    # what one model rejects another has to look at: it is found again
    assert full.get_frame("hall", blind.frame.id).state == FrameState.RECEIVED
    assert full.work_off() == [JobState.SUCCEEDED]
    answer = sleeper.ask(uploads[other], R)
    assert matches_of(answer) == wanted


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
    full, make_engine, uploads, small_file, by_model, stop, switched
):
    module, step, call = stop
    names, folder = full.ids(), str(full.settings.data_dir)
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
    answer = full.ask(uploads[7], R)
    assert matches_of(answer) == right(names, by_model, label, 7)
    full.make_due()
    other = make_engine(full.settings.data_dir, unindexed_frames=5)
    other.work_off()
    for _ in range(2):
        other.publish_due()
    assert other.get_map("hall").frames == {"indexed": 12}
    for engine in (full, other):
        answer = engine.ask(uploads[7], R)
        assert answer.model.startswith("small-")
        assert matches_of(answer) == right(names, by_model, answer.model, 7)
    assert models_of(other) == {other.get_map("hall").model_id: 12}
    digests = set(other.store.blobs.digests())
    assert {hashlib.sha256(each.data).hexdigest() for each in uploads} <= digests
    assert len(digests) >= 24  # an artifact may be left that nothing refers to
