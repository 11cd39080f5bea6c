"""Tests of the scenes that commands write against their output."""

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.cli.scenes import stamps_of
from sceneprint.formats.dataset import Camera, FrameReference
from sceneprint.types import Intrinsics

from .conftest import MAP, WALK, drawn_at, mcap_rows, moved, moves_of


def values(rows, path, component):
    """The only value of a component at a path."""
    [one] = [row.values[component] for row in rows if row.path == path and component in row.values]
    return one


def test_a_query_is_shown_where_it_was_found(sceneprint, client, unseen, tmp_path):
    mcap = tmp_path / "a.mcap"
    said = sceneprint("query", MAP, unseen[0].path, "--map-frames", 2, "--json", "--mcap", mcap)
    assert said.stderr == f"wrote {mcap}\n"
    answer = json.loads(said.stdout)
    rows = mcap_rows(mcap)
    matrix = np.array(answer["location"]["pose"]["matrix"])
    [move] = moves_of(rows, "query.optical")
    told = move.values["Transform3D:translation"]
    np.testing.assert_allclose(told, [matrix[:3, 3]], atol=1e-6)
    seen = client.query_points(answer["query_id"]).points
    told = values(rows, "/room/query/points", "Points3D:positions")
    np.testing.assert_allclose(told, seen, atol=1e-6)
    placed = [m for m in answer["matches"] if m["validation"]["status"] == "accepted"]
    assert {row.path for row in rows if "Points3D:positions" in row.values} == {
        "/room/map/points", "/yard/map/points", "/room/query/points",
        *(f"/room/matches/{n}/points" for n in range(1, len(placed) + 1)),
    }  # fmt: skip
    [label] = drawn_at(rows, "/room/matches")["/room/matches/1/label"]["texts"]
    assert label["text"].startswith(f"#{placed[0]['rank']} {Path(placed[0]['name']).name} ")
    [text] = values(rows, "/log", "TextLog:text")
    assert f"{unseen[0].name}: found" in text
    # the query's frame, seen from the walk, lies on the room: on the truth to 5 cm
    truth = unseen[0].pose
    assert np.linalg.norm(matrix[:3, 3] - truth[:3, 3]) < 0.05


def test_the_frames_of_a_map_are_shown(sceneprint, client, tmp_path):
    mcap = tmp_path / "a.mcap"
    listed = sceneprint("frames", MAP, "--session", "room", "--mcap", mcap).stdout
    assert len(listed.splitlines()) == 1 + WALK
    frames = list(client.frames(MAP, session="room"))
    clouds = [client.frame_points(MAP, one.frame_id, "parent").points for one in frames]
    rows = mcap_rows(mcap)
    points = np.array(values(rows, "/room/map/points", "Points3D:positions"))
    assert len(points) == sum(map(len, clouds))
    np.testing.assert_allclose(points[: len(clouds[0])], clouds[0], atol=3e-4)
    for one in frames:
        [move] = moves_of(rows, one.pose.child_frame)
        at = one.pose.translation
        told = move.values["Transform3D:translation"]
        np.testing.assert_allclose(told, [[at.x, at.y, at.z]], atol=1e-6)


@pytest.fixture
def halves(client, walk):
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


def test_joined_sessions_are_shown_in_one_space(sceneprint, client, halves, tmp_path):
    mcap = tmp_path / "a.mcap"
    how = ("--json", "--mcap", mcap)
    said = sceneprint(
        "make", "association", "halves", "--session", "even", "--session", "odd", *how
    )
    told = json.loads(said.stdout)
    assert told["result"]["joins"][0]["transform"] is not None
    rows = mcap_rows(mcap)
    graph = json.loads(client.graph("halves", told["job_id"], "json"))
    poses = {one["frame_id"]: np.array(one["pose"]["matrix"]) for one in graph["vertices"]}
    space = graph["frame"]
    for name in ("even", "odd"):
        frames = list(client.frames("halves", session=name))
        at = [poses[one.frame_id] for one in frames]
        drawn = drawn_at(rows, f"/{space}/sessions")[f"/{space}/sessions/{name}/track"]
        track = np.array([[p["x"], p["y"], p["z"]] for p in drawn["lines"][0]["points"]])
        expected = np.array([T[:3, 3] for T in at])
        np.testing.assert_allclose(
            track[np.argsort(track[:, 0])], expected[np.argsort(expected[:, 0])], atol=1e-5
        )
        clouds = [client.frame_points("halves", one.frame_id).points for one in frames]
        expected = np.concatenate([moved(T, c) for T, c in zip(at, clouds, strict=True)])
        points = values(rows, f"/{space}/sessions/{name}/points", "Points3D:positions")
        for f in (np.min, np.max, np.mean):
            np.testing.assert_allclose(f(points, axis=0), f(expected, axis=0), atol=1e-3)
    edges = drawn_at(rows, f"/{space}/edges").values()
    assert sum(len(one["lines"]) for one in edges) == told["result"]["edges"]


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


def test_frames_that_cannot_be_read_leave_no_scene(sceneprint, tmp_path):
    (tmp_path / "intrinsics.json").write_text(
        '{"width": 4, "height": 4, "fx": 4, "fy": 4, "cx": 2, "cy": 2}'
    )
    (tmp_path / "a.png").write_bytes(b"no image")
    said = sceneprint("query", MAP, tmp_path, "--mcap", tmp_path / "a.mcap", expect=2)
    assert "wrote" not in said.stderr
    assert sorted(one.name for one in tmp_path.iterdir()) == ["a.png", "intrinsics.json"]


def frames_at(*stamps):
    camera = Camera(Intrinsics(width=4, height=4, fx=4, fy=4, cx=2, cy=2))
    return [
        FrameReference(f"{i}", Path(f"{i}.png"), camera, timestamp=t) for i, t in enumerate(stamps)
    ]


def test_moments_have_the_stamps_of_frames_if_all_have():
    assert stamps_of(frames_at(1.5, 2.0)) == [1_500_000_000, 2_000_000_000]
    assert stamps_of(frames_at(1.5, None)) == [None, None]
    assert stamps_of(frames_at(2.0, 1.5)) == [None, None]
    assert stamps_of(frames_at(1.5, 1.5)) == [None, None]
    assert stamps_of(frames_at(-1.0, 1.5)) == [None, None]
    assert stamps_of([]) == []
