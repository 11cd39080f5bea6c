"""Scenes written and read again: by Rerun's reader of its files, and by its reader of MCAP files,
which is not that of the library that wrote them.
"""

from __future__ import annotations

import resource
import subprocess
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun_cli
from rerun.chunk import RrdReader

from benchmarks.waiting import PATIENCE_S
from sceneprint.errors import InvalidRequest, Unreachable
from sceneprint.scenes.mcap_writer import mcap_file, upright
from sceneprint.scenes.rerun_writer import check_viewer, rerun_file, rerun_viewer
from sceneprint.scenes.scene import (
    LineSet,
    Moment,
    Placement,
    PointSet,
    SceneEntity,
    SceneStream,
    SceneWriter,
    TextLabel,
    TextPage,
    UpAxis,
)
from sceneprint_client.poses import rotation_of

from .conftest import Logged, mcap_rows, rrd_rows

#: 2023-11-14, and the second moment 1.5 s later.
START = 1_700_000_000_123_456_789
LATER = START + 1_500_000_000
POINTS = np.array([[0.0, 0.5, -1.25], [3.0, 4.0, 5.0]])
COLOURS = np.array([[255, 128, 0], [1, 2, 3]], np.uint8)
T = np.eye(4)
T[:3, :3] = rotation_of(np.array([0.5, -0.5, 0.5, 0.5]))
T[:3, 3] = 1.5, -2.0, 0.25
SQUARE = np.array([[0.0, 0, 0], [0, 1, 0], [0, 1, 1]])


def written(stream: SceneStream) -> None:
    """A map, then a query with a label, then nothing but a text."""
    stream.write(
        Moment(
            [
                SceneEntity(("my hall",), UpAxis(np.array([0.0, -1.0, 0.0]))),
                SceneEntity(("my hall", "map", "points"), PointSet(POINTS, COLOURS, 0.012)),
            ]
        )
    )
    query = ("my hall", "query")
    stream.write(
        Moment(
            [
                SceneEntity(query, Placement(T, "query.optical")),
                SceneEntity((*query, "points"), PointSet(-POINTS, COLOURS, 0.02)),
                SceneEntity((*query, "sensor"), LineSet([SQUARE, SQUARE[:2]], [(255, 0, 0)] * 2)),
                SceneEntity((*query, "label"), TextLabel(SQUARE[1], "#1 name", (0, 255, 0))),
                SceneEntity(("answer",), TextPage("found\n  at `here`")),
            ],
            0,
            START,
        )
    )
    stream.write(Moment([SceneEntity(("answer",), TextPage("lost"))], 1, LATER))


def packed(colours: Any) -> list[int]:
    """Colours as Rerun has them: red, green, blue, opaque in one number."""
    return [(int(r) << 24) + (int(g) << 16) + (int(b) << 8) + 255 for r, g, b in colours]


def at(rows: list[Logged], path: str, component: str) -> list[Logged]:
    return [one for one in rows if one.path == path and component in one.values]


