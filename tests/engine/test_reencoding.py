"""Tests of re-encoding in the background, with the same result as a new map."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from sqlalchemy import select

from sceneprint.engine.maps import map_lifecycle
from sceneprint.errors import Conflict, UnknownMap, UnreadableModel
from sceneprint.models import save_model
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


def ids(engine, state=None):
    return [frame.frame_id for frame in engine.list_frames("hall", state=state).items]


def said(engine, answer):
    """All of an answer but what no two have in common, frames by their places in the map."""
    places = {name: str(i) for i, name in enumerate(ids(engine))}
    told = answer.model_dump_json(exclude={"query_id", "milliseconds", "index_version"})
    for name, place in places.items():
        told = told.replace(name, place)
    return json.loads(told)


def models_of(engine):
    """How many signatures each model has."""
    with engine.store.database.read() as connection:
        found = connection.execute(select(signatures.c.model_id)).scalars().all()
    return {model_id: found.count(model_id) for model_id in set(found)}


def queued(engine):
    with engine.store.database.read() as connection:
        asked = select(jobs.c.kind, jobs.c.priority, jobs.c.model_id).where(
            jobs.c.state == JobState.QUEUED
        )
        return [tuple(row) for row in connection.execute(asked)]


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
    names, others = ids(full), ids(fresh)
    for query, which in ((R, (0, 4, 9)), (Query(seed=3), (4,))):
        for i in which:
            for asked in (full, other):
                answer = asked.queries.upload(["hall"], uploads[i].data, uploads[i].meta, query)
                wanted = fresh.queries.upload(["hall"], uploads[i].data, uploads[i].meta, query)
                assert said(full, answer) == said(fresh, wanted)
            answer = full.query_frame("hall", names[i], query)
            assert said(full, answer) == said(fresh, fresh.query_frame("hall", others[i], query))
    assert work_off(full) == []
    full.publish_due()
    assert full.get_map("hall") == after


def test_what_comes_and_goes_meanwhile(full, uploads, far_off, short_sighted, work_off):
    names = ids(full)
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
    assert frame.reason is not None
    assert "range" in frame.reason
    answer = full.queries.upload(["hall"], uploads[4].data, uploads[4].meta, R)
    assert {match.frame_id for match in answer.matches} == set(ids(full, FrameState.INDEXED))
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
    full.delete_frame("hall", ids(full)[5])
    full.publish_due()
    told = full.get_map("hall")
    assert (told.model_id, told.reencoding) == (now.model_id, None)
    assert told.frames == {"deleted": 1, "indexed": 11}


def test_what_is_given_up_leaves_nothing(full, short_sighted, uploads, work_off, told):
    before, blobs = full.get_map("hall"), set(full.store.blobs.digests())
    full.reencode("hall", short_sighted)
    for _ in range(5):
        claimed = full.claim("w")
        assert claimed is not None
        assert full.run(claimed) == JobState.SUCCEEDED
    held = full.claim("w")
    assert held is not None
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
