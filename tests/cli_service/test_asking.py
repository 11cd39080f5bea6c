"""Tests of the options of `query`, `localize` and `similarity`."""

import json
import math
import re
import shutil

import numpy as np
import pytest

from benchmarks.rooms import circled
from benchmarks.waiting import PATIENCE_S
from sceneprint.formats.dataset import find_sequences
from sceneprint_client import Client
from sceneprint_client.api import FrameMeta


@pytest.fixture(scope="module")
def maps(service_url, whole_rooms):
    """`near` has two views of the first room, `far` one of each."""
    results = {}
    frames = [frame for sequence in find_sequences(whole_rooms) for frame in sequence.frames]
    with Client(service_url) as client:
        for name, which in (("near", (0, 1)), ("far", (0, 3))):
            client.create_map(name, model="depth")
            added = [client.upload(name, frames[i], wait_s=PATIENCE_S) for i in which]
            results[name] = [frame.frame_id for frame in added]
    return results


def test_a_query_says_where_frames_were_lost(sceneprint, maps, whole_rooms):
    frame = whole_rooms / "room-0" / "seq-01" / "frame-000000.depth.png"
    command = ("query", "near", frame, "--candidates", 1, "--validation", "weak=0", "--no-keep")
    explained = ("--explain", "--explain-frame", maps["near"][1])
    body = json.loads(sceneprint(*command, *explained, "--json").stdout)
    assert (body["counts"]["selected"], body["matches"][0]["validation"]["strength"]) == (1, "weak")
    lines = sceneprint(*command, *explained).stdout.splitlines()
    first, second = (f"{maps['near'][i]} (frame-00000{i}.depth.png)" for i in range(2))
    assert lines[-3].startswith(f"     1  {first}  1.00  validate: accepted; accepted:")
    assert "retrieve: not selected; most similar to the selected frame" in lines[-2]
    assert lines[-1].startswith(f"  {second}: rank 2 of 2; dropped at selection: ")
    several = ("--map", "far", "--diversity", "omega=1000", "--json")
    both = json.loads(sceneprint(*command, *several).stdout)
    assert (both["maps"], both["counts"]["map"]) == (["near", "far"], 4)
    for options, text in (
        (["--diversity", "tau=2"], "diversity.tau"),
        (["--validation", "mode=fast"], "validation.mode"),
        (["--map", "nowhere"], "'nowhere'"),
    ):
        assert text in sceneprint(*command, *options, expect=2).stderr


def test_a_frame_is_localized(sceneprint, maps, whole_rooms):
    frame = whole_rooms / "room-0" / "seq-01" / "frame-000001.depth.png"
    lines = sceneprint("localize", "near", frame).stdout.splitlines()
    assert re.search(r": found 99\.\d % \(strong\); ", lines[0])
    assert lines[1].startswith("  at ")
    assert " m in room-0/seq-01, rotation " in lines[1]
    alone = ("localize", "near", whole_rooms / "room-0", "--last", 1)
    there = [
        json.loads(line) for line in sceneprint(*alone, "--json", expect=1).stdout.splitlines()
    ]
    assert [answer["status"] for answer in there] == ["found", "found", "not_found"]
    assert [answer["matches"][0] for answer in there[:2]] == maps["near"]
    lost = sceneprint(*alone, "--frame", 2, expect=1).stdout
    assert ": not found; none of 2 candidates is accepted" in lost
    assert lost.splitlines()[1] == "  cause: nothing_alike"
    prior = {"pose": {"parent_frame": "room-0/seq-01", "matrix": np.eye(4).tolist()}}
    command = ("localize", "near", whole_rooms / "room-0", "--prior", json.dumps(prior))
    refused = sceneprint(*command, expect=2).stderr
    assert "has 3 frames, but --prior applies to one. Select it with --frame.\n" in refused


