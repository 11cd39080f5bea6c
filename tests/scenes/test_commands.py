"""Scenes that commands write, read again and held against what the commands print."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.cli import main
from sceneprint.cli.options import stamps_of
from sceneprint.formats.dataset import Camera, FrameReference
from sceneprint.types import Intrinsics
from sceneprint_client import Client

from .conftest import MAP, WALK, Logged, Said, mcap_rows, moved, rrd_rows

Run = Callable[..., Said]


def values(rows: list[Logged], path: str, component: str) -> Any:
    """The only value of a component at a path."""
    [one] = [row.values[component] for row in rows if row.path == path and component in row.values]
    return one


def test_a_query_is_shown_where_it_was_found(
    sceneprint: Run, client: Client, unseen: tuple[FrameReference, ...], tmp_path: Path
) -> None:
    rrd, mcap = tmp_path / "a.rrd", tmp_path / "a.mcap"
    how = ("--map-frames", 2, "--json", "--rrd", rrd, "--mcap", mcap)
    said = sceneprint("query", MAP, unseen[0].path, *how)
    assert said.stderr == f"wrote {rrd}\nwrote {mcap}\n"
    answer = json.loads(said.stdout)
    rows, messages = rrd_rows(rrd), mcap_rows(mcap)
    matrix = np.array(answer["location"]["pose"]["matrix"])
    told = values(rows, "/room/query", "Transform3D:translation")
    np.testing.assert_allclose(told, [matrix[:3, 3]], atol=1e-6)
    seen = client.query_points(answer["query_id"]).points
    for one, path in ((rows, "/room/query/points"), (messages, "/room/query/points")):
        np.testing.assert_allclose(values(one, path, "Points3D:positions"), seen, atol=1e-6)
    placed = [m for m in answer["matches"] if m["validation"]["status"] == "accepted"]
    for one in (rows, messages):
        points = {row.path for row in one if "Points3D:positions" in row.values}
        points = {path for path in points if path.endswith("/points")}
        assert points == {
            "/room/map/points", "/yard/map/points", "/room/query/points",
            *(f"/room/matches/{n}/points" for n in range(1, len(placed) + 1)),
        }  # fmt: skip
    label = values(rows, "/room/matches/1/label", "Points3D:labels")
    assert label[0].startswith(f"#{placed[0]['rank']} {Path(placed[0]['name']).name} ")
    text = values(rows, "/answer", "TextDocument:text")[0]
    assert f"{unseen[0].name}: found" in text
    # the query's frame, seen from the walk, lies on the room: on the truth to 5 cm
    truth = unseen[0].pose
    assert np.linalg.norm(matrix[:3, 3] - truth[:3, 3]) < 0.05


def test_a_folder_is_a_time_line(
    sceneprint: Run, unseen: tuple[FrameReference, ...], tmp_path: Path
) -> None:
    folder = tmp_path / "two"
    folder.mkdir()
    for number, one in enumerate(unseen):
        (folder / f"{number}.png").write_bytes(one.read_bytes())
    camera = unseen[0].path.parents[1] / "intrinsics.json"
    (folder / "intrinsics.json").write_bytes(camera.read_bytes())
    rrd, mcap = tmp_path / "a.rrd", tmp_path / "a.mcap"
    how = ("--map-frames", 1, "--json", "--rrd", rrd, "--mcap", mcap)
    said = sceneprint("localize", MAP, folder, *how).stdout
    told = [json.loads(line)["pose"]["translation"] for line in said.splitlines()]
    rows = [row for row in rrd_rows(rrd) if row.path == "/room/query"]
    rows = [row for row in rows if "Transform3D:translation" in row.values]
    assert [row.index for row in rows] == [0, 1]
    for row, one in zip(rows, told, strict=True):
        at = [one["x"], one["y"], one["z"]]
        np.testing.assert_allclose(row.values["Transform3D:translation"], [at], atol=1e-6)
    messages = [row for row in mcap_rows(mcap) if row.path == "/room/query/points"]
    times = [row.time_ns for row in messages if "Points3D:positions" in row.values]
    assert times == [0, 1_000_000_000]


def test_the_frames_of_a_map_are_shown(sceneprint: Run, client: Client, tmp_path: Path) -> None:
    rrd, mcap = tmp_path / "a.rrd", tmp_path / "a.mcap"
    listed = sceneprint("frames", MAP, "--session", "room", "--rrd", rrd, "--mcap", mcap).stdout
    assert len(listed.splitlines()) == 1 + WALK
    frames = list(client.frames(MAP, session="room"))
    clouds = [client.frame_points(MAP, one.frame_id, "parent").points for one in frames]
    rows, messages = rrd_rows(rrd), mcap_rows(mcap)
    for one in (rows, messages):
        points = np.array(values(one, "/room/map/points", "Points3D:positions"))
        assert len(points) == sum(map(len, clouds))
        np.testing.assert_allclose(points[: len(clouds[0])], clouds[0], atol=3e-4)
    placed = [row for row in rows if row.path.startswith("/room/frames/")]
    placed = [row for row in placed if "Transform3D:translation" in row.values]
    poses = {one.frame_id: one.pose for one in frames}
    assert {row.path.rpartition("/")[2] for row in placed} == set(poses)
    for row in placed:
        pose = poses[row.path.rpartition("/")[2]]
        assert pose is not None
        at = pose.translation
        told = row.values["Transform3D:translation"]
        np.testing.assert_allclose(told, [[at.x, at.y, at.z]], atol=1e-6)


def test_one_frame_is_shown(sceneprint: Run, client: Client, tmp_path: Path) -> None:
    rrd = tmp_path / "a.rrd"
    frame = next(client.frames(MAP, session="yard"))
    sceneprint("frames", MAP, frame.frame_id, "--rrd", rrd)
    rows = rrd_rows(rrd)
    path = f"/yard/{frame.frame_id}"
    seen = client.frame_points(MAP, frame.frame_id).points
    told = values(rows, f"{path}/points", "Points3D:positions")
    np.testing.assert_allclose(told, seen, atol=1e-6)
    assert frame.pose is not None
    at = values(rows, path, "Transform3D:translation")
    np.testing.assert_allclose(at, [np.array(frame.pose.matrix)[:3, 3]], atol=1e-6)


@pytest.fixture
def halves(client: Client, walk: tuple[FrameReference, ...]) -> Any:
    """The walk as two sessions, every other frame of each, in frames of their own: that of the
    second is moved.
    """
    from sceneprint_client import meta_of

    client.create_map("halves")
    T = np.eye(4)
    T[:3, 3] = 10.0, 0.0, 0.0
    for i, one in enumerate(walk):
        pose = one.pose if i % 2 == 0 else T @ one.pose
        name = ("even", "odd")[i % 2]
        meta = meta_of(one, session=name, with_pose=False)
        given = {"matrix": pose.tolist(), "parent_frame": name}
        meta = type(meta).model_validate({**meta.model_dump(), "pose": given})
        client.upload("halves", one, meta)
    client.wait([one.job_id for one in client.frames("halves")], timeout_s=PATIENCE_S)
    yield T
    client.delete_map("halves")


def test_joined_sessions_are_shown_in_one_space(
    sceneprint: Run, client: Client, halves: Any, tmp_path: Path
) -> None:
    rrd, mcap = tmp_path / "a.rrd", tmp_path / "a.mcap"
    how = ("--json", "--rrd", rrd, "--mcap", mcap)
    said = sceneprint("associate", "halves", "--session", "even", "--session", "odd", *how)
    told = json.loads(said.stdout)
    assert told["result"]["joins"][0]["transform"] is not None
    rows, messages = rrd_rows(rrd), mcap_rows(mcap)
    graph = json.loads(client.graph("halves", told["association_id"], "json"))
    poses = {one["frame_id"]: np.array(one["pose"]["matrix"]) for one in graph["vertices"]}
    space = graph["frame"]
    for name in ("even", "odd"):
        frames = list(client.frames("halves", session=name))
        at = [poses[one.frame_id] for one in frames]
        track = values(rows, f"/{space}/sessions/{name}/track", "LineStrips3D:strips")[0]
        key = np.argsort(np.array(track)[:, 0])
        expected = np.array([T[:3, 3] for T in at])
        np.testing.assert_allclose(
            np.array(track)[key], expected[np.argsort(expected[:, 0])], atol=1e-5
        )
        clouds = [client.frame_points("halves", one.frame_id).points for one in frames]
        expected = np.concatenate([moved(T, c) for T, c in zip(at, clouds, strict=True)])
        for one in (rows, messages):
            points = values(one, f"/{space}/sessions/{name}/points", "Points3D:positions")
            for f in (np.min, np.max, np.mean):
                np.testing.assert_allclose(f(points, axis=0), f(expected, axis=0), atol=1e-3)
    strips = [
        strip
        for row in rows
        if row.path.startswith(f"/{space}/edges/")
        for strip in row.values.get("LineStrips3D:strips", [])
    ]
    assert len(strips) == told["result"]["edges"]


@pytest.mark.parametrize(
    ("option", "package", "extra"),
    [("--rrd", "rerun", "rerun"), ("--mcap", "foxglove", "foxglove")],
)
@pytest.mark.parametrize("command", ["query", "localize", "frames", "associate"])
def test_a_missing_extra_is_told_before_any_work(
    command: str, option: str, package: str, extra: str, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.setitem(sys.modules, package, None)
    what = {"frames": (), "associate": ("--session", "a")}.get(command, ("nowhere.png",))
    url = ("--url", "http://127.0.0.1:9")  # nobody there, and nobody asks
    assert main([command, "map", *what, *url, option, str(tmp_path / "x")]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    assert f"Run: pip install 'sceneprint[{extra}]'" in said.err
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_is_refused_first(
    sceneprint: Run, unseen: tuple[FrameReference, ...], tmp_path: Path
) -> None:
    query = ("query", MAP, unseen[0].path)
    file = tmp_path / "a"
    for arguments, why in (
        ((*query, "--rrd", file, "--no-keep"), "Leave --no-keep out"),
        ((*query, "--rrd", file, "--mcap", file), "--rrd and --mcap both name"),
        ((*query, "--rrd", tmp_path / "no" / "a"), "No such file"),
        ((*query, "--rerun-url", "here"), "here"),
        ((*query, "--mcap", file, "--map-frames", "-1"), None),
        (("frames", MAP, "--session", "room", "--trajectory", file, "--mcap", file), "no scene"),
        (("frames", MAP, "--tag", "none", "--mcap", file), "No listed frame has a pose"),
        (("query", "nowhere", unseen[0].path, "--mcap", file), "nowhere"),
    ):
        if why is None:
            with pytest.raises(SystemExit):
                sceneprint(*arguments)
        else:
            assert why in sceneprint(*arguments, expect=2).stderr
    assert list(tmp_path.iterdir()) == []


def test_frames_that_cannot_be_read_leave_no_scene(sceneprint: Run, tmp_path: Path) -> None:
    (tmp_path / "intrinsics.json").write_text(
        '{"width": 4, "height": 4, "fx": 4, "fy": 4, "cx": 2, "cy": 2}'
    )
    (tmp_path / "a.png").write_bytes(b"no image")
    said = sceneprint("query", MAP, tmp_path, "--rrd", tmp_path / "a.rrd", expect=2)
    assert "wrote" not in said.stderr
    assert sorted(one.name for one in tmp_path.iterdir()) == ["a.png", "intrinsics.json"]


def frames_at(*stamps: float | None) -> list[FrameReference]:
    camera = Camera(Intrinsics(width=4, height=4, fx=4, fy=4, cx=2, cy=2))
    return [
        FrameReference(f"{i}", Path(f"{i}.png"), camera, timestamp=t) for i, t in enumerate(stamps)
    ]


def test_moments_have_the_stamps_of_frames_if_all_have() -> None:
    assert stamps_of(frames_at(1.5, 2.0)) == [1_500_000_000, 2_000_000_000]
    assert stamps_of(frames_at(1.5, None)) == [None, None]
    assert stamps_of(frames_at(2.0, 1.5)) == [None, None]
    assert stamps_of(frames_at(1.5, 1.5)) == [None, None]
    assert stamps_of(frames_at(-1.0, 1.5)) == [None, None]
    assert stamps_of([]) == []
