"""Tests of `if_novel`, which keeps only frames of new places."""

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from sqlalchemy import select

from benchmarks.waiting import PATIENCE_S
from sceneprint.engine.jobs import signature_job as working
from sceneprint.engine.jobs.signature_job import find_nearest
from sceneprint.engine.maps.tombstones import Tombstones
from sceneprint.store.tables import signatures
from sceneprint_client.api import FrameState, JobState, NewMap, Query
from tests.whole_engine import Engine


@pytest.fixture
def share(prepared, signer):
    """How far two of the uploads are apart, as a share of unrelated frames."""

    def of(i, j):
        a, b = (prepared[k][0].vector.astype(np.int64) for k in (i, j))
        return float(np.sqrt(((a - b) ** 2).sum() / signer.model.unrelated_distance))

    return of


@pytest.fixture
def send(uploads):
    def run(engine, which, if_novel=None, name="hall"):
        added, new = engine.add_frame(
            name, uploads[which].data, uploads[which].meta, if_novel=if_novel
        )
        assert new
        assert engine.work_off() == [JobState.SUCCEEDED]
        return engine.get_frame(name, added.frame_id)

    return run


def matches_of(engine, uploads):
    query = Query(stages=("retrieve",), k=50)
    answer = engine.ask(uploads[0], query)
    return {match.frame_id for match in answer.matches}


def rows(engine):
    return len(engine.fetch(select(signatures.c.frame_number)).all())


def test_a_frame_whose_place_the_map_has_is_not_kept(empty, uploads, send, share):
    near, far = share(0, 1), share(0, 7)
    assert 0 < near < far
    between = (near + far) / 2
    first = send(empty, 0, 1.0)  # an empty map has no place
    assert (first.state, first.reason) == (FrameState.INDEXED, None)
    blobs = set(empty.store.blobs.digests())
    second = send(empty, 1, between)
    assert second.state == FrameState.REDUNDANT
    assert second.reason == (
        f"the map already covers this place: the distance to frame {first.frame_id} is {near:.3f} "
        f"of the distance between unrelated frames, but `if_novel` requires more than {between:g}"
    )
    assert set(empty.store.blobs.digests()) == blobs  # neither its upload nor its artifact
    assert rows(empty) == 1
    assert matches_of(empty, uploads) == {first.frame_id}
    assert empty.get_map("hall").frames == {"indexed": 1, "redundant": 1}
    third = send(empty, 7, between)
    assert third.state == FrameState.INDEXED
    assert matches_of(empty, uploads) == {first.frame_id, third.frame_id}
    assert empty.event_kinds()[1:] == ["frame.received", "frame.indexed", "frame.received",
                               "frame.redundant", "frame.received", "frame.indexed"]  # fmt: skip
    assert send(empty, 2).state == FrameState.INDEXED  # without the condition


def test_the_nearest_frame_decides_and_must_be_farther(empty, uploads, send, share):
    for which in (6, 1, 7):
        assert send(empty, which).state == FrameState.INDEXED
    nearest = min(share(0, which) for which in (6, 1, 7))
    assert nearest == share(0, 1)
    not_kept = send(empty, 0, nearest)
    assert not_kept.state == FrameState.REDUNDANT
    again = send(empty, 0, float(np.nextafter(nearest, 0)))
    assert (again.state, again.frame_id) == (FrameState.INDEXED, not_kept.frame_id)


