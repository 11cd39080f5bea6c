"""Tests of the node's logic, from serialised messages to transforms and poses."""

from __future__ import annotations

from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint_client import Client, Tracker
from sceneprint_client.relocaliser import Level, Relocaliser, RelocaliserParameters, planar
from sceneprint_client.tracker_core import difference
from tests.client.conftest import answer

SECOND = 1_000_000_000


class ScriptedLocalizer:
    """A client that answers every question with the truth, or as it was told."""

    def __init__(self, found_at=None):
        self.requests: list[dict[str, Any]] = []
        self.found_at = found_at or (lambda number: np.eye(4))

    def localize(self, map_name, frame, meta=None, **how):
        self.requests.append({"frame": frame, "meta": meta, **how})
        matrix = self.found_at(len(self.requests) - 1)
        return answer("not_found") if matrix is None else answer("found", matrix, "site")

    def localize_sequence(self, map_name, frames, metas, **how):
        return self.localize(map_name, frames[-1], metas[-1], **how)


@contextmanager
def scripted(found_at=None, **parameters):
    client = ScriptedLocalizer(found_at)
    with Relocaliser(Tracker(client, "m"), RelocaliserParameters(**parameters)) as core:
        yield core, client


def take(core, topic, name, message):
    kind = name.rpartition("/")[2]
    if kind == "TFMessage":
        core.take_transforms(message, fixed=topic == "/tf_static")
    elif kind == "CameraInfo":
        core.take_camera_info(message)
    elif kind == "Odometry":
        core.take_odometry(message)
    elif kind == "Imu":
        core.take_imu(message)
    else:
        core.take_frame(message)


def run(core, arrived):
    reports = []
    for one in arrived:
        take(core, *one)
        if core.step():
            assert core.wait(PATIENCE_S)
            reports.append(core.report(one[2].transforms[0].header.stamp.sec * SECOND))
    return reports


def still(ros, count=1, every=0.5, start=0.0):
    writer = ros.messages()
    writer.transforms(start, {("base_link", "camera"): np.eye(4)}, "/tf_static")
    writer.camera_info(start, size=(8, 6))
    for i in range(count):
        writer.image(start + every * i, np.full((6, 8), 1000))
        writer.transforms(start + every * i, {("odom", "base_link"): np.eye(4)})
    return writer


@pytest.mark.parametrize("kind", ["depth", "points"])
def test_a_drive_is_tracked_as_the_truth_is(kind, drive, service_url, room, ros):
    count = 6 if kind == "depth" else 4
    arrived = drive(kind, frames=count)
    with Client(service_url) as client, Relocaliser(Tracker(client, "room")) as core:
        reports = run(core, arrived)
        assert core.counts == {
            "frames": count,
            "queried": count,
            "without_transform": 0,
            "unreadable": 0,
        }
    assert len(reports) == count
    tracked = [i for i, report in enumerate(reports) if report.pose is not None]
    assert tracked[0] <= 2
    assert tracked == list(range(tracked[0], count))
    assert [report.is_fix for report in reports] == [i == tracked[0] for i in range(count)]
    for i in tracked:
        report = reports[i]
        step, turn = difference(report.pose.T_map_base, room[i].pose @ np.linalg.inv(ros.camera))
        assert step < 0.08
        assert np.degrees(turn) < 2
        assert report.level is Level.OK
        assert report.values["map_is"] == "site"


def test_nothing_is_told_of_a_place_that_is_not_known(ros):
    with scripted(lambda number: None) as (core, _):
        before = core.report(ros.start * SECOND)
        assert (before.level, before.message) == (Level.STALE, "no frame has arrived")
        (report,) = run(core, still(ros).written)
    assert report.pose is None
    assert (report.level, report.is_fix) == (Level.WARN, False)
    assert report.message.startswith("lost: ")


def test_frames_are_asked_for_no_oftener_than_told(ros):
    with scripted(interval_s=0.5) as (core, client):
        reports = run(core, still(ros, 31, every=1 / 15).written)
    assert len(reports) == 31
    assert len(client.requests) == 4  # at 0, 8, 16 and 24 fifteenths of a second
    assert [round((r.stamp_ns - ros.start * SECOND) * 15e-9) for r in reports] == [*range(31)]