@pytest.fixture(scope="module")
def sides(service_url, tmp_path_factory):
    """A file of a view of a cube, and its map `sides`: the same from each of the four sides."""
    folder = tmp_path_factory.mktemp("sides")
    with Client(service_url) as client:
        client.create_map("sides", model="depth")
        for one in circled((30, 120, 210, 300)):
            client.upload("sides", one.data, FrameMeta.model_validate(one.meta), wait_s=PATIENCE_S)
    (view,) = circled([40])
    (folder / "view.npy").write_bytes(view.data)
    (folder / "intrinsics.json").write_text(json.dumps(view.meta["intrinsics"]))
    return folder / "view.npy", view.meta["pose"]["matrix"]


def test_an_ambiguous_place_is_told_with_its_alternatives(sceneprint, sides):
    file, truth = sides
    answer = json.loads(sceneprint("localize", "sides", file, "--json", expect=1).stdout)
    assert (answer["status"], answer["pose"], len(answer["alternatives"])) == ("ambiguous", None, 4)
    located = sceneprint("localize", "sides", file, expect=1).stdout.splitlines()
    assert f"/view: ambiguous {floored(answer['confidence'])} %; {answer['reason']} (" in located[0]
    assert located[1:] == sceneprint("query", "sides", file).stdout.splitlines()[-5:]
    assert located[1] == "  4 poses are supported; at most one is right:"
    places = []
    for line, alternative in zip(located[2:], answer["alternatives"], strict=True):
        sure, _, x, y = line.split()[:4]
        assert float(sure) == floored(alternative["confidence"])
        assert f" m in hall, support 1; {round(alternative['evidence']['planes'])} plane" in line
        places.append(complex(float(x), float(y)))
    # the true place turned about the cube by 0, 90, 180 and 270 degrees
    true = complex(truth[0][3], truth[1][3])
    turned = sorted((true * 1j**i for i in range(4)), key=lambda z: (z.real, z.imag))
    result = sorted(places, key=lambda z: (z.real, z.imag))
    assert np.abs(np.subtract(turned, result)).max() < 0.1


def floored(confidence):
    return math.floor(1000 * min(confidence, 0.999)) / 10


def test_frames_of_a_folder_are_asked_with_those_before_them(
    sceneprint, maps, whole_rooms, tmp_path
):
    command = ("localize", "near", whole_rooms / "room-0")
    first, both, last = map(json.loads, sceneprint(*command, "--json").stdout.splitlines())
    alone = json.loads(sceneprint(*command, "--frame", 1, "--json", "--last", 1).stdout)
    # from frame 0 to frame 2 the way turns by more than 120 degrees
    assert [answer["frames"] for answer in (first, both, last, alone)] == [1, 2, 2, 1]
    assert both["votes"] > alone["votes"]  # the frame before votes too
    here, there = (np.array(answer["pose"]["matrix"]) for answer in (alone, both))
    assert np.linalg.norm(here[:3, 3] - there[:3, 3]) < 0.05
    up = json.loads(sceneprint(*command, "--frame", 1, "--up", "0,-1,0", "--json").stdout)
    assert up["frames"] == 1
    # without poses beside them each frame is alone
    no_poses = shutil.ignore_patterns("*.pose.txt")
    shutil.copytree(whole_rooms / "room-0", tmp_path / "room-0", ignore=no_poses)
    one = ("localize", "near", tmp_path / "room-0", "--frame", 1)
    assert json.loads(sceneprint(*one, "--json").stdout)["frames"] == 1
    for wrong, text in (
        ((*command, "--last", 11), "--last 11: use a number from 1 to 10"),
        ((*command, "--last", 2, "--up", "0,-1,0"), "--up applies to one frame"),
        ((*one, "--last", 2), "has no pose, but --last 2 requires odometry"),
    ):
        assert text in sceneprint(*wrong, expect=2).stderr


