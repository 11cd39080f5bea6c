"""Tests of damaged bags: only documented errors, in bounded time and memory."""

import io
import shutil
import struct
import subprocess
import sys

import numpy as np
import pytest

from sceneprint.errors import DatasetError, SceneprintError, UnreadableCloud, UnreadableFrame
from sceneprint.formats.dataset import find_sequences
from sceneprint.formats.recording.outline import bag_outline
from sceneprint.formats.recording.selection import RecordingOptions
from tests.scans.conftest import rows_of

DEPTH, POINTS = "/camera/depth/image_raw", "/points"


def read_all(path):
    """How many frames can be read of whatever is there; what is raised is ours."""
    count = 0
    for topic in (DEPTH, POINTS):
        try:
            sequences = find_sequences(
                path, RecordingOptions(topic=topic, keyframe_m=0, keyframe_s=0)
            )
        except SceneprintError as error:
            check(error)
            continue
        for frame in (frame for sequence in sequences for frame in sequence.frames):
            try:
                frame.read()
                count += 1
            except SceneprintError as error:
                check(error)
    try:
        bag_outline(path, RecordingOptions())
    except SceneprintError as error:
        check(error)
    return count


def check(error):
    """An error is one line that says what to do."""
    message = str(error)
    assert message.isprintable()
    assert message.endswith("."), message
    assert len(message) < 2000


@pytest.fixture(scope="module")
def small(tmp_path_factory, ros, walk):
    """A bag of everything in each container, small enough to be cut at many places."""
    rng = np.random.default_rng(0)
    rows = rows_of(rng.uniform(1, 5, (30, 3)), [(name, "<f4") for name in "xyz"])

    def fill(writer):
        writer.transforms(0.0, {("base_link", "camera"): ros.camera}, "/tf_static")
        for i, (t, T) in enumerate(walk[:4]):
            writer.transforms(t, {("odom", "base_link"): T})
            writer.odometry(t, T)
            writer.camera_info(t, size=(8, 6))
            writer.imu(t, (0, 0, 9.8))
            writer.image(t, rng.integers(500, 4000, (6, 8)))
            writer.points(t, rows, height=1 + i % 2)

    folder = tmp_path_factory.mktemp("small")
    files = {c: ros.write(folder / c, fill, c) for c in ros.containers}
    files["zstd"] = ros.write(folder / "zstd", fill, "mcap", compression="storage")
    files["bz2"] = ros.write(folder / "bz2", fill, "ros1", compression="bz2")
    files["message"] = ros.write(folder / "message", fill, "sqlite3", compression="message")
    return files


def damaged(bag, folder, content, number):
    if bag.is_file():
        path = folder / f"{number}{bag.suffix}"
        path.write_bytes(content)
        return path
    copy = folder / f"{number}"
    shutil.copytree(bag, copy)
    next(copy.glob("*.db3")).write_bytes(content)
    return copy


def content_of(bag):
    return (bag if bag.is_file() else next(bag.glob("*.db3"))).read_bytes()


ALL_KINDS = ["mcap", "sqlite3", "ros1", "zstd", "bz2", "message"]
#: Bags that are damaged of each kind: the first of them, and all.
DAMAGED = [24, pytest.param(60, marks=pytest.mark.thorough)]


@pytest.mark.parametrize("kind", ALL_KINDS)
def test_whole_bags_are_read(kind, small):
    assert read_all(small[kind]) == 8


@pytest.mark.parametrize("times", DAMAGED)
@pytest.mark.parametrize("kind", ALL_KINDS)
def test_bags_that_were_cut_off_or_have_other_bytes(kind, times, small, tmp_path):
    whole, rng = content_of(small[kind]), np.random.default_rng(2)
    places = {0, 1, 7, 8, 9, 13, 40, len(whole) - 1, len(whole) - 8, len(whole) - 37}
    places |= set(rng.integers(0, len(whole), times - 10).tolist())
    contents = [whole[:place] for place in sorted(places)]
    for _ in range(times):
        content = bytearray(whole)
        for _ in range(int(rng.integers(1, 4))):
            at = int(rng.integers(0, len(content) - 8))
            kinds = (
                bytes(rng.integers(0, 256, int(rng.integers(1, 9))).tolist()), b"\xff" * 8,
                b"\x00" * 8, struct.pack("<Q", 2**40), struct.pack("<I", 2**31 - 1),
            )  # fmt: skip
            new = kinds[int(rng.integers(0, len(kinds)))]
            content[at : at + len(new)] = new
        contents.append(bytes(content))
    for number, content in enumerate(contents):
        read_all(damaged(small[kind], tmp_path, content, number))


@pytest.mark.parametrize(
    "text",
    [
        "", "[", "a: b", "rosbag2_bagfile_information: 3",
        "rosbag2_bagfile_information: {version: 99}",
        "rosbag2_bagfile_information: {version: 9, relative_file_paths: [gone.db3]}", "\x00",
    ],
)  # fmt: skip
def test_folders_with_other_metadata(text, small, tmp_path):
    copy = tmp_path / "bag"
    shutil.copytree(small["sqlite3"], copy)
    (copy / "metadata.yaml").write_text(text)
    with pytest.raises(DatasetError, match=r"The recording cannot be read \(.*ros2 bag reindex"):
        find_sequences(copy)