def test_a_frame_waits_for_its_transform_and_no_longer_than_told(ros):
    writer = still(ros, 1)
    with scripted(interval_s=0.0, wait_s=0.4) as (core, client):
        for message in writer.written:
            take(core, *message)
        assert core.step() == 1
        assert core.wait(PATIENCE_S)  # else a later frame may overtake it
        for t in (0.5, 0.7, 0.85):
            writer.image(t, np.full((6, 8), 1000))
            take(core, *writer.written[-1])
            assert core.step() == 0
        for t in (0.4, 0.6):
            writer.transforms(t, {("odom", "base_link"): np.eye(4)})
            take(core, *writer.written[-1])
        assert core.step() == 1  # of 0.5, between the two
        assert core.wait(PATIENCE_S)
        writer.image(1.2, np.full((6, 8), 1000))
        take(core, *writer.written[-1])
        assert core.step() == 0
        assert core.counts["without_transform"] == 1  # of 0.7, which waited for half a second
        result = core.report((ros.start + 10) * SECOND)
        assert (result.level, result.pose) == (Level.STALE, None)
        assert (
            result.message
            == "no transforms from odom to camera and base_link at the stamps of the frames"
        )
    assert len(client.requests) == 2


def test_what_is_silent_is_not_told(ros):
    with scripted() as (core, _):
        (report,) = run(core, still(ros).written)
        assert report.is_fix
        assert core.report(ros.start * SECOND + 2 * SECOND).pose is not None
        silent = core.report(ros.start * SECOND + 3 * SECOND)
        assert (silent.pose, silent.level) == (None, Level.STALE)
        assert silent.message == "no frame has arrived for 3.0 s"
        again = core.report(ros.start * SECOND)
        assert (again.pose is not None, again.is_fix) == (True, False)


def test_relocalising_forgets_and_asks_at_once(ros):
    with scripted(interval_s=60.0) as (core, client):
        reports = run(core, still(ros, 3).written)
        assert [report.state.status for report in reports] == ["tracking"] * 3
        assert len(client.requests) == 1
        core.relocalise()
        lost = core.report(ros.start * SECOND + SECOND)
        assert (lost.state.status, lost.pose) == ("lost", None)
        assert "relocalisation" in lost.message
        (actual,) = run(core, still(ros, 1, start=2.0).written)
        assert actual.is_fix
        assert len(client.requests) == 2
        assert client.requests[1]["prior"] is None


def test_a_clock_that_jumps_back_begins_anew(ros):
    with scripted() as (core, client):
        run(core, still(ros, 3, start=100.0).written)
        reports = run(core, still(ros, 2, start=0.0).written)
    assert [report.is_fix for report in reports] == [True, False]
    assert [report.stamp_ns for report in reports] == [
        ros.start * SECOND,
        ros.start * SECOND + SECOND // 2,
    ]
    assert len(client.requests) == 5


def test_the_pose_is_that_of_the_base_and_so_is_its_covariance(ros):
    """The camera sits 2 m before the base: its heading's error moves the base sideways."""
    T_base_camera = ros.transform(2.0, 0, 0)
    writer = ros.messages()
    writer.transforms(0.0, {("base_link", "camera"): T_base_camera}, "/tf_static")
    writer.camera_info(0.0, size=(8, 6))
    writer.image(0.0, np.full((6, 8), 1000))
    writer.transforms(0.0, {("odom", "base_link"): ros.transform(5, 0, 0)})
    T_map_camera = ros.transform(1, 1, 0, 0, 0, np.sin(0.5), np.cos(0.5))
    with scripted(lambda number: T_map_camera) as (core, _):
        (report,) = run(core, writer.written)
        state = report.state
    np.testing.assert_allclose(report.pose.T_map_base, T_map_camera @ np.linalg.inv(T_base_camera))
    np.testing.assert_allclose(
        report.pose.T_map_odom,
        report.pose.T_map_base @ np.linalg.inv(ros.transform(5, 0, 0)),
        atol=1e-12,
    )
    heading = np.array([np.cos(1), np.sin(1)])
    sideways = np.array([-heading[1], heading[0]])
    variance = sideways @ report.pose.covariance[:2, :2] @ sideways
    own = sideways @ state.covariance[:2, :2] @ sideways
    assert variance == pytest.approx(own + 4 * state.covariance[5, 5])
    along = heading @ report.pose.covariance[:2, :2] @ heading
    assert along == pytest.approx(heading @ state.covariance[:2, :2] @ heading)


