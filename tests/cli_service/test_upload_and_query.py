"""Tests of upload, query and map commands as processes with a real service."""

import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from contextlib import redirect_stderr, redirect_stdout

import numpy as np
import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.cli import main
from sceneprint.formats.dataset import read_pose, write_depth_png
from sceneprint_client import Client
from sceneprint_client.api import Answer, FrameState, Map


@pytest.fixture(scope="session")
def house(service_url, rooms):
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        code = main(["upload", "house", str(rooms), "--robot", "r1", "--url", service_url])
    assert (code, err.getvalue()) == (0, "")  # no bars where nobody looks
    first, second, third, fourth = out.getvalue().splitlines()
    assert third.startswith("poses of 6 of 6 frames; depth ")
    join = "`sceneprint make association house --session room-0/seq-01 --session room-1/seq-01`"
    assert join in fourth
    assert re.fullmatch(r"created map house with model depth-[0-9a-f]{12}", first)
    assert second.startswith(
        "6 frames: 6 received, 0 already there; 6 indexed, 0 rejected, 0 failed; "
    )
    assert re.search(r"; \d+\.\d frames/s$", second)
    return "house"


def test_uploading_again_changes_nothing(sceneprint, house, rooms):
    done = sceneprint("upload", house, rooms / "room-0", "--robot", "r1")  # by another path
    assert done.stdout.startswith("3 frames: 0 received, 3 already there; 3 indexed, ")
    done = sceneprint("upload", house, rooms / "room-0", "--every", 2, expect=2)
    assert done.stdout.startswith("2 frames: 0 received, 0 already there, 2 refused; 0 indexed, ")
    first, second = done.stderr.splitlines()
    assert re.match(
        r"seq-01/frame-000000: Frame \w+ has the same content, but a different robot", first
    )
    assert second.startswith("seq-01/frame-000002: ")


def test_bad_frames_stop_no_others(sceneprint, service_url, rooms, tmp_path):
    folder = tmp_path / "mixed"
    shutil.copytree(rooms / "room-0" / "seq-01", folder)
    (folder / "frame-000001.depth.png").write_bytes(b"no image")
    wall = np.zeros((240, 320), np.float32)
    wall[100:105, 100:106] = 2.0
    write_depth_png(folder / "frame-000003.depth.png", wall, 1000.0)
    (folder / "frame-000002.pose.txt").write_text("no pose")
    done = sceneprint("upload", "mixed", folder, "--tag", "a", "--tag", "b", expect=2)
    *_, counts, poses = done.stdout.splitlines()
    assert poses.startswith(
        "poses of 1 of 4 frames; 2 without: not indexed; 1 without: there is no NAME.pose.txt "
        "beside them and no NAME.txt in a folder `pose`; depth "
    )
    assert counts.startswith(
        "4 frames: 2 received, 0 already there, 2 refused; 1 indexed, 1 rejected, 0 failed; "
    )
    lines = done.stderr.splitlines()
    assert [line.split(": ")[0] for line in lines] == [f"mixed/frame-00000{i}" for i in (1, 2, 3)]
    assert "frame-000002.pose.txt" in lines[1]
    assert "rejected: only 30 of its 30 valid depth samples" in lines[2]
    with Client(service_url) as client:
        indexed = list(client.frames("mixed", FrameState.INDEXED))
    assert [(one.tags, one.session) for one in indexed] == [(["a", "b"], "mixed")]


def test_what_is_lost_though_nobody_asked_ends_with_code_2(sceneprint, rooms, tmp_path):
    """A trajectory of another day: the frames are indexed, and all of its poses are lost."""
    folder = tmp_path / "day"
    shutil.copytree(rooms / "room-0" / "seq-01", folder)
    for pose in folder.glob("*.pose.txt"):
        pose.unlink()
    for i in range(3):
        (folder / f"frame-00000{i}.depth.png").rename(folder / f"{i}.png")
    (folder / "depth.txt").write_text("0.0 0.png\n1.0 1.png\n2.0 2.png\n")
    (folder / "groundtruth.txt").write_text("99.5 0 0 0 0 0 0 1\n")
    options = ("upload", "day", folder, "--depth-scale", "250")
    done = sceneprint(*options, expect=2)
    *_, counts, summary, hint = done.stdout.splitlines()
    assert hint == "map day has no poses, so answers have frames but no coordinates"
    assert "3 received, 0 already there; 3 indexed" in counts
    assert summary.startswith(
        "poses of 0 of 3 frames; 3 without: groundtruth.txt has no pose within 20 ms of their "
        "time stamps (nearest: 97.5 s away); depth "
    )
    assert "m are unusual for a depth camera" in summary  # four times as far away
    assert "3 already there; 3 indexed" in sceneprint(*options, "--no-pose").stdout