def test_what_is_gone_is_no_place_and_a_frame_may_come_again(empty, uploads, send):
    first = send(empty, 0)
    blob_count = len(list(empty.store.blobs.digests()))
    redundant = send(empty, 1, 1.0)
    assert redundant.state == FrameState.REDUNDANT
    still = send(empty, 1, 1.0)
    assert (still.state, still.frame_id) == (FrameState.REDUNDANT, redundant.frame_id)
    empty.tombstones = Tombstones(empty.store, 0.0, empty.bell.ring)
    empty.delete_frame("hall", first.frame_id)
    kept = send(empty, 1, 1.0)
    assert (kept.state, kept.reason) == (FrameState.INDEXED, None)
    assert kept.frame_id == redundant.frame_id
    assert len({redundant.job_id, still.job_id, kept.job_id}) == 3
    assert matches_of(empty, uploads) == {kept.frame_id}
    assert len(list(empty.store.blobs.digests())) == blob_count
    added, new = empty.add_frame("hall", uploads[1].data, uploads[1].meta, if_novel=1.0)
    assert (added.frame_id, added.state, new) == (kept.frame_id, FrameState.INDEXED, False)


def test_another_map_has_other_places(empty, uploads, send):
    empty.create_map(NewMap(name="other", model="depth"))
    send(empty, 0)
    assert send(empty, 1, 1.0, "other").state == FrameState.INDEXED
    not_kept = send(empty, 1, 1.0)
    assert not_kept.state == FrameState.REDUNDANT
    assert len(list(empty.store.blobs.digests())) == 4  # the other map's frame has the same two


@pytest.mark.parametrize(
    ("first", "second", "kept", "claimed"),
    [(1.0, None, True, True), (0.01, 1.0, True, False), (1.0, 0.01, True, False),
     (1.0, 1.0, False, True)],
)  # fmt: skip
def test_who_sends_it_without_the_condition_is_not_let_down(
    empty, uploads, send, first, second, kept, claimed
):
    send(empty, 0)
    frame, _ = empty.add_frame("hall", uploads[1].data, uploads[1].meta, if_novel=first)
    work = empty.claim("w") if claimed else None
    again, new = empty.add_frame("hall", uploads[1].data, uploads[1].meta, if_novel=second)
    assert (again.frame_id, again.job_id, new) == (frame.frame_id, frame.job_id, False)
    states = [empty.run(work)] if work is not None else empty.work_off()
    assert states == [JobState.SUCCEEDED]
    state = FrameState.INDEXED if kept else FrameState.REDUNDANT
    assert empty.get_frame("hall", frame.frame_id).state == state


def test_of_two_that_are_signed_at_once_one_is_kept(make_engine, uploads, monkeypatch):
    engines = [make_engine(), make_engine()]
    engines[0].create_map(NewMap(name="hall", model="depth"))
    for which in (0, 1):
        engines[0].add_frame("hall", uploads[which].data, uploads[which].meta, if_novel=1.0)
    looked = threading.Barrier(2)

    def together(*args):
        seen = find_nearest(*args)
        assert seen.nearest is None
        looked.wait(PATIENCE_S)
        return seen

    monkeypatch.setattr(working, "find_nearest", together)
    claims = [engine.claim(f"w{i}") for i, engine in enumerate(engines)]
    with ThreadPoolExecutor(2) as pool:
        states = list(pool.map(Engine.run, engines, claims))
    assert states == [JobState.SUCCEEDED] * 2
    frames = {frame.state: frame for frame in engines[0].list_frames("hall").items}
    assert set(frames) == {FrameState.INDEXED, FrameState.REDUNDANT}
    assert frames[FrameState.INDEXED].frame_id in str(frames[FrameState.REDUNDANT].reason)
    assert rows(engines[0]) == 1


def test_a_nearest_frame_that_is_deleted_meanwhile_is_looked_for_again(
    empty, uploads, send, share, monkeypatch
):
    nearest, other = send(empty, 2), send(empty, 1)
    assert share(3, 2) < share(3, 1)
    looks = []

    def interrupted(*args):
        looks.append(find_nearest(*args))
        if len(looks) == 1:
            empty.delete_frame("hall", nearest.frame_id)
        return looks[-1]

    monkeypatch.setattr(working, "find_nearest", interrupted)
    frame = send(empty, 3, share(3, 1))
    assert (len(looks), frame.state) == (2, FrameState.REDUNDANT)
    assert other.frame_id in frame.reason