def test_on_a_plane_only_heading_and_place_are_told(ros):
    tilted = ros.transform(1, 2, 0.3, 0.02, -0.03, np.sin(0.4), np.cos(0.4))
    flat = planar(tilted)
    np.testing.assert_allclose(flat[:3, 3], (1, 2, 0))
    np.testing.assert_allclose(flat[2], (0, 0, 1, 0))
    assert np.arctan2(flat[1, 0], flat[0, 0]) == pytest.approx(
        np.arctan2(tilted[1, 0], tilted[0, 0])
    )
    with scripted(lambda number: tilted, planar=True) as (core, _):
        (report,) = run(core, still(ros).written)
    np.testing.assert_allclose(report.pose.T_map_base, flat)
    np.testing.assert_allclose(report.pose.T_map_odom, flat)  # odometry is at its origin


def test_a_fix_in_another_frame_is_not_told(ros):
    with scripted(parent_frame="hall") as (core, _):
        (report,) = run(core, still(ros).written)
    assert (report.state.status, report.pose) == ("tracking", None)
    assert (report.level, report.message) == (
        Level.WARN, "tracked in site, but this map is hall"
    )  # fmt: skip


def test_odometry_of_its_own_topic_serves_where_tf_has_none(ros):
    writer = ros.messages()
    writer.transforms(0.0, {("base_link", "camera"): np.eye(4)}, "/tf_static")
    writer.camera_info(0.0, size=(8, 6))
    writer.odometry(0.0, ros.transform(1, 0, 0))
    writer.image(0.0, np.full((6, 8), 1000))
    with scripted() as (core, _):
        for message in writer.written:
            take(core, *message)
        assert core.step() == 1
        assert core.wait(PATIENCE_S)
        report = core.report(ros.start * SECOND)
        np.testing.assert_allclose(report.pose.T_map_odom, ros.transform(-1, 0, 0), atol=1e-12)
        # once tf says the same, odometry is passed over
        writer.transforms(1.0, {("odom", "base_link"): ros.transform(2, 0, 0)})
        writer.odometry(2.0, ros.transform(9, 0, 0))
        writer.image(2.0, np.full((6, 8), 1000))
        for message in writer.written[-3:]:
            take(core, *message)
        assert core.step() == 0


def test_up_is_sent_while_the_robot_is_at_rest(ros):
    T_base_imu = ros.transform(0, 0, 0.2, 0, -np.sin(np.pi / 4), 0, np.cos(np.pi / 4))
    for moves, expected in ((False, (0, 0, 1)), (True, None)):
        writer = ros.messages()
        fixed = {("base_link", "camera"): np.eye(4), ("base_link", "imu"): T_base_imu}
        writer.transforms(0.0, fixed, "/tf_static")
        writer.camera_info(0.0, size=(8, 6))
        for i in range(100):
            writer.imu(0.01 * i, (9.81, 0, 0), (0, 0, 0.5 * moves))
        writer.image(1.0, np.full((6, 8), 1000))
        writer.transforms(1.0, {("odom", "base_link"): np.eye(4)})
        with scripted() as (core, client):
            run(core, writer.written)
        up = client.requests[0]["meta"].up
        if expected is None:
            assert up is None
        else:
            np.testing.assert_allclose((up.x, up.y, up.z), expected, atol=1e-9)


def test_what_cannot_be_used_is_told_and_the_robot_goes_on(ros):
    writer = ros.messages()
    writer.transforms(0.0, {("base_link", "camera"): np.eye(4)}, "/tf_static")
    for i, encoding in enumerate(("16UC1", "rgb8", "16UC1")):
        if i == 1:
            writer.camera_info(0.4, size=(8, 6))
        writer.image(0.5 * i, np.full((6, 8), 1000), encoding)
        writer.transforms(0.5 * i, {("odom", "base_link"): np.eye(4)})
    with scripted() as (core, _):
        reports = run(core, writer.written)
        assert core.counts == {"frames": 3, "queried": 1, "without_transform": 0, "unreadable": 2}
        writer.image(-ros.start, np.full((6, 8), 1000))
        take(core, *writer.written[-1])
        assert core.report((ros.start + 1) * SECOND).message.startswith("A frame has no stamp.")
    assert [report.level for report in reports] == [Level.ERROR, Level.ERROR, Level.OK]
    assert reports[0].message.startswith("No calibrated camera info has arrived.")
    assert "encoding 'rgb8'" in reports[1].message