def test_poses_lead_to_the_frame_that_is_named(sceneprint, service_url, rooms, tmp_path):
    """Without a robot to the scene's; the same name for two places only where it is asked for."""
    other = tmp_path / "room-0"
    shutil.copytree(rooms / "room-1", other)
    without = ("--no-wait", "--every", 3)
    sceneprint("upload", "named", rooms / "room-0", *without)
    sceneprint("upload", "named", other, "--robot", "r2", *without)
    one = ("--parent-frame", "hall", "--robot", "r1", *without)
    sceneprint("upload", "together", rooms / "room-0", other, *one)
    with Client(service_url) as client:
        for name, expected in (("named", ["r2/room-0", "room-0"]), ("together", ["hall", "hall"])):
            poses = [frame.pose for frame in client.frames(name)]
            assert sorted(pose.parent_frame for pose in poses if pose is not None) == expected


def test_upload_refuses_what_would_mix(sceneprint, house, rooms, tmp_path):
    done = sceneprint("upload", house, rooms, "--model", "paper", expect=2)
    assert re.search(r"Map house already exists with model depth-\w+\. Omit --model", done.stderr)
    done = sceneprint("upload", "absent", rooms, "--no-create", expect=2)
    assert "There is no map 'absent'" in done.stderr
    other = tmp_path / "room-0"
    shutil.copytree(rooms / "room-0", other)
    done = sceneprint("upload", house, rooms / "room-0", other, expect=2)
    assert "also has the parent frame room-0" in done.stderr
    assert "specify it with --parent-frame" in done.stderr
    assert done.stdout == ""


@pytest.mark.thorough
def test_ctrl_c_keeps_what_was_received(service_url, rooms):
    with Client(service_url) as client:
        client.create_map("stopped")
        before = signal.signal(signal.SIGINT, signal.SIG_DFL)  # a shell's background ignores it
        process = subprocess.Popen(
            [sys.executable, "-m", "sceneprint", "upload", "stopped", rooms, "--parallel", "1"],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            env={**os.environ, "SCENEPRINT_URL": service_url},
        )  # fmt: skip
        signal.signal(signal.SIGINT, before)
        until = time.monotonic() + PATIENCE_S
        while not sum(client.map("stopped").frames.values()) and time.monotonic() < until:
            pass  # the first frame arrives
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=PATIENCE_S)
        kept = sum(client.map("stopped").frames.values())
    assert process.returncode == 130
    assert "Traceback" not in err
    assert err.splitlines()[-1] == "sceneprint upload: stopped"
    received = re.match(r"6 frames: (\d) received", out)
    assert 1 <= int(received[1]) == kept


def test_a_query_is_told_in_a_table(sceneprint, house, rooms):
    done = sceneprint("query", house, rooms / "room-0", "--frame", 1, "--k", 2)
    head, titles, *matches, place, grounds = done.stdout.splitlines()
    assert re.match(
        r"seq-01/frame-000001: found [\d.]+ % \(\d of \d validated, 6 ranked of 6", head
    )
    assert titles.split()[:4] == ["match", "rank", "similarity", "validation"]
    there = read_pose(rooms / "room-0/seq-01/frame-000001.pose.txt")[:3, 3]
    first = matches[0].split()
    assert first[0] == "r1/room-0/seq-01/frame-000001.depth.png"
    assert first[4:6] == ["accepted", "strong"]
    assert [float(value) for value in first[11:14]] == pytest.approx(there, abs=2e-3)
    assert [float(value) for value in place.split()[1:4]] == pytest.approx(there, abs=0.05)
    assert " m in r1/room-0, rotation " in place
    assert grounds.startswith("  one view (strong); decided by the matches; ")


def test_queries_as_json(sceneprint, house, rooms):
    done = sceneprint("query", house, rooms / "room-1", "--json", "--seed", 3, "--exact")
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert [line["name"] for line in lines] == [f"seq-01/frame-00000{i}" for i in range(3)]
    for line in lines:
        answer = Answer.model_validate(line)
        assert (answer.counts.map, answer.seed, answer.exact) == (6, 3, True)
    file = rooms / "room-1/seq-01/frame-000002.depth.png"
    done = sceneprint("query", house, rooms, "--frame", file, "--json", "--stages", "retrieve")
    answer = Answer.model_validate_json(done.stdout)
    assert answer.status == "unvalidated"
    assert json.loads(done.stdout)["name"] == "room-1/seq-01/frame-000002"


