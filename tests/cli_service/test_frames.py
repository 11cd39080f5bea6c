"""Tests of `sceneprint frames` with a service."""

import json

import pytest
from PIL import Image

from sceneprint.formats.dataset import read_trajectory


@pytest.fixture(scope="module")
def name():
    return "frames-command"


def test_lists_files_and_edits(sceneprint, rooms, name, tmp_path):
    sceneprint("upload", name, rooms / "room-0", "--model", "depth", "--robot", "r1")
    frames = [json.loads(line) for line in sceneprint("frames", name, "--json").stdout.splitlines()]
    ids = [frame["frame_id"] for frame in frames]
    table = sceneprint("frames", name, "--newest", "--limit", "2").stdout.splitlines()
    assert [line.split()[0] for line in table] == ["frame", ids[2], ids[1]]
    # four at a time they come in any order, and are told in that of their files
    (session,) = {frame["session"] for frame in frames}
    table = sceneprint("frames", name, "--session", session).stdout.splitlines()
    assert [line.split()[-1] for line in table[1:]] == [
        f"frame-00000{i}.depth.png" for i in range(3)
    ]
    places = tmp_path / "places.tum"
    said = sceneprint("frames", name, "--session", session, "--trajectory", places)
    assert said.stdout == f"wrote {places}: 3 poses\n"
    assert read_trajectory(places).stamps.tolist() == [0.0, 1.0, 2.0]
    assert sceneprint("frames", name, "--tag", "nowhere").stdout == "no frames match\n"
    png, ply, lists = tmp_path / "a.png", tmp_path / "a.ply", tmp_path / "a.json"
    said = sceneprint(
        "frames", name, ids[0], "--preview", png, "--view", "normals", "--width", "100",
        "--cloud", ply, "--within", "parent", "--patches", lists, "--upload", tmp_path / "u",
        "--signature", tmp_path / "s",
    )  # fmt: skip
    written = (ply, png, lists, tmp_path / "s", tmp_path / "u")
    assert said.stdout.splitlines() == [f"wrote {one}" for one in written]
    with Image.open(png) as image:
        assert image.size[0] == 100
    assert b"comment frame r1/room-0\n" in ply.read_bytes()
    assert (tmp_path / "u").read_bytes()[:4] == b"\x89PNG"
    change = {"captured_at": "2026-11-16T09:30:01Z", "tags": ["door"], "session": "s"}
    edited = sceneprint("frames", name, ids[1], "--edit", json.dumps(change), "--json").stdout
    assert json.loads(edited)["tags"] == ["door"]
    tagged = ("--tag", "door", "--after", "2026-11-16T09:30:01Z", "--json")
    assert json.loads(sceneprint("frames", name, *tagged).stdout)["frame_id"] == ids[1]
    sessions = sceneprint("sessions", name).stdout.splitlines()
    assert sessions[1].endswith("  r1/room-0/seq-01")
    assert sessions[2].endswith("  r1/s  [door]")


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("--cloud", "a.ply"), "--cloud applies to one frame"),
        (("--trajectory", "a.tum"), "--trajectory requires a session"),
        (("--session", "s", "--robot", "a", "--robot", "b", "--trajectory", "a"), "only one robot"),
        (("nobody", "--cloud", "a.ply"), "There is no"),
    ],
)
def test_what_cannot_be_is_one_line(sceneprint, name, arguments, text):
    said = sceneprint("frames", name, *arguments, expect=2)
    assert text in said.stderr
    assert said.stderr.count("\n") == 1


def test_a_session_is_renamed_tagged_and_deleted(sceneprint, rooms, name):
    name = f"{name}-sessions"
    sceneprint("upload", name, rooms / "room-0", "--model", "depth", "--robot", "r1")
    (own,) = [json.loads(x) for x in sceneprint("sessions", name, "--json").stdout.splitlines()]
    old, new = own["session"], "Monday / first floor"
    said = sceneprint("sessions", name, old, "--rename", new, "--tag", "door").stdout
    assert said == f"edited 3 frames of session {old}\n"
    listed = sceneprint("sessions", name, new, "--robot", "r1").stdout.splitlines()
    assert listed[1].endswith(f"  r1/{new}  [door]")
    refused = sceneprint("sessions", name, new, "--delete", expect=2).stderr
    assert refused == (
        f"sceneprint sessions: This would delete session {new} and its 3 frames. Add "
        "--yes to confirm.\n"
    )
    said = sceneprint("sessions", name, new, "--delete", "--yes").stdout
    head, undo = said.splitlines()
    assert head == f"deleted session {new} and its 3 frames"
    deletion = undo.rpartition(" ")[2]
    assert undo.endswith(f"UTC: sceneprint sessions {name} --undo {deletion}")
    (listed,) = sceneprint("sessions", name, "--deletions").stdout.splitlines()[1:]
    assert listed.split()[:2] == [deletion, "3"]
    assert sceneprint("sessions", name, "--undo", deletion).stdout == "restored 3 frames\n"
    assert sceneprint("sessions", name, "--deletions").stdout.startswith("no deletions")
    assert "3" in sceneprint("sessions", name, new).stdout.split()
    again = sceneprint("sessions", name, "--undo", deletion, expect=2).stderr
    assert "has no deletion" in again
