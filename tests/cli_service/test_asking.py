"""`query`, `localize` and `similarity` with their options, as a user gives them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from sceneprint.cli.query import frame_argument
from sceneprint_client import Client

Run = Callable[..., Any]


@pytest.fixture(scope="module")
def maps(service_url: str, rooms: Path) -> dict[str, list[str]]:
    """`near` has two views of the first room, `far` one of each."""
    from sceneprint.formats.dataset import find_sequences

    found: dict[str, list[str]] = {}
    frames = [one for sequence in find_sequences(rooms) for one in sequence.frames]
    with Client(service_url) as client:
        for name, which in (("near", (0, 1)), ("far", (0, 3))):
            client.create_map(name, model="depth")
            added = [client.upload(name, frames[i], wait_s=60) for i in which]
            found[name] = [one.frame_id for one in added]
    return found


def test_up_goes_with_uploads_and_queries(sceneprint: Run, service_url: str, rooms: Path) -> None:
    frame, other = (rooms / "room-0" / "seq-01" / f"frame-00000{i}.depth.png" for i in (0, 1))
    sceneprint("upload", "level", frame, "--up", "0.6,-0.8,0")
    with Client(service_url) as client:
        [one] = client.frames("level")
        assert one.up is not None
        assert (one.up.x, one.up.y, one.up.z) == pytest.approx((0.6, -0.8, 0.0))
    said = sceneprint("query", "level", other, "--up=0,0,1", "--json").stdout
    [match] = json.loads(said)["matches"]
    assert match["validation"]["status"] == "rejected"
    lost = sceneprint("localize", "level", other, "--up=0,0,1", expect=1).stdout
    assert "not found; " in lost
    line = sceneprint("maps", "--edit", "level", "--up=0,0,1").stdout
    assert line.endswith(", up 0,0,1\n")
    assert "up 0" not in sceneprint("maps", "--edit", "level", "--up", "none").stdout
    assert "length is 2" in sceneprint("query", "level", other, "--up", "0,2,0", expect=2).stderr
    with pytest.raises(SystemExit):
        sceneprint("query", "level", other, "--up", "0,1")


def test_a_query_says_where_frames_were_lost(
    sceneprint: Run, maps: dict[str, list[str]], rooms: Path
) -> None:
    frame = rooms / "room-0" / "seq-01" / "frame-000000.depth.png"
    asked = ("query", "near", frame, "--candidates", 1, "--validation", "weak=0", "--no-keep")
    said = sceneprint(*asked, "--explain", "--explain-frame", maps["near"][1], "--json").stdout
    told = json.loads(said)
    assert (told["counts"]["selected"], told["matches"][0]["validation"]["strength"]) == (1, "weak")
    outcomes = [one["outcome"] for one in told["explanations"]]
    assert outcomes == ["accepted", "not_selected"]
    lines = sceneprint(*asked, "--explain", "--explain-frame", maps["near"][1]).stdout.splitlines()
    assert lines[-3].startswith(f"     1  {maps['near'][0]}  1.00  validate: accepted; accepted:")
    assert "retrieve: not selected; most similar to the selected frame" in lines[-2]
    assert lines[-1].startswith(f"  {maps['near'][1]}: rank 2 of 2; lost at selection: ")
    both = json.loads(sceneprint(*asked, "--map", "far", "--json").stdout)
    assert (both["maps"], both["counts"]["map"]) == (["near", "far"], 4)
    line = sceneprint(*asked, "--map", "far", "--diversity", "omega=1000").stdout.splitlines()[2]
    assert line.split()[0] in ("near", "far")
    for options, text in (
        (["--diversity", "tau=2"], "diversity.tau"),
        (["--validation", "mode=fast"], "validation.mode"),
        (["--map", "nowhere"], "'nowhere'"),
    ):
        assert text in sceneprint(*asked, *options, expect=2).stderr
    with pytest.raises(SystemExit):
        sceneprint(*asked, "--validation", "strong")


def test_a_frame_is_localized(sceneprint: Run, maps: dict[str, list[str]], rooms: Path) -> None:
    frame = rooms / "room-0" / "seq-01" / "frame-000001.depth.png"
    lines = sceneprint("localize", "near", frame).stdout.splitlines()
    assert ": found (strong); " in lines[0]
    assert lines[1].startswith("  at ")
    assert " m in room-0/seq-01, rotation " in lines[1]
    there = json.loads(sceneprint("localize", "near", rooms / "room-0", "--json").stdout)
    assert (there["status"], there["matches"][0]) == ("found", maps["near"][0])
    lost = sceneprint("localize", "near", rooms / "room-1", "--frame", 0, expect=1).stdout
    assert ": not found; none of 2 candidates was accepted" in lost


def test_two_frames_are_compared(sceneprint: Run, maps: dict[str, list[str]], rooms: Path) -> None:
    image = rooms / "room-0" / "seq-01" / "frame-000000.depth.png"
    own, far = f"near:{maps['near'][0]}", f"far:{maps['far'][1]}"
    same = sceneprint("similarity", own, image).stdout
    assert same.startswith("similarity 1.000 (distance 0, depth-")
    assert "; accepted strong: " in same
    assert same.rstrip().endswith("; b lies at 0.000 0.000 0.000 m from a")
    told = json.loads(sceneprint("similarity", own, far, "--json", expect=1).stdout)
    assert told["validation"]["status"] in ("rejected", "ambiguous")
    assert told["b"] == {"map": "far", "frame_id": maps["far"][1]}
    bare = sceneprint("similarity", own, far, "--no-validate").stdout
    assert bare.startswith(f"similarity {told['similarity']:.3f} (distance {told['distance']}, ")
    assert "'nobody'" in sceneprint("similarity", own, "near:nobody", expect=2).stderr


def test_a_side_is_a_file_or_a_stored_frame(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    assert frame_argument("hall:a.b-1") == ("hall", "a.b-1")
    assert frame_argument("depth/a.png") == Path("depth/a.png")
    Path("hall:a").touch()
    assert frame_argument("hall:a") == Path("hall:a")
