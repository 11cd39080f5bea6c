"""Tests of written scenes, which Rerun reads back."""

import numpy as np
import pytest

from sceneprint_client.poses import rotation_of
from sceneprint_viewers.mcap_writer import mcap_file, upright
from sceneprint_viewers.scene import (
    LineSet,
    Moment,
    Placement,
    PointSet,
    SceneEntity,
    SceneStream,
    TextLabel,
    TextPage,
    UpAxis,
)

from .conftest import UPDATE, drawn_at, mcap_rows, moves_of

#: 2023-11-14, and the second moment 1.5 s later.
START = 1_700_000_000_123_456_789
LATER = START + 1_500_000_000
POINTS = np.array([[0.0, 0.5, -1.25], [3.0, 4.0, 5.0]])
COLOURS = np.array([[255, 128, 0], [1, 2, 3]], np.uint8)
T = np.eye(4)
T[:3, :3] = rotation_of(np.array([0.5, -0.5, 0.5, 0.5]))
T[:3, 3] = 1.5, -2.0, 0.25
SQUARE = np.array([[0.0, 0, 0], [0, 1, 0], [0, 1, 1]])


def written(stream):
    """A map, then a query with a label, then nothing but a text."""
    hall, query = ("my hall",), ("my hall", "query")
    points = SceneEntity((*hall, "map", "points"), PointSet(POINTS, COLOURS, 0.012))
    stream.write(Moment([SceneEntity(hall, UpAxis(np.array([0.0, -1.0, 0.0]))), points]))
    entities = [
        SceneEntity(query, Placement(T, "query.optical")),
        SceneEntity((*query, "points"), PointSet(-POINTS, COLOURS, 0.02)),
        SceneEntity((*query, "sensor"), LineSet([SQUARE, SQUARE[:2]], [(255, 0, 0)] * 2)),
        SceneEntity((*query, "label"), TextLabel(SQUARE[1], "#1 name", (0, 255, 0))),
        SceneEntity(("answer",), TextPage("found\n  at `here`")),
    ]
    stream.write(Moment(entities, 0, START))
    stream.write(Moment([SceneEntity(("answer",), TextPage("lost"))], 1, LATER))


def packed(colours):
    """Colours as Rerun has them: red, green, blue, opaque in one number."""
    return [(int(r) << 24) + (int(g) << 16) + (int(b) << 8) + 255 for r, g, b in colours]


def at(rows, path, component):
    return [row for row in rows if row.path == path and component in row.values]


def test_an_mcap_file_for_foxglove(tmp_path):
    path = tmp_path / "a.mcap"
    with mcap_file(path) as writer:
        written(SceneStream(writer))
    rows = mcap_rows(path)
    [cloud] = at(rows, "/my_hall/map/points", "Points3D:positions")
    assert cloud.time_ns == START  # what stays has the time of the first moment
    assert cloud.values["Points3D:positions"] == POINTS.tolist()
    assert cloud.values["Points3D:colors"] == packed(COLOURS)
    assert cloud.values["CoordinateFrame:frame"] == ["my hall"]
    first, emptied = at(rows, "/my_hall/query/points", "CoordinateFrame:frame")
    assert first.values["Points3D:positions"] == (-POINTS).tolist()
    assert first.values["CoordinateFrame:frame"] == ["query.optical"]
    assert (emptied.time_ns, emptied.values.get("Points3D:positions", [])) == (LATER, [])
    [move] = moves_of(rows, "query.optical")
    query = move.values
    assert query["Transform3D:parent_frame"] == ["my hall"]
    assert query["Transform3D:translation"] == [[1.5, -2.0, 0.25]]
    [q] = query["Transform3D:quaternion"]
    np.testing.assert_allclose(rotation_of(np.array(q)), T[:3, :3], atol=1e-7)
    [move] = moves_of(rows, "my hall")
    hall = move.values
    assert hall["Transform3D:parent_frame"] == ["my hall upright"]
    [q] = hall["Transform3D:quaternion"]
    np.testing.assert_allclose(rotation_of(np.array(q)) @ (0, -1, 0), (0, 0, 1), atol=1e-7)
    logs = [row for row in rows if row.path == "/log" and "TextLog:text" in row.values]
    assert [(log.time_ns, log.values["TextLog:text"]) for log in logs] == [
        (START, ["found\n  at `here`"]), (LATER, ["lost"]),
    ]  # fmt: skip
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]


def test_lines_and_labels_for_foxglove(tmp_path):
    path = tmp_path / "a.mcap"
    with mcap_file(path) as writer:
        written(SceneStream(writer))
    first, second = at(mcap_rows(path), "/my_hall/query", UPDATE)
    assert (first.time_ns, second.time_ns) == (START, LATER)
    entities = drawn_at([first], "/my_hall/query")
    assert set(entities) == {"/my_hall/query/sensor", "/my_hall/query/label"}
    sensor = entities["/my_hall/query/sensor"]
    assert sensor["frame_id"] == "query.optical"
    strip, _ = sensor["lines"]
    assert [[p["x"], p["y"], p["z"]] for p in strip["points"]] == SQUARE.tolist()
    assert strip["color"] == {"r": 1.0, "g": 0.0, "b": 0.0, "a": 1.0}
    assert strip["pose"]["orientation"] == {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
    [label] = entities["/my_hall/query/label"]["texts"]
    assert (label["text"], label["billboard"]) == ("#1 name", True)
    assert label["pose"]["position"] == {"x": 0.0, "y": 1.0, "z": 0.0}
    [update] = second.values[UPDATE]
    assert {deletion["id"] for deletion in update["deletions"]} == set(entities)
    assert not update["entities"]


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 0, -1), (1, 0, 0), (0.6, 0, 0.8)])
def test_up_is_turned_to_z(up):
    R = upright(np.array(up, float))[:3, :3]
    np.testing.assert_allclose(R @ up, (0, 0, 1), atol=1e-12)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1)


def test_a_file_is_there_whole_or_not_at_all(tmp_path):
    path = tmp_path / "scene"
    with mcap_file(path):
        pass
    assert list(tmp_path.iterdir()) == []  # nothing was shown, as all frames were refused
    path.write_bytes(b"old")

    def interrupted():
        with mcap_file(path) as writer:
            written(SceneStream(writer))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("scene", b"old")]
    with mcap_file(path) as writer:
        written(SceneStream(writer))
    assert [path.name for path in tmp_path.iterdir()] == ["scene"]
    assert len(path.read_bytes()) > 1000


def test_without_stamps_moments_are_a_second_apart(tmp_path):
    path = tmp_path / "a.mcap"
    with mcap_file(path) as writer:
        stream = SceneStream(writer)
        for i in (0, 1, 4):
            stream.write(Moment([SceneEntity(("answer",), TextPage(f"{i}"))], i))
    logs = at(mcap_rows(path), "/log", "TextLog:text")
    assert [row.time_ns for row in logs] == [0, 1_000_000_000, 4_000_000_000]