def test_a_recording_for_rerun(tmp_path: Path) -> None:
    path = tmp_path / "a.rrd"
    with rerun_file(path, "a title") as writer:
        written(SceneStream([writer]))
    rows = rrd_rows(path)
    [cloud] = at(rows, "/my\\ hall/map/points", "Points3D:positions")
    assert (cloud.index, cloud.values["Points3D:positions"]) == (None, POINTS.tolist())
    assert cloud.values["Points3D:colors"] == packed(COLOURS)
    assert cloud.values["Points3D:radii"] == pytest.approx([0.006])
    [up] = at(rows, "/my\\ hall", "ViewCoordinates:xyz")
    assert up.values["ViewCoordinates:xyz"] == [[3, 2, 5]]  # right, down, forward
    [placed] = at(rows, "/my\\ hall/query", "Transform3D:translation")
    assert (placed.index, placed.time_ns) == (0, START)
    assert placed.values["Transform3D:translation"] == [[1.5, -2.0, 0.25]]
    [q] = placed.values["Transform3D:quaternion"]
    np.testing.assert_allclose(rotation_of(np.array(q)), T[:3, :3], atol=1e-7)
    [query] = at(rows, "/my\\ hall/query/points", "Points3D:positions")
    assert query.values["Points3D:positions"] == (-POINTS).tolist()
    [lines] = at(rows, "/my\\ hall/query/sensor", "LineStrips3D:strips")
    assert lines.values["LineStrips3D:strips"] == [SQUARE.tolist(), SQUARE[:2].tolist()]
    assert lines.values["LineStrips3D:colors"] == packed([(255, 0, 0)] * 2)
    [label] = at(rows, "/my\\ hall/query/label", "Points3D:labels")
    assert label.values["Points3D:labels"] == ["#1 name"]
    assert label.values["Points3D:positions"] == [[0, 1, 0]]
    texts = at(rows, "/answer", "TextDocument:text")
    assert [(one.index, one.time_ns, one.values["TextDocument:text"]) for one in texts] == [
        (0, START, ["```\nfound\n  at 'here'\n```"]), (1, LATER, ["```\nlost\n```"]),
    ]  # fmt: skip
    cleared = {one.path for one in rows if "Clear:is_recursive" in one.values and one.index == 1}
    assert cleared == {f"/my\\ hall/query{part}" for part in ("", "/points", "/sensor", "/label")}
    reader = RrdReader(path)  # the layout is sent again where there is more to lay out
    assert (len(reader.recordings()), len(reader.blueprints())) == (1, 2)
    assert [one.name for one in tmp_path.iterdir()] == ["a.rrd"]


def test_an_mcap_file_for_foxglove(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with mcap_file(path) as writer:
        written(SceneStream([writer]))
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
    moves = {
        one.values["Transform3D:child_frame"][0]: one
        for one in rows
        if "Transform3D:child_frame" in one.values
    }
    assert set(moves) == {"query.optical", "my hall"}
    query = moves["query.optical"].values
    assert query["Transform3D:parent_frame"] == ["my hall"]
    assert query["Transform3D:translation"] == [[1.5, -2.0, 0.25]]
    [q] = query["Transform3D:quaternion"]
    np.testing.assert_allclose(rotation_of(np.array(q)), T[:3, :3], atol=1e-7)
    hall = moves["my hall"].values
    assert hall["Transform3D:parent_frame"] == ["my hall upright"]
    [q] = hall["Transform3D:quaternion"]
    np.testing.assert_allclose(rotation_of(np.array(q)) @ (0, -1, 0), (0, 0, 1), atol=1e-7)
    logs = [one for one in rows if one.path == "/log" and "TextLog:text" in one.values]
    assert [(one.time_ns, one.values["TextLog:text"]) for one in logs] == [
        (START, ["found\n  at `here`"]), (LATER, ["lost"]),
    ]  # fmt: skip
    assert [one.name for one in tmp_path.iterdir()] == ["a.mcap"]


def test_lines_and_labels_for_foxglove(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with mcap_file(path) as writer:
        written(SceneStream([writer]))
    component = "foxglove.SceneUpdate:message"
    first, second = at(mcap_rows(path), "/my_hall/query", component)
    assert (first.time_ns, second.time_ns) == (START, LATER)
    [update] = first.values[component]
    entities = {one["id"]: one for one in update["entities"]}
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
    [update] = second.values[component]
    assert {one["id"] for one in update["deletions"]} == set(entities)
    assert not update["entities"]


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 0, -1), (1, 0, 0), (0.6, 0, 0.8)])
def test_up_is_turned_to_z(up: tuple[float, float, float]) -> None:
    R = upright(np.array(up, float))[:3, :3]
    np.testing.assert_allclose(R @ up, (0, 0, 1), atol=1e-12)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1)


def to_rerun(path: Path) -> AbstractContextManager[SceneWriter]:
    return rerun_file(path, "a title")


