"""Tests of scenes of answers against the service's records and clouds."""

import numpy as np
import pytest

from sceneprint_viewers.answer_scene import ONE, AnswerScene
from sceneprint_viewers.scene import (
    QUERY,
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
        sampled = client.frame_points(MAP, match.frame_id, limit=ONE.match).points
        np.testing.assert_array_equal(there[f"{path}/points"].points, sampled)
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


def test_a_moment_takes_the_place_of_the_one_before():
    writer = ListWriter()
    stream = SceneStream(writer)
    assert stream.is_empty
    a, b = (SceneEntity((name,), TextPage(name)) for name in "ab")
    for moment in (Moment([a]), Moment([a, b], 0), Moment([]), Moment([b], 1), Moment([], 2)):
        stream.write(moment)
    assert [[row.path for row in gone] for gone in writer.gone] == [[], [], [], [("a",)], [("b",)]]
    assert not stream.is_empty
