"""Tests of cameras in recordings: the camera info at each frame, and the unit of depth."""

import struct

import numpy as np
import pytest

from sceneprint.errors import DatasetError, UnreadableFrame
from sceneprint.formats.dataset import find_sequences
from sceneprint.formats.recording.outline import bag_outline
from sceneprint.formats.recording.selection import RecordingOptions
from sceneprint_client.ros_messages import compressed_depth, rvl_samples
from tests.bag_writer import rvl

ALL = RecordingOptions(keyframe_m=0, keyframe_s=0)
IMAGE = np.full((60, 80), 2000, np.uint16)


@pytest.mark.parametrize("container", ["mcap", "ros1"])
@pytest.mark.parametrize("way", ["beside each frame", "after each frame", "now and then"])
def test_each_frame_has_the_camera_info_of_its_time(way, container, tmp_path, ros):
    """The focal length changes at 1 s, and a driver that starts again sends zeros."""

    def fill(writer):
        for i in range(8):
            t = 0.25 * i
            f = 70.0 if t < 1 else 50.0
            writer.image(t, IMAGE)
            writer.late = 0.01
            if way != "now and then":
                shift = 0.004 if way == "after each frame" else 0.0
                writer.camera_info(t + shift, k=(f, f, 39.5, 29.5))
            elif i in (0, 4):
                writer.camera_info(t - 0.1, k=(f, f, 39.5, 29.5))
            if i == 5:
                writer.camera_info(t, k=(0.0, 0.0, 0.0, 0.0))
            writer.late = 0.0

    (sequence,) = find_sequences(ros.write(tmp_path, fill, container), ALL)
    focal = [frame.camera.intrinsics.fx for frame in sequence.frames if frame.camera]
    assert focal == [70.0] * 4 + [50.0] * 4
    assert sequence.note.endswith(
        "2 cameras, because the camera info changes: each frame has the camera of its time"
    )


def test_a_camera_info_of_another_run_is_not_that_of_this_one(tmp_path, ros):
    """Two runs of a simulation with other cameras, their stamps between each other."""

    def fill(writer):
        for run, f in enumerate((70.0, 50.0)):
            writer.late = 10.0 * run
            for i in range(4):
                writer.image(1.0 + 0.2 * i + 0.1 * run, IMAGE)
                writer.camera_info(1.0 + 0.2 * i + 0.1 * run, k=(f, f, 39.5, 29.5))

    sequences = find_sequences(ros.write(tmp_path, fill), ALL)
    focal = [[f.camera.intrinsics.fx for f in each.frames if f.camera] for each in sequences]
    assert focal == [[70.0] * 4, [50.0] * 4]


def test_depth_in_other_units(tmp_path, ros):
    """0.1 mm: ten times too far as millimetres, which is doubted, and right with its scale."""

    def fill(writer):
        writer.camera_info(0.0)
        writer.image(0.0, np.full((60, 80), 17_500, np.uint16))
        writer.image(1.0, np.full((60, 80), 12_500, np.uint16))

    path = ros.write(tmp_path, fill)
    assert "a median of 15 m and a 5th percentile of 15 m are unusual" in str(
        bag_outline(path, ALL).range
    )
    scaled = RecordingOptions(keyframe_s=0, depth_scale=10_000)
    (right,) = find_sequences(path, scaled)
    np.testing.assert_array_equal(right.frames[1].read_depth().depth, np.float32(1.25))
    assert str(bag_outline(path, scaled).range) == (
        "depth 1.5 to 1.5 m (5th to 95th percentile), 100 % of pixels valid"
    )


# Compressed images.


