"""Tests of up vectors of frames and maps: storage, estimation, use, and wrong vectors."""

import math

import numpy as np
import pytest

from sceneprint.engine.maps.map_lifecycle import edit_frame, edit_map
from sceneprint.engine.search.query import localization_of
from sceneprint.engine.search.up_vectors import known_ups
from sceneprint.errors import FrameConflict, InvalidRequest
from sceneprint.store.maps import find_frame, find_map
from sceneprint_client.api import NewMap, Query
from sceneprint_client.api.base import FrameMeta

Z = [0.0, 0.0, 1.0]  #: up in the world of synthetic rooms


def up_of(upload, tilt=0.0):
    """Up in the sensor of an upload, turned by that many degrees about its x axis."""
    c, s = math.cos(math.radians(tilt)), math.sin(math.radians(tilt))
    turn = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    return (turn @ upload.pose[:3, :3].T @ Z).tolist()


def with_up(meta, up):
    return FrameMeta.model_validate(dict(meta) | {"up": up})


def row_of(engine, frame_id):
    with engine.store.database.read() as connection:
        return find_frame(connection, find_map(connection, "hall"), frame_id)


def test_a_frame_keeps_its_up(empty, uploads):
    one = uploads[0]
    near = [0.0, -1.005, 0.0]  # within a hundredth of a unit vector
    added, _ = empty.add_frame("hall", one.data, with_up(one.meta, near))
    answer = empty.get_frame("hall", added.frame_id)
    assert (answer.up.x, answer.up.y, answer.up.z) == (0.0, -1.0, 0.0)
    again, new = empty.add_frame("hall", one.data, with_up(one.meta, [0, -1, 0]))
    assert (again.frame_id, new) == (added.frame_id, False)
    for other in (None, [0, 0, 1]):
        with pytest.raises(FrameConflict, match="different up"):
            empty.add_frame("hall", one.data, with_up(one.meta, other))
    moved = edit_frame(empty.store, "hall", added.frame_id, {"up": [1, 0, 0]})
    assert moved.up.x == 1.0
    bare = edit_frame(empty.store, "hall", added.frame_id, {"up": None})
    assert bare.up is None
    assert len({answer.etag, moved.etag, bare.etag}) == 3


def test_a_map_has_an_up_that_can_be_changed(empty):
    new = NewMap.model_validate({"name": "level", "up": {"x": 0, "y": 0, "z": 1}})
    record, _ = empty.create_map(new)
    assert record.up.z == 1.0
    answer = edit_map(empty.store, "level", {"up": [0, -1, 0]}, [str(record.etag)])
    assert answer.up.y == -1.0
    assert answer.etag != record.etag
    assert edit_map(empty.store, "level", {"title": "Level"}).up == answer.up
    assert edit_map(empty.store, "level", {"up": None}).up is None
    with pytest.raises(InvalidRequest, match="length is 2, not 1"):
        edit_map(empty.store, "level", {"up": [0, 0, 2]})


def ups(engine, names):
    """Numbers of frames, and a function that returns their known ups."""
    numbers = [row_of(engine, name).number for name in names]

    def known():
        with engine.store.database.read() as connection:
            return known_ups(connection, numbers)

    return numbers, known


def test_a_map_tells_its_frames_their_up(full, uploads):
    names, numbers, known = full.ids(), *ups(full, full.ids())
    assert known() == {}
    edit_map(full.store, "hall", {"up": Z})
    actual = known()
    assert sorted(actual) == sorted(numbers)
    for number, upload in zip(numbers, uploads, strict=True):
        np.testing.assert_allclose(actual[number], up_of(upload), atol=1e-12)
    # a frame's own up counts while it agrees, and not where the map knows better
    edit_frame(full.store, "hall", names[0], {"up": up_of(uploads[0], 3)})
    edit_frame(full.store, "hall", names[1], {"up": up_of(uploads[1], 30)})
    actual = known()
    np.testing.assert_allclose(actual[numbers[0]], up_of(uploads[0], 3), atol=1e-12)
    np.testing.assert_allclose(actual[numbers[1]], up_of(uploads[1]), atol=1e-12)


def test_the_up_of_a_parent_frame_is_learnt_from_three_frames(full, uploads):
    names, numbers, known = full.ids(), *ups(full, full.ids())
    for i in (0, 1):
        edit_frame(full.store, "hall", names[i], {"up": up_of(uploads[i])})
    assert sorted(known()) == numbers[:2]
    edit_frame(full.store, "hall", names[2], {"up": up_of(uploads[2], 40)})
    actual = known()  # two of three agree: they outvote the third, and speak for the room
    assert sorted(actual) == numbers[:6]
    for i in range(6):
        np.testing.assert_allclose(actual[numbers[i]], up_of(uploads[i]), atol=1e-9)
    edit_frame(full.store, "hall", names[1], {"up": up_of(uploads[1], -40)})
    actual = known()  # no two agree: nothing is learnt, and each has its own
    assert sorted(actual) == numbers[:3]
    edit_frame(full.store, "hall", names[7], {"pose": None, "up": Z})
    assert known()[numbers[7]].tolist() == Z


@pytest.fixture
def level(full):
    edit_map(full.store, "hall", {"up": Z})
    return full


def test_a_query_with_up_is_found_as_without(level, uploads):
    one = uploads[2]
    query = Query(keep=False, k=3)
    before = level.ask(one, query)
    answer = level.ask(one, query, meta=with_up(one.meta, up_of(one)))
    assert (before.status, answer.status) == ("found", "found")
    assert before.counts.accepted <= answer.counts.accepted
    assert all(match.validation.tilt_deg is None for match in before.matches)
    accepted = [match for match in answer.matches if match.validation.status == "accepted"]
    assert all((match.validation.tilt_deg or 0.0) < 2.0 for match in accepted)
    assert accepted[0].validation.tilt_deg is not None
    away = np.array(answer.location.pose.matrix)[:3, 3] - one.pose[:3, 3]
    assert np.linalg.norm(away) < 0.05


def test_a_wrong_up_is_told_and_gives_no_pose(level, uploads):
    one = uploads[2]
    meta = with_up(one.meta, up_of(one, 20))
    answer = level.ask(one, Query(k=3, explain=True), meta=meta)
    assert (answer.status, answer.location, answer.counts.accepted) == ("not_found", None, 0)
    first = answer.matches[0].validation
    assert first.status == "rejected"
    assert first.strength is None
    assert first.tilt_deg == pytest.approx(20, abs=1.5)
    assert "check the IMU" in first.reason.replace("Check", "check")
    assert (answer.cause, answer.reason) == ("gravity", first.reason)
    assert localization_of(answer).reason == first.reason
    assert answer.matches[0].uncertainty is None
    again = level.inspection.match(answer.query_id, answer.matches[0].frame_id)
    assert again.validation == first


def test_a_stored_frame_asks_with_the_up_that_is_known_of_it(level):
    name = level.ids()[2]
    answer = level.query_frame("hall", name, Query(keep=False))
    assert answer.status == "found"
    assert answer.matches[0].validation.tilt_deg == pytest.approx(0.0, abs=2.0)