def test_queries_that_cannot_be_asked(sceneprint, house, rooms, tmp_path):
    folder = tmp_path / "seq-01"
    shutil.copytree(rooms / "room-0" / "seq-01", folder)
    (folder / "frame-000000.depth.png").write_bytes(b"no image")
    done = sceneprint("query", house, folder, "--stages", "retrieve", "--json", expect=2)
    assert len(done.stdout.splitlines()) == 2
    assert done.stderr.startswith("seq-01/frame-000000: ")
    for arguments, message in (
        (("--frame", 3), r"has 3 frames\. Set --frame to an index from 0 to 2"),
        (("--frame", "x"), "no frame is named x"),
        (("--stages", "validate", "--frame", 1), "stages: "),
        (("--k", 51, "--frame", 1), "less than or equal to 50"),
    ):
        done = sceneprint("query", house, folder, *arguments, expect=2)
        assert re.search(message, done.stderr)
        assert len(done.stderr.splitlines()) == 1


def test_maps_are_listed_made_and_deleted(sceneprint, house):
    sceneprint("maps", "--create", "hall", "--title", "Hall 2", "--model", "depth")
    rows = [line.split() for line in sceneprint("maps").stdout.splitlines()]
    assert rows[0] == ["map", "indexed", "waiting", "rejected", "failed", "model", "title"]
    by_name = {row[0]: row for row in rows[1:]}
    assert by_name[house][1:5] == ["6", "0", "0", "0"]
    assert by_name["hall"][5].startswith("depth-")
    assert by_name["hall"][6:] == ["Hall", "2"]
    records = map(Map.model_validate_json, sceneprint("maps", "--json").stdout.splitlines())
    assert {record.name: record.title for record in records}["hall"] == "Hall 2"
    assert "Add --yes" in sceneprint("maps", "--delete", "hall", expect=2).stderr
    done = sceneprint("maps", "--delete", "hall", "--yes")
    assert done.stdout == "deleted map hall and its 0 frames\n"
    for wrong, message in (
        (("--delete", "hall", "--yes"), "There is no map 'hall'"),
        (("--create", "A b"), "name: must be 1 to 63 lower-case letters"),
        (("--title", "x"), "--create NAME or --edit"),
    ):
        assert message in sceneprint("maps", *wrong, expect=2).stderr


def test_an_archive_is_uploaded_as_its_folder_is(sceneprint, house, rooms, tmp_path):
    archive = shutil.make_archive(str(tmp_path / "rooms"), "gztar", rooms.parent, rooms.name)
    done = sceneprint("upload", house, archive, "--robot", "r1")
    assert done.stdout.startswith("6 frames: 0 received, 6 already there; 6 indexed, ")
    assert done.stdout.splitlines()[1].startswith("rooms.tar.gz: poses of 6 of 6 frames; depth ")
    done = sceneprint("upload", house, archive, "--depth-scale", 1000, expect=2)
    assert 'put the value as "depth_scale" into intrinsics.json' in done.stderr
    bad = tmp_path / "bad.zip"
    bad.write_bytes(b"PK\x03\x04" + bytes(600))
    done = sceneprint("upload", house, bad, expect=2)
    assert (len(done.stdout.splitlines()), len(done.stderr.splitlines())) == (1, 1)


def test_a_map_has_limits(sceneprint, house):
    created = sceneprint("maps", "--create", "small", "--model", "depth", "--quota-frames", "2")
    assert re.fullmatch(r"map small, depth-\w{12}, 0 of 2 frames\n", created.stdout)
    changes = ("--quota-frames", "none", "--quota-bytes", "1500000", "--retention-days", "30")
    done = sceneprint("maps", "--edit", "small", "--title", "Small", *changes).stdout
    assert done.endswith(", 0.0 of 1.5 MB, kept 30 days\n")
    refusal = sceneprint("maps", "--edit", house, "--retention-days", "0.000001", expect=2).stderr
    assert "would permanently delete the 6 frames of map" in refusal
    assert "Add --yes" in refusal
    assert "There is nothing to change" in sceneprint("maps", "--edit", house, expect=2).stderr
    sceneprint("maps", "--delete", "small", "--yes")


def test_options_of_another_upload_are_errors(sceneprint, house, room_mesh, tmp_path):
    file = tmp_path / "room.ply"
    file.write_bytes(room_mesh)
    for options, message in (
        (("--as-map", "--every", "2"), "every: does not apply to a map"),
        (("--height", "1"), "--height is only for maps in one file. Add --as-map"),
    ):
        assert message in sceneprint("upload", house, file, *options, expect=2).stderr
