"""Tests of serialised PointCloud2 messages, valid and damaged."""

import struct

import numpy as np
import pytest

from sceneprint.errors import FrameError, UnreadableCloud, UselessFrame
from sceneprint.formats.points.cloud import decode_scan
from sceneprint_client.files import read_point_cloud
from sceneprint_client.formats import format_of
from sceneprint_client.ros_messages import cloud_points
from tests.scans.conftest import LAYOUTS, rows_of


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("little", [True, False])
@pytest.mark.parametrize(("height", "padding"), [(1, 0), (3, 0), (3, 5)])
def test_any_layout_is_read_as_rosbags_wrote_it(serialize, points, layout, little, height, padding):
    whole = np.round(points)  # as some fields are whole numbers
    rows = rows_of(whole, layout)
    big = layout[0][1].startswith(">")
    data = serialize(rows, little=little, height=height, padding=padding, big=big)
    assert format_of(data[:10_016]) == "pointcloud2"
    scan = decode_scan(data)
    assert (scan.file_format, scan.file_points) == ("pointcloud2", len(points))
    expected = whole[whole.any(axis=1)]
    np.testing.assert_array_equal(scan.cloud.points, expected.astype(np.float32))


def test_what_a_sensor_missed_is_left_out(serialize, points):
    rows = rows_of(np.vstack([points + 10, np.zeros((2, 3)), np.full((3, 3), np.nan)]), LAYOUTS[0])
    scan = decode_scan(serialize(rows))
    np.testing.assert_array_equal(scan.cloud.points, (points + 10).astype(np.float32))
    assert scan.cloud.note == "5 missing points skipped"
    with pytest.raises(UselessFrame, match="0 of 0 points are valid"):
        decode_scan(serialize(rows[:0]))


def test_a_message_may_end_with_its_last_byte_and_no_earlier(serialize, points):
    rows = rows_of(points, LAYOUTS[0])
    data = serialize(rows)
    end = data.rindex(rows.tobytes()) + rows.nbytes + 1  # is_dense; what follows is padding
    assert bytes(read_point_cloud(data[:end]).data) == rows.tobytes()
    with pytest.raises(UnreadableCloud, match="truncated: 1 bytes are expected"):
        read_point_cloud(data[: end - 1])


def test_other_files_are_no_clouds(serialize, points):
    data = serialize(rows_of(points, LAYOUTS[0]))
    flat = serialize(np.zeros(3, [("x", "<f4"), ("y", "<f4")]))
    empty = (b"", b"\0", b"\0\1\0\0", bytes(16), bytes(4096), b"\0\1\0\0" * 4)
    for other in (*empty, data[4:], flat):
        assert format_of(other) is None
    kitti = np.hstack([points, np.ones((len(points), 1))]).astype("<f4").tobytes()
    assert format_of(kitti) is None
    with pytest.raises(UnreadableCloud, match="This is not a KITTI scan"):
        decode_scan(data, file_format="kitti")


def fields_at(data):
    """Where point_step is, and row_step and the size of the data after it."""
    return data.index(b"z\0") + 2 + 2 + 4 + 4 + 4 + 4


def patched(data, place, word):
    return data[:place] + struct.pack("<I", word) + data[place + 4 :]


def test_wrong_numbers_are_named(serialize, points):
    data = serialize(rows_of(points, LAYOUTS[0]), frame="lidar")
    read_point_cloud(data)
    count = data.index(b"lidar\0") + 8  # of height, after what aligns it
    assert struct.unpack_from("<3I", data, count) == (1, len(points), 3)
    step = fields_at(data)
    assert struct.unpack_from("<3I", data, step) == (12, 12 * len(points), 12 * len(points))
    huge = 2**32 - 1
    for place, word, why in (
        (4 + 4, 10**9, "stamp"), (12, huge, "A name"), (count, huge, "20000000"),
        (count, 2, "2 rows"), (count + 4, huge, "20000000"), (count + 8, huge, "fields"),
        (count + 8, 4, "truncated|fields|is declared|name"), (step, 0, "0 bytes"),
        (step, huge, "but declares"), (step, 11, "do not fit|but declares"),
        (step + 8, huge, "truncated"), (step + 8, 0, "follow the end"),
    ):  # fmt: skip
        changed = patched(data, place, word)
        with pytest.raises(UnreadableCloud, match=why):
            list(cloud_points(read_point_cloud(changed)))
        with pytest.raises(FrameError):
            decode_scan(changed)
    for place in range(len(data)):
        with pytest.raises(FrameError):
            decode_scan(data[:place])
    assert decode_scan(data + bytes(3)).file_points == len(points)  # as middleware fills up
    with pytest.raises(UnreadableCloud, match="8 bytes follow"):
        decode_scan(data + bytes(8))