def test_a_prior_is_a_file_or_json(sceneprint, sides, tmp_path, capsys):
    file, truth = sides
    prior = {"pose": {"parent_frame": "hall", "matrix": truth}, "deviation_m": 0.2}
    (tmp_path / "prior.json").write_text(json.dumps(prior))
    command = ("localize", "sides", file, "--json", "--prior")
    there = json.loads(sceneprint(*command, json.dumps(prior)).stdout)
    assert (there["status"], there["verified_by"]) == ("found", "prior")
    off = np.array(there["pose"]["matrix"])[:3, 3] - np.array(truth)[:3, 3]
    assert np.linalg.norm(off) < 0.1
    by_file = json.loads(sceneprint(*command, tmp_path / "prior.json").stdout)
    assert by_file["pose"] == there["pose"]
    lines = sceneprint("query", "sides", file, "--prior", json.dumps(prior)).stdout.splitlines()
    assert "; several poses fit, and the prior decided; " in lines[-1]
    (tmp_path / "torn.json").write_text('{"pose": ')
    pose = {"translation": {"x": 0, "y": 0, "z": 0}, "rotation": {"x": 0, "y": 0, "z": 0, "w": 1}}
    for wrong, text in (
        (tmp_path / "none.json", "cannot be read (No such file or directory). Pass the path"),
        (tmp_path / "torn.json", "the prior is not JSON ("),
        (json.dumps({"pose": pose}), "parent_frame"),
        (json.dumps({**prior, "deviation": 1}), "deviation: Extra inputs are not permitted"),
    ):
        with pytest.raises(SystemExit) as ended:
            sceneprint("localize", "sides", file, "--prior", wrong)
        assert ended.value.code == 2
        assert text in capsys.readouterr().err


def test_queries_that_came_are_listed(sceneprint, service_url, whole_rooms):
    frames = [whole_rooms / f"room-{i}" / "seq-01" / "frame-000000.depth.png" for i in (0, 1)]
    sceneprint("upload", "asked", frames[0])
    assert sceneprint("queries", "asked").stdout == "no queries match\n"
    with Client(service_url) as client:
        answer = client.localize("asked", frames[0], robot="spot\u2028")
        lost = client.localize("asked", frames[1], robot="cart")
    head, second, first = sceneprint("queries", "asked").stdout.splitlines()
    assert " ".join(head.split()) == "query time status ms map robot/session pose or reason"
    t = answer.pose.translation
    place = f"{t.x:.2f} {t.y:.2f} {t.z:.2f} m in room-0, 1 view, {floored(answer.confidence)} %"
    assert re.fullmatch(
        rf"{answer.query_id}  \S+ \S+  found +\d+  asked  spot\S*/seq-01  {place}", first
    ), first
    assert second.startswith(lost.query_id)
    assert second.endswith(f"  cart/seq-01  {lost.reason}")
    chosen = ("--status", "found", "--status", "failed", "--json")
    record = json.loads(sceneprint("queries", "asked", *chosen).stdout)
    assert (record["query_id"], record["robot"]) == (answer.query_id, "spot\u2028")
    assert sceneprint("queries", "asked", "--until", record["at"], "--json").stdout == ""


def test_a_query_is_laid_on_its_match(sceneprint, service_url, whole_rooms, tmp_path):
    path = tmp_path / "overlay.ply"
    sceneprint("upload", "overlaid", whole_rooms / "room-0", "--create")
    one = ("query", "overlaid", whole_rooms / "room-0", "--frame", "1", "--json")
    said = sceneprint(*one, "--overlay", path, "--color", "normal")
    answer = json.loads(said.stdout)
    best = answer["matches"][0]["frame_id"]
    assert said.stderr == f"{path}: the query aligned with {best} (frame-000001.depth.png)\n"
    with Client(service_url) as client:
        assert path.read_bytes() == client.overlay(answer["query_id"], best, color="normal")
        client.delete_map("overlaid")
    for arguments, why in (
        (("--overlay", tmp_path / "no" / "x.ply", "--frame", "1"), "No such file"),
        (("--overlay", path), "has 3 frames, but --overlay writes a single file"),
    ):
        refused = sceneprint("query", "overlaid", whole_rooms / "room-0", *arguments, expect=2)
        assert why in refused.stderr
