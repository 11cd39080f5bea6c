"""Tests of scenes of answers against the service's records and clouds."""

import numpy as np
import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint_client import meta_of
from sceneprint_viewers.answer_scene import MANY, ONE, AnswerScene
from sceneprint_viewers.map_scene import map_runs
from sceneprint_viewers.scene import (
    QUERY,
    STRONG,
    Moment,
    Placement,
    SceneEntity,
    SceneStream,
    TextPage,
)

from .conftest import MAP, ListWriter, moved


@pytest.fixture(scope="module")
def frame(unseen):
    return unseen[0]


@pytest.fixture(scope="module")
def answer(client, frame):
    answer = client.query(MAP, frame)
    assert answer.status == "found", answer.reason
    assert answer.location is not None
    return answer


def drawn(client, answer, map_frames=3):
    writer = ListWriter()
    scene = AnswerScene(SceneStream(writer), client, map_frames=map_frames)
    camera = next(client.frames(MAP)).intrinsics
    scene.add(answer, "my frame", "what is said", camera)
    return writer


def test_the_query_lies_where_the_answer_says(client, frame, answer):
    writer = drawn(client, answer)
    there = writer.contents()
    space = answer.location.pose.parent_frame
    placed = there[f"{space}/query"]
    np.testing.assert_array_equal(placed.T_parent_child, answer.location.pose.matrix)
    assert placed.child == "query.optical"
    points = there[f"{space}/query/points"]
    seen = client.query_points(answer.query_id).points
    np.testing.assert_array_equal(points.points, seen)
    assert set(map(tuple, points.colours.tolist())) == {QUERY}
    assert there[f"{space}/query/label"].text == "my frame: found"
    assert there["answer"].text == "what is said"
    truth = frame.pose
    assert np.linalg.norm(placed.T_parent_child - truth) < 0.05


def test_matches_lie_where_the_map_has_them(client, frame, answer):
    there = drawn(client, answer).contents()
    placed = [m for m in answer.matches if m.validation.status in ("accepted", "ambiguous")]
    assert len(placed) >= 2
    space = answer.location.pose.parent_frame
    for number, match in enumerate(placed, start=1):
        path = f"{space}/matches/{number}"
        record = client.frame(match.map, match.frame_id)
        assert match.transform is not None
        np.testing.assert_array_equal(there[path].T_parent_child, record.pose.matrix)
        told = client.frame_points(MAP, match.frame_id, limit=ONE.match).points
        np.testing.assert_array_equal(there[f"{path}/points"].points, told)
        [vote] = there[f"{path}/vote"].strips  # from the match to where it puts the query
        at = moved(record.pose.matrix, vote)
        np.testing.assert_allclose(at[0], np.array(record.pose.matrix)[:3, 3], atol=1e-9)
        np.testing.assert_allclose(at[1], np.array(match.pose_in_map.matrix)[:3, 3], atol=1e-6)
        label = there[f"{path}/label"].text
        name = match.name.rpartition("/")[2]
        assert label.startswith(f"#{match.rank} {name} {match.validation.strength}")
    assert f"{space}/matches/{len(placed) + 1}" not in there


def test_what_is_not_found_lies_in_a_space_of_its_own(client, answer):
    lost = answer.model_copy(update={"status": "not_found", "location": None, "matches": []})
    writer = drawn(client, lost)
    there = writer.contents()
    assert {path.partition("/")[0] for path in there} == {"query.optical", "answer"}
    assert [one for one in there.values() if isinstance(one, Placement)] == []
    assert writer.contents(-2)["query.optical"].up.tolist() == [0, -1, 0]


def test_the_map_is_drawn_once_and_where_its_frames_are(client, answer):
    writer = ListWriter()
    scene = AnswerScene(SceneStream(writer), client, MANY)
    for index in (0, 3):
        scene.add(answer, "my frame", "", None, index, 10**9 * index)
    *maps, first, second = writer.moments
    assert [one.index for one in maps] == [None] * len(maps)
    assert [(one.index, one.stamp_ns) for one in (first, second)] == [(0, 0), (3, 3 * 10**9)]
    spaces = {run.parent_frame for run in map_runs(client, MAP)}
    assert len(maps) == len(spaces) == 2  # the rooms
    for number in range(2):
        there = writer.contents(number)
        [space] = {path.partition("/")[0] for path in there}
        frames = [f for f in client.frames(MAP) if f.pose and f.pose.parent_frame == space]
        points = there[f"{space}/map/points"].points
        expected = [client.frame_points(MAP, f.frame_id, "parent").points for f in frames]
        assert len(points) == sum(map(len, expected))
        low, high = (f(np.concatenate(expected), axis=0) for f in (np.min, np.max))
        np.testing.assert_allclose((points.min(axis=0), points.max(axis=0)), (low, high), atol=1e-3)
        [track] = (one for path, one in there.items() if "/tracks/" in path)
        at = [np.array(f.pose.matrix)[:3, 3] for f in frames if f.pose is not None]
        np.testing.assert_allclose(track.strips[0], at, atol=1e-5)
        assert there[space].up.tolist() == [0, 0, 1]


@pytest.fixture
def unposed(client, walk):
    """A map of a frame without a pose."""
    client.create_map("unposed")
    client.upload("unposed", walk[0], meta_of(walk[0], with_pose=False), wait_s=PATIENCE_S)
    yield "unposed"
    client.delete_map("unposed")


def test_without_poses_the_query_lies_in_its_best_match(client, walk, unposed):
    answer = client.query(unposed, walk[1])
    [match] = answer.matches
    assert match.validation.status == "accepted"
    writer = ListWriter()
    AnswerScene(SceneStream(writer), client).add(answer, "my frame", "", None)
    there = writer.contents()
    space = f"{match.frame_id}.optical"
    np.testing.assert_array_equal(there[f"{space}/query"].T_parent_child, match.transform.matrix)
    assert f"{space}/matches/1" not in there  # its frame is the space
    assert set(map(tuple, there[f"{space}/matches/1/points"].colours.tolist())) <= {
        STRONG, (120, 180, 255),
    }  # fmt: skip
    assert writer.contents(-2)[space].up.tolist() == [0, -1, 0]


def test_a_moment_takes_the_place_of_the_one_before():
    writer = ListWriter()
    stream = SceneStream(writer)
    assert stream.is_empty
    a, b = (SceneEntity((name,), TextPage(name)) for name in "ab")
    for moment in (Moment([a]), Moment([a, b], 0), Moment([]), Moment([b], 1), Moment([], 2)):
        stream.write(moment)
    assert [[one.path for one in gone] for gone in writer.gone] == [[], [], [], [("a",)], [("b",)]]
    assert not stream.is_empty
