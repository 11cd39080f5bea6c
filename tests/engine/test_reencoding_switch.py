"""Tests of queries, workers and indexes at the switch to another model."""

import hashlib
import subprocess
import sys
import threading
from dataclasses import replace

import numpy as np
import pytest
from sqlalchemy import select

from sceneprint.engine.jobs import signature_job as working
from sceneprint.engine.search import local_index, query
from sceneprint.engine.search.local_index import index_folder
from sceneprint.engine.search.retrieval import Deadline
from sceneprint.errors import Busy, ModelMismatch, UselessFrame
from sceneprint.geometry.retrieval.ranking import distances
from sceneprint.models import save_model
from sceneprint.pipeline import open_signer, prepare
from sceneprint.store.tables import signatures
from sceneprint_client.api import FrameState, JobState, Query

R = Query(stages=("retrieve",), k=50, exact=True)
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
    assert held is not None
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
    assert held is not None
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
    arguments = [folder, module, step, str(call)]
    with subprocess.Popen(
        [sys.executable, "-c", WORKER, *arguments], stdout=subprocess.PIPE, text=True
    ) as worker:
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
    for i in (2, 7):
        for asked in (full, other):
            answer = asked.queries.upload(["hall"], uploads[i].data, uploads[i].meta, R)
            assert answer.model.startswith("small-")
            assert found(answer) == right(names, by_model, answer.model, i)
    with other.store.database.read() as connection:
        models = connection.execute(select(signatures.c.model_id)).scalars().all()
    assert models == [other.get_map("hall").model_id] * 12
    digests = set(other.store.blobs.digests())
    assert {hashlib.sha256(each.data).hexdigest() for each in uploads} <= digests
    assert len(digests) >= 24  # an artifact may be left that nothing refers to