@pytest.mark.parametrize("write_to", [to_rerun, mcap_file])
def test_a_file_is_there_whole_or_not_at_all(
    tmp_path: Path, write_to: Callable[[Path], AbstractContextManager[SceneWriter]]
) -> None:
    path = tmp_path / "scene"
    with write_to(path):
        pass
    assert list(tmp_path.iterdir()) == []  # nothing was shown, as all frames were refused
    path.write_bytes(b"old")

    def interrupted() -> None:
        with write_to(path) as writer:
            written(SceneStream([writer]))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert [(one.name, one.read_bytes()) for one in tmp_path.iterdir()] == [("scene", b"old")]
    with write_to(path) as writer:
        written(SceneStream([writer]))
    assert [one.name for one in tmp_path.iterdir()] == ["scene"]
    assert len(path.read_bytes()) > 1000


@pytest.mark.parametrize("write_to", [to_rerun, mcap_file])
def test_a_full_disk_is_told_and_nothing_is_left(
    tmp_path: Path, write_to: Callable[[Path], AbstractContextManager[SceneWriter]]
) -> None:
    rng = np.random.default_rng(0)
    cloud = PointSet(rng.uniform(size=(100_000, 3)), np.zeros((100_000, 3), np.uint8), 0.01)
    path = tmp_path / "scene"

    def fill() -> None:
        with write_to(path) as writer:
            stream = SceneStream([writer])
            for i in range(3):
                stream.write(Moment([SceneEntity(("a", "b"), cloud)], i))

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, before[1]))  # stands for a full disk
    try:
        with pytest.raises(OSError, match="File too large") as caught:
            fill()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert caught.value.filename == str(path)
    assert list(tmp_path.iterdir()) == []


def test_without_stamps_moments_are_a_second_apart(tmp_path: Path) -> None:
    rrd, mcap = tmp_path / "a.rrd", tmp_path / "a.mcap"
    with rerun_file(rrd, "a") as one, mcap_file(mcap) as other:
        stream = SceneStream([one, other])
        for i in (0, 1, 4):
            stream.write(Moment([SceneEntity(("answer",), TextPage(f"{i}"))], i))
    texts = at(rrd_rows(rrd), "/answer", "TextDocument:text")
    assert [(row.index, row.time_ns) for row in texts] == [(0, None), (1, None), (4, None)]
    logs = at(mcap_rows(mcap), "/log", "TextLog:text")
    assert [row.time_ns for row in logs] == [0, 1_000_000_000, 4_000_000_000]


def test_a_viewer_gets_what_a_file_would(tmp_path: Path) -> None:
    """Rerun's own program, which saves what it receives."""
    path = tmp_path / "live.rrd"
    program = Path(str(rerun_cli.__file__)).parent / "rerun"
    command = [program, "--bind", "127.0.0.1", "--port", "0", "--save", path]
    port = _free_port()
    command[4] = str(port)
    url = f"rerun+http://127.0.0.1:{port}/proxy"
    viewer = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        while True:
            try:
                check_viewer(url)
                break
            except Unreachable:
                assert viewer.poll() is None
        with rerun_viewer(url, "a title") as writer:
            written(SceneStream([writer]))
        while b"map/points" not in (path.read_bytes() if path.exists() else b""):
            assert viewer.poll() is None
    finally:
        viewer.terminate()
        viewer.wait(PATIENCE_S)


def _free_port() -> int:
    import socket

    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


@pytest.mark.parametrize(
    "url", ["http://127.0.0.1:9876/proxy", "rerun+http://:9/proxy", "rerun+http://host:9/x",
            "rerun+http://host:99999999/proxy", "here"]
)  # fmt: skip
def test_an_address_that_is_no_viewers_is_refused(url: str) -> None:
    with pytest.raises(InvalidRequest, match="is not the address of a Rerun viewer"):
        check_viewer(url)


def test_an_address_where_nobody_listens_is_told() -> None:
    with pytest.raises(Unreachable, match="No Rerun viewer listens at"):
        check_viewer(f"rerun+http://127.0.0.1:{_free_port()}/proxy")


def test_nothing_is_loaded_that_is_not_asked_for() -> None:
    code = "import sys; import sceneprint.cli.query; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert {"rerun", "foxglove", "pyarrow"} & set(done.stdout.split()) == set()