def test_rvl_by_hand():
    """Two zeros; then 1000, 1001 and 990: differences 1000, 1 and -11, zigzag 2000, 2 and 21."""
    groups = "2 3 | 0 2 7 3 | 2 | 5 2 | 1 0"
    ends = {0, 1, 5, 6, 8, 9, 10}
    digits = [int(part) for part in groups.replace("|", "").split()]
    nibbles = [digit | (0 if i in ends else 8) for i, digit in enumerate(digits)] + [0] * 5
    words = [int("".join(f"{nibble:x}" for nibble in nibbles[i : i + 8]), 16) for i in (0, 8)]
    result = rvl_samples(struct.pack("<IIII", 3, 2, *words))
    assert result.tolist() == [[0, 0, 1000], [1001, 990, 0]]


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_compressed_depth_by_rvl(encoding, tmp_path, ros):
    rng = np.random.default_rng(4)
    samples = rng.integers(300, 9000, (60, 80)).astype(np.uint16)
    samples[rng.random(samples.shape) < 0.3] = 0
    samples[3] = 65_535
    a, b = (0.0, 0.0) if encoding == "16UC1" else (10100.0, -1009.0)

    def fill(writer):
        writer.camera_info(0.0)
        head = struct.pack("<iff", 0, a, b)
        topic, form = "/camera/depth/image_raw/compressedDepth", f"{encoding}; compressedDepth rvl"
        writer.write_compressed(topic, 0.0, form, head + rvl(samples))

    ((frame,),) = [sequence.frames for sequence in find_sequences(ros.write(tmp_path, fill), ALL)]
    metres = samples / np.float32(1000) if encoding == "16UC1" else a / (samples - b)
    missing = (samples == 0) | ((samples == 65_535) & (encoding == "16UC1"))
    expected = np.where(missing, 0, metres)
    np.testing.assert_allclose(frame.read_depth().depth, expected, rtol=1e-6)
    messages = ros.messages()
    fill(messages)
    body = compressed_depth(messages.last()).body()
    stored = samples if encoding == "16UC1" else expected
    np.testing.assert_allclose(np.asarray(body), stored, rtol=1e-6)
    for cut in (4, 30, len(rvl(samples)) - 200):
        with pytest.raises(UnreadableFrame, match="RVL-compressed image is damaged"):
            rvl_samples(rvl(samples)[:cut])


def test_rvl_of_more_than_16_bits_is_damaged():
    for wrong in (65_536, -1):
        with pytest.raises(UnreadableFrame, match="RVL-compressed image is damaged"):
            rvl_samples(rvl(np.array([[5, wrong, 7]])))
    np.testing.assert_array_equal(rvl_samples(rvl(np.array([[5, 65_535]]))), [[5, 65_535]])


def test_an_inverse_depth_of_no_distance_is_missing(ros):
    """z = a / (v - b): at v = b it is nowhere, and below b behind the camera."""
    data = struct.pack("<iff", 0, 100.0, 7.0) + rvl(np.array([[6, 7, 8]]))
    messages = ros.messages()
    messages.write_compressed("/depth", 0.0, "32FC1; compressedDepth rvl", data)
    np.testing.assert_array_equal(compressed_depth(messages.last()).body(), [[0.0, 0.0, 100.0]])


def test_what_cannot_be_read_is_not_promised(tmp_path, ros):
    def fill(writer):
        writer.camera_info(0.0)
        for i in range(4):
            writer.compressed(float(i), IMAGE, form="16UC1; compressedDepth rvl")

    outline = bag_outline(ros.write(tmp_path, fill), ALL)
    assert outline.sequences == ()
    assert outline.problem.endswith("RVL-compressed image is damaged. Record it again.")


@pytest.mark.parametrize("form", ["16UC1; png compressed ", "png", "mono16; png compressed"])
def test_png_of_16_bits(form, tmp_path, ros):
    topic = "/camera/depth/image_raw/compressed"

    def fill(writer):
        writer.camera_info(0.0)
        writer.compressed(0.0, IMAGE, form=form, topic=topic)

    (sequence,) = find_sequences(ros.write(tmp_path, fill), ALL)
    np.testing.assert_array_equal(sequence.frames[0].read_depth().depth, np.float32(2))


def test_metres_have_no_depth_scale(tmp_path, ros):
    def fill(writer):
        writer.camera_info(0.0)
        writer.image(0.0, np.full((60, 80), 1.5), "32FC1")

    with pytest.raises(DatasetError, match=r"has 32FC1 in metres, .* Omit --depth-scale"):
        find_sequences(ros.write(tmp_path, fill), RecordingOptions(depth_scale=4000))
