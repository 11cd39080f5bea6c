"""Tests of the range of samples in uploads."""

import numpy as np
import pytest

from sceneprint.formats.sample_range import sample_range
from sceneprint.types import Cloud, DepthFrame, Intrinsics
from sceneprint_client.api.frames import SampleRange, pooled_range, upload_summary

#: Near, median and far of whole recordings of a Kinect (twice), an Xtion and a RealSense, metres.
REAL = [(0.95, 1.82, 2.79), (0.8, 1.05, 3.01), (1.6, 2.8, 4.09), (0.65, 1.18, 6.45)]


def of(near, median, far, valid=0.875):
    return SampleRange(near=near, median=median, far=far, count=100, valid=valid)


def test_the_range_of_depth_leaves_missing_pixels_out():
    depth = np.zeros((25, 8), np.float32)
    depth.flat[:101] = np.arange(0, 101) / 10  # the first is missing: 0.1 to 10 m
    result = sample_range(DepthFrame(depth, Intrinsics(8, 25, 9, 9, 4, 12)))
    assert (result.count, result.valid) == (100, 0.5)
    assert [result.near, result.median, result.far] == pytest.approx([0.595, 5.05, 9.505])


def test_the_range_of_points_is_their_distance_from_the_sensor():
    points = np.zeros((101, 3), np.float32)
    points[:, 1] = -np.arange(101)
    result = sample_range(Cloud(points))
    assert result == SampleRange(near=5.0, median=50.0, far=95.0, count=101)


@pytest.mark.parametrize(("near", "median", "far"), REAL)
def test_a_range_is_doubted_where_the_unit_is_wrong(near, median, far):
    assert not of(near, median, far).is_doubtful
    for scale in (4.0, 5.0, 10.0, 0.1):  # 0.25 mm, TUM's, 0.1 mm, and centimetres for millimetres
        assert of(scale * near, scale * median, scale * far).is_doubtful
    assert not of(10 * near, 10 * median, 10 * far, valid=None).is_doubtful  # of a scanner
    for scale in (0.01, 1000.0):  # the median is 1.05 to 2.8
        doubted = of(scale * near, scale * median, scale * far, valid=None)
        assert doubted.is_doubtful
        assert "is unusual for a scanner: check that the coordinates are metres" in str(doubted)


def test_a_summary_is_one_line():
    ranges = [of(0.6, 1.5, 4.0), of(0.7, 1.6, 4.2), of(0.8, 1.9, 9.0), of(1.0, 5.0, 30.0, None)]
    why = "no sample within 20 ms (nearest 1.2 s)"
    summary = upload_summary(50, {why: 9}, ranges, ["skipped: run/ir (infrared)"])
    assert summary.text == (
        "poses of 41 of 50 frames; 9 without: no sample within 20 ms (nearest 1.2 s); "
        "skipped: run/ir (infrared); depth 0.7 to 4.2 m (5th to 95th percentile), 88 % of pixels "
        "valid; range 1 to 30 m (5th to 95th percentile), 100 points"
    )
    assert summary.model_dump()["text"] == summary.text
    doubt = upload_summary(1, {}, [of(2.4, 3.6, 5.3)]).text
    assert "a median of 3.6 m and a 5th percentile of 2.4 m are unusual for a depth camera" in doubt
    assert "specify the depth scale" in doubt
    assert upload_summary(0, {}, []).text == "poses of 0 of 0 frames"
    assert pooled_range([]) is None
