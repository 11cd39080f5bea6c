"""Tests that commands treat a bag like the folder that it was written from."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from sceneprint.cli import main
from sceneprint.formats.dataset import decode_png, find_sequences
from sceneprint_client import Client

FRAMES = 8


@pytest.fixture(scope="module")
def folder(building, tmp_path_factory):
    path = tmp_path_factory.mktemp("folder") / "room"
    path.mkdir()
    for frame in find_sequences(building / "room-0" / "seq-01")[0].frames[:FRAMES]:
        (path / frame.path.name).write_bytes(frame.path.read_bytes())
        pose = frame.path.name.replace(".depth.png", ".pose.txt")
        (path / pose).write_bytes((frame.path.parent / pose).read_bytes())
    camera = building / "room-0" / "intrinsics.json"
    (path / "intrinsics.json").write_bytes(camera.read_bytes())
    return path


def record(ros, place, name, frames):
    """Frames as a robot would have recorded them, its camera off its base."""

    def fill(writer):
        writer.transforms(0.0, {("base_link", "camera"): ros.camera}, "/tf_static")
        for i, frame in enumerate(frames):
            k = frame.camera.intrinsics
            t = 0.2 * i
            T_odom_base = frame.pose @ np.linalg.inv(ros.camera)
            writer.camera_info(t, k=(k.fx, k.fy, k.cx, k.cy), size=(k.width, k.height))
            writer.transforms(t, {("odom", "base_link"): T_odom_base})
            writer.image(t, decode_png(frame.read_bytes()))

    return Path(ros.write(place, fill, name=name))


@pytest.fixture(scope="module")
def recording(folder, ros, tmp_path_factory):
    (sequence,) = find_sequences(folder)
    return record(ros, tmp_path_factory.mktemp("recording"), "lab", sequence.frames)


@pytest.fixture(scope="module")
def bags(folder, ros, tmp_path_factory):
    """A folder with two bags of some of the frames, one in the folder of a day: an MCAP file, and
    a rosbag2 folder.
    """
    (sequence,) = find_sequences(folder)
    runs = tmp_path_factory.mktemp("bags") / "runs"
    first = record(ros, runs.with_name("first"), "first", sequence.frames[:2])
    runs.mkdir()
    first.rename(runs / first.name)
    record(ros, runs / "day2", "second", sequence.frames[2:5])
    return runs


@pytest.fixture(scope="module")
def maps(service_url, folder, recording, tmp_path_factory):
    for name, path in (("folder", folder), ("bag", recording)):
        assert main(["upload", name, str(path), "--keyframe-m", "0", "--url", service_url]) == 0
    return "folder", "bag"


def test_localize_and_sequences_of_a_bag(sceneprint, maps, recording):
    done = sceneprint("localize", "bag", recording, "--keyframe-m", 0, "--frame", 0)
    assert done.stdout.startswith("lab/000000: found")
    done = sceneprint("localize", "bag", recording, "--keyframe-m", 0, "--frame", 4, "--last", 3)
    assert done.stdout.startswith("lab/000004: found")
    done = sceneprint("query", "bag", recording, "--frame", 99, expect=2)
    assert "Set --frame to an index from 0 to" in done.stderr


def test_each_bag_of_a_folder_is_a_session(sceneprint, bags, service_url):
    options = ("--keyframe-m", 0)
    done = sceneprint("upload", "days", bags, *options)
    _, counts, summary, _ = done.stdout.splitlines()
    assert counts.startswith("5 frames: 5 received")
    assert summary.startswith("poses of 5 of 5 frames; depth ")
    assert f"{bags}/first.mcap: 2 of 2 frames of /camera" in done.stderr
    assert f"{bags}/day2/second: 3 of 3 frames of /camera" in done.stderr
    with Client(service_url) as client:
        frames = sorted((frame.session, frame.pose.parent_frame) for frame in client.frames("days")
                       if frame.pose is not None)  # fmt: skip
    assert frames == [("day2/second", "day2/second/odom")] * 3 + [("first", "first/odom")] * 2
    done = sceneprint("query", "days", bags, *options, "--frame", 4, "--json")
    assert json.loads(done.stdout)["name"] == "day2/second/000002"
    done = sceneprint("localize", "days", bags, *options, "--frame", 0)
    assert done.stdout.startswith("first/000000: found")
    done = sceneprint("bag", bags, *options)
    assert done.stdout.count(" frames of /camera/depth/image_raw used, poses of ") == 2


def test_bags_beside_other_frames_are_an_error(sceneprint, bags, folder, tmp_path):
    mixed = tmp_path / "mixed"
    (mixed / "room").mkdir(parents=True)
    (mixed / "run.mcap").write_bytes(b"never read")
    for path in folder.iterdir():
        (mixed / "room" / path.name).write_bytes(path.read_bytes())
    for command in (("upload", "mixed"), ("query", "folder"), ("localize", "folder"), ("sign",)):
        done = sceneprint(*command, mixed, expect=2)
        assert done.stderr == (
            f"sceneprint {command[0]}: {mixed}: The folder has both ROS recordings, such as "
            "run.mcap, and other frames, in room (7-Scenes). Specify one of them, or move the "
            "recordings to a separate folder.\n"
        )
    (mixed / "room").rename(tmp_path / "room")
    (mixed / "run.bag").write_bytes(b"")
    done = sceneprint("upload", "mixed", mixed, expect=2)
    assert "The recording would have the same name as run.bag, run." in done.stderr


def test_what_a_bag_holds(sceneprint, recording):
    head, *lines = sceneprint("bag", recording, "--keyframe-m", 0).stdout.splitlines()
    assert head == f"{recording}: ROS 2, 25 messages of 4 topics, 1.4 s from 2023-11-14T22:13:20Z"
    table = [re.sub(" +", " ", line.strip()) for line in lines]
    assert table[1] == "/camera/depth/image_raw sensor_msgs/msg/Image 8 5.7 Hz 16UC1, used"
    assert table[4].startswith("8 of 8 frames of /camera/depth/image_raw used, poses of 8 of 8")
    assert table[7] == "mounting: at 0.210 -0.050 0.930 m in base_link"


def test_a_bag_of_which_nothing_would_be_taken(sceneprint, tmp_path, ros):
    path = ros.write(tmp_path, lambda writer: writer.imu(0.0, (0, 0, 9.8)), "ros1")
    done = sceneprint("bag", path, expect=1)
    assert "ROS 1, 1 messages of 1 topics" in done.stdout
    assert "no frame can be used: " in done.stdout
    done = sceneprint("upload", "none", path, expect=2)
    assert done.stderr.startswith(f"sceneprint upload: {path}: There is no topic of depth images")
    assert done.stderr.count("\n") == 1


def test_options_that_are_none(recording, capsys):
    for text in ("-1", "nan", "x"):
        with pytest.raises(SystemExit):
            main(["bag", str(recording), "--keyframe-m", text])
        assert "is not a number of at least 0" in capsys.readouterr().err
