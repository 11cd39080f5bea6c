"""Tests of the scenes that commands write against their output."""

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.cli.scenes import stamps_of
from sceneprint.formats.dataset import Camera, FrameReference
from sceneprint.types import Intrinsics
from sceneprint_client import meta_of
from sceneprint_client.api import FrameMeta

from .conftest import MAP, WALK, drawn_at, mcap_rows, moved, moves_of


def values(rows, path, component):
    """The only value of a component at a path."""
    [one] = [row.values[component] for row in rows if row.path == path and component in row.values]
    return one


def test_a_query_is_shown_with_its_matches_and_the_map(sceneprint, client, unseen, tmp_path):
    mcap = tmp_path / "a.mcap"
    said = sceneprint("query", MAP, unseen[0].path, "--map-frames", 2, "--json", "--mcap", mcap)
    assert said.stderr == f"wrote {mcap}\n"
    answer, rows = json.loads(said.stdout), mcap_rows(mcap)
    [move] = moves_of(rows, "query.optical")
    matrix = np.array(answer["location"]["pose"]["matrix"])
    position = move.values["Transform3D:translation"]
    np.testing.assert_allclose(position, [matrix[:3, 3]], atol=1e-6)
    placed = [m for m in answer["matches"] if m["validation"]["status"] == "accepted"]
    assert {row.path for row in rows if "Points3D:positions" in row.values} == {
        "/room/map/points", "/yard/map/points", "/room/query/points",
        *(f"/room/matches/{n}/points" for n in range(1, len(placed) + 1)),
    }  # fmt: skip
    [text] = values(rows, "/log", "TextLog:text")
    assert f"{unseen[0].name}: found" in text


def test_the_frames_of_a_map_are_shown(sceneprint, client, tmp_path):
    mcap = tmp_path / "a.mcap"
    listed = sceneprint("frames", MAP, "--session", "room", "--mcap", mcap).stdout
    assert len(listed.splitlines()) == 1 + WALK
    frames = list(client.frames(MAP, session="room"))
    clouds = [client.frame_points(MAP, frame.frame_id, "parent").points for frame in frames]
    rows = mcap_rows(mcap)
    points = np.array(values(rows, "/room/map/points", "Points3D:positions"))
    assert len(points) == sum(map(len, clouds))
    np.testing.assert_allclose(points[: len(clouds[0])], clouds[0], atol=3e-4)
    for frame in frames:
        [move] = moves_of(rows, frame.pose.child_frame)
        at = frame.pose.translation
        position = move.values["Transform3D:translation"]
        np.testing.assert_allclose(position, [[at.x, at.y, at.z]], atol=1e-6)


@pytest.fixture
def halves(client, walk):
    """The walk as two sessions in parent frames of their own, one of which is moved by 10 m."""
    client.create_map("halves")
    for i, view in enumerate(walk):
        name = ("even", "odd")[i % 2]
        pose = view.pose.copy()
        pose[0, 3] += 10.0 * (i % 2)
        meta = meta_of(view, session=name, with_pose=False).model_dump()
        meta |= {"pose": {"matrix": pose.tolist(), "parent_frame": name}}
        client.upload("halves", view, FrameMeta.model_validate(meta))
    client.wait([frame.job_id for frame in client.frames("halves")], timeout_s=PATIENCE_S)
    yield
    client.delete_map("halves")


@pytest.mark.usefixtures("halves")
def test_joined_sessions_are_shown_in_one_space(sceneprint, client, tmp_path):
    mcap = tmp_path / "a.mcap"
    sessions = ("--session", "even", "--session", "odd")
    said = sceneprint("make", "association", "halves", *sessions, "--json", "--mcap", mcap)
    job, rows = json.loads(said.stdout), mcap_rows(mcap)
    assert job["result"]["joins"][0]["transform"] is not None
    graph = json.loads(client.graph("halves", job["job_id"], "json"))
    poses = {vertex["frame_id"]: np.array(vertex["pose"]["matrix"]) for vertex in graph["vertices"]}
    space = graph["frame"]
    for name in ("even", "odd"):
        ids = [frame.frame_id for frame in client.frames("halves", session=name)]
        drawn = drawn_at(rows, f"/{space}/sessions")[f"/{space}/sessions/{name}/track"]
        track = sorted([p["x"], p["y"], p["z"]] for p in drawn["lines"][0]["points"])
        expected = sorted(poses[frame_id][:3, 3].tolist() for frame_id in ids)
        np.testing.assert_allclose(track, expected, atol=1e-5)
        clouds = [moved(poses[f], client.frame_points("halves", f).points) for f in ids]
        points = values(rows, f"/{space}/sessions/{name}/points", "Points3D:positions")
        expected = np.concatenate(clouds).mean(axis=0)
        np.testing.assert_allclose(np.mean(points, axis=0), expected, atol=1e-3)
    edges = drawn_at(rows, f"/{space}/edges").values()
    assert sum(len(edge["lines"]) for edge in edges) == job["result"]["edges"]


def test_what_cannot_be_is_refused_first(sceneprint, unseen, tmp_path):
    query = ("query", MAP, unseen[0].path)
    file = tmp_path / "a"
    for arguments, why in (
        ((*query, "--mcap", file, "--no-keep"), "Omit --no-keep"),
        ((*query, "--mcap", tmp_path / "no" / "a"), "No such file"),
        ((*query, "--mcap", file, "--map-frames", "-1"), None),
        (
            ("frames", MAP, "--session", "room", "--trajectory", file, "--mcap", file),
            "does not write a scene",
        ),
        (("frames", MAP, "--tag", "none", "--mcap", file), "No listed frame has a pose"),
        (("query", "nowhere", unseen[0].path, "--mcap", file), "nowhere"),
    ):
        if why is None:
            with pytest.raises(SystemExit):
                sceneprint(*arguments)
        else:
            assert why in sceneprint(*arguments, expect=2).stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("stamps", "expected"),
    [
        ([1.5, 2.0], [1_500_000_000, 2_000_000_000]), ([1.5, None], [None] * 2), ([], []),
        ([2.0, 1.5], [None] * 2), ([1.5, 1.5], [None] * 2), ([-1.0, 1.5], [None] * 2),
    ],
)  # fmt: skip
def test_moments_have_the_stamps_of_frames_if_all_have(stamps, expected):
    camera = Camera(Intrinsics(width=4, height=4, fx=4, fy=4, cx=2, cy=2))
    frames = [FrameReference("a", Path("a.png"), camera, timestamp=stamp) for stamp in stamps]
    assert stamps_of(frames) == expected