def messages(writer, depth):
    name = "sensor_msgs/msg/Image"
    for width, height, step, bytes_there in (
        (80, 60, 160, 9599), (80, 60, 159, 9600), (0, 0, 0, 0),
        (2**32 - 1, 2**32 - 1, 2**32 - 1, 9),
        (80, 2**32 - 1, 160, 9600), (2**31, 1, 2**32 - 1, 9600), (1, 2**31, 0, 16),
    ):  # fmt: skip
        image = writer.make(
            name, header=writer.header(0.0, "camera"), height=height, width=width,
            encoding="16UC1", is_bigendian=0, step=step, data=np.zeros(bytes_there, np.uint8),
        )  # fmt: skip
        yield name, writer.serialized(name, image)
    whole = writer.serialized(name, image)
    for place in (0, 3, 4, 11, 12, 20, 40, len(whole) - 1):
        yield name, whole[:place]
    yield name, whole[:-20] + b"\xff" * 20
    yield name, b"\xff" * 100


@pytest.mark.parametrize("container", ["mcap", "ros1"])
def test_images_of_absurd_sizes(container, tmp_path, ros, depth):
    def fill(writer):
        writer.camera_info(0.0)
        writer.image(0.0, depth(0))
        for number, (name, data) in enumerate(messages(writer, depth)):
            writer.raw("/camera/depth/image_raw", name, 0.1 + 0.1 * number, data)

    path = ros.write(tmp_path, fill, container)
    sequences = find_sequences(path, RecordingOptions(keyframe_s=0))  # some stamps go back
    by_name = {frame.name[-2:]: frame for sequence in sequences for frame in sequence.frames}
    assert len(by_name) == 18
    assert by_name.pop("00").read().depth.any()
    for frame in by_name.values():
        with pytest.raises(UnreadableFrame, match=r"run\.\w+, /camera/depth/image_raw at \d+ ns"):
            frame.read()


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "PNG or RVL"), (b"\x00" * 12, "PNG or RVL"),
        (b"\x00" * 12 + b"\xff\xd8\xff", "PNG or RVL"),
        (b"\x00" * 80 + b"\x89PNG\r\n\x1a\n", "PNG or RVL"),
        (b"\x00" * 12 + b"\x89PNG\r\n\x1a\n", "truncated"),
    ],
)  # fmt: skip
def test_compressed_images_that_are_none(data, message, tmp_path, ros, depth):
    def fill(writer):
        writer.camera_info(0.0)
        writer.compressed(0.0, depth(0))
        topic = "/camera/depth/image_raw/compressedDepth"
        writer.write_compressed(topic, 1.0, "16UC1; compressedDepth", data)

    (sequence,) = find_sequences(ros.write(tmp_path, fill))
    with pytest.raises(UnreadableFrame, match=message):
        sequence.frames[1].read()


@pytest.mark.parametrize(
    ("a", "b"),
    [(np.nan, 1.0), (np.inf, 0.0), (-1.0, 0.0), (0.0, 0.0), (1.0, np.nan)],
)  # fmt: skip
def test_parameters_of_inverse_depth_that_are_none(a, b, tmp_path, ros, depth):
    def fill(writer):
        writer.camera_info(0.0)
        writer.compressed(0.0, depth(0), "32FC1", a=a, b=b)

    (sequence,) = find_sequences(ros.write(tmp_path, fill))
    with pytest.raises(UnreadableFrame, match="inverse depth"):
        sequence.frames[0].read()


def test_a_chunk_that_grows_beyond_what_it_announces(tmp_path):
    """A gigabyte of zeros in a small file: refused, and never held."""
    backports = pytest.importorskip("backports.zstd")
    bomb = backports.compress(bytes(1 << 30), 1)
    assert len(bomb) < 200_000
    out = io.BytesIO()

    def record(op, content):
        out.write(bytes([op]) + struct.pack("<Q", len(content)) + content)

    def text(value):
        return struct.pack("<I", len(value)) + value

    out.write(b"\x89MCAP0\r\n")
    record(1, text(b"ros2") + text(b""))
    chunk = struct.pack("<QQQI", 0, 1, 4096, 0) + text(b"zstd")
    record(6, chunk + struct.pack("<Q", len(bomb)) + bomb)
    record(2, struct.pack("<QQI", 0, 0, 0))
    out.write(b"\x89MCAP0\r\n")
    path = tmp_path / "bomb.mcap"
    path.write_bytes(out.getvalue())
    program = (
        "import sys\nfrom pathlib import Path\n"
        "from sceneprint.formats.dataset import find_sequences\n"
        "from sceneprint.errors import DatasetError\n"
        "try:\n    find_sequences(Path(sys.argv[1]))\n"
        "except DatasetError as error:\n    print(error)\n"
        # not ru_maxrss: that survives exec, and would be the peak of whoever started us
        "peak = [one for one in open('/proc/self/status') if one.startswith('VmHWM')]\n"
        "print(peak[0].split()[1])\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, str(path)], capture_output=True, text=True, check=True
    )
    message, peak = done.stdout.strip().rsplit("\n", 1)
    assert "a chunk does not end within 4096 bytes" in message
    assert int(peak) < 400_000  # KB


def test_a_chunk_of_ros_1_that_grows(small, tmp_path, monkeypatch):
    monkeypatch.setattr("sceneprint.formats.recording.bag.MAXIMUM_CHUNK_BYTES", 2000)
    with pytest.raises(DatasetError):
        find_sequences(small["bz2"], RecordingOptions(topic="/points"))


def test_points_without_coordinates(tmp_path, ros):
    rows = np.ones(30, [("x", "<f4"), ("y", "<f4"), ("intensity", "<f4")])
    (sequence,) = find_sequences(ros.write(tmp_path, lambda writer: writer.points(0.0, rows)))
    with pytest.raises(UnreadableCloud, match="has the fields x, y, intensity, but x, y and z"):
        sequence.frames[0].read()
