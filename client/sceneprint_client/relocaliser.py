"""Localization of a robot from ROS messages: the logic of the ROS 2 node, without ROS.

Image | CompressedImage | PointCloud2  --Relocaliser.take_frame-->  queries to a service
CustomMsg, serialised  --Relocaliser.take_livox_scan-->  queries to a service
CameraInfo, TFMessage, Odometry, Imu  --Relocaliser.take_...-->  camera, poses, up
stamp  --Relocaliser.report-->  Report  --write_pose | write_transform-->  messages

A message is any object with the attributes of its ROS type; see ros_messages.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from enum import IntEnum
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from sceneprint_client.api.base import CameraIntrinsics
from sceneprint_client.errors import SceneprintError
from sceneprint_client.files import read_livox_scan
from sceneprint_client.joiner import Joiner
from sceneprint_client.poses import WINDOW_S, Accelerations, Floats, quaternion_of
from sceneprint_client.ros_messages import (
    camera_intrinsics,
    cloud_points,
    compressed_depth,
    depth_samples,
    is_calibrated,
    pose_row,
    stamp_of,
    timed_points,
    transform_row,
    vector_row,
)
from sceneprint_client.tracker import AsyncTracker, State, Tracker
from sceneprint_client.tracker_core import inverse, shifted_covariance
from sceneprint_client.transforms import TOLERANCE_S, TransformTree, frame_name

if TYPE_CHECKING:
    from sceneprint_client.http import FrameInput

#: Period for which transforms and accelerations are stored, seconds.
_MEMORY_S = 10.0
#: Number of messages between two removals of old data.
_SWEEP_INTERVAL = 512
#: A frame older than the previous one by more than this time means that the clock jumped, seconds.
_JUMP_S = 1.0
#: Maximum number of frames that wait for their transforms.
_MOST_WAITING = 64
#: Message of a report before the first frame.
_NOTHING = "no frame has arrived"


@dataclass(frozen=True)
class RelocaliserParameters:
    """Parameters of a Relocaliser.

    Parameters
    ----------
    odom_frame : parent frame of the robot's odometry
    base_frame : frame of the robot's base
    parent_frame : parent frame of the service's map that is published as `map`; empty: the parent
        frame of the first fix. Fixes in other parent frames are not reported
    rectified : whether depth images are rectified, so that their camera is P of the camera info
    interval_s : minimum time between two queried frames, seconds
    join_m : length of the path whose scans are joined into one frame, metres; 0: no joining
    wait_s : maximum time that a frame waits for its transforms, by the stamps of later frames,
        seconds
    stale_s : maximum age of the last frame for a pose to be reported, seconds
    planar : whether the robot drives on the plane z = 0 of the map; if so, `T_map_odom` has only
        x, y and the heading of the base
    """

    odom_frame: str = "odom"
    base_frame: str = "base_link"
    parent_frame: str = ""
    rectified: bool = False
    interval_s: float = 0.5
    join_m: float = 0.0
    wait_s: float = 0.5
    stale_s: float = 2.0
    planar: bool = False


class Level(IntEnum):
    """Levels of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True, eq=False)
class TrackedPose:
    """Pose of a tracked robot.

    Parameters
    ----------
    T_map_odom, T_map_base : (4, 4) poses of odometry and base in the map
    covariance : (6, 6) of T_map_base, errors (x, y, z, rx, ry, rz) along the axes of the map
    """

    T_map_odom: Floats
    T_map_base: Floats
    covariance: Floats


@dataclass(frozen=True, eq=False)
class Report:
    """State for other ROS nodes.

    Parameters
    ----------
    state : state of the tracker
    stamp_ns : stamp of the latest frame, nanoseconds; 0 before the first
    pose : pose while tracking, else None
    is_fix : whether the robot is tracked and was not tracked at the last report
    level, message, values : fields of the diagnostics
    """

    state: State
    stamp_ns: int
    pose: TrackedPose | None
    is_fix: bool
    level: Level
    message: str
    values: dict[str, str]


@dataclass(frozen=True, eq=False)
class _Place:
    """Poses of the sensor and the base in the odometry frame at the time of a frame."""

    stamp_ns: int
    T_odom_sensor: Floats
    T_odom_base: Floats


@dataclass(frozen=True, eq=False)
class _Arrival:
    """Message that waits for its transforms, with its points and times if scans are joined."""

    stamp_ns: int
    message: Any
    scan: tuple[Floats, Floats | None] | None

    @property
    def covered_ns(self) -> int:
        """Stamp after the last point of the scan, nanoseconds; odometry must cover it."""
        if self.scan is None or self.scan[1] is None:
            return self.stamp_ns
        last_s = max(float(self.scan[1].max()), 0.0)
        return self.stamp_ns + round(1e9 * (last_s + TOLERANCE_S))


class Relocaliser:
    """Consumer of ROS messages that queries a service in its own thread.

    Call it from one thread, and close it or use it in `with`.

    Parameters
    ----------
    tracker : tracker that nothing else updates
    parameters : parameters; default: RelocaliserParameters()
    """

    def __init__(self, tracker: Tracker, parameters: RelocaliserParameters | None = None) -> None:
        self.parameters = parameters or RelocaliserParameters()
        self.counts = {"frames": 0, "queried": 0, "without_transform": 0, "unreadable": 0}
        self._tracker, self._questions = tracker, AsyncTracker(tracker)
        self._tree = TransformTree()
        self._edges_of_tf: set[tuple[str, str]] = set()
        self._imu: tuple[str, Accelerations] | None = None
        self._info: Any = None
        self._waiting: deque[_Arrival] = deque()
        self._joiner: tuple[str, Joiner] | None = None  #: frame of the sensor, and its scans
        self._newest_ns = self._unswept = 0
        self._last: _Place | None = None
        self._queried_ns: int | None = None
        self._parent = self.parameters.parent_frame
        self._was_tracking = False
        self._error, self._error_at = "", 0

    # Input.

    def take_camera_info(self, message: Any) -> None:
        """Process a sensor_msgs CameraInfo; ignore it if the camera is not calibrated."""
        if is_calibrated(message):
            self._info = message

    def take_transforms(self, message: Any, *, fixed: bool) -> None:
        """Process a tf2_msgs TFMessage; `fixed` marks messages of /tf_static."""
        for transform in message.transforms:
            parent, child = str(transform.header.frame_id), str(transform.child_frame_id)
            self._edges_of_tf.add((frame_name(parent), frame_name(child)))
            row = transform_row(transform.transform)
            self._tree.add(parent, child, stamp_of(transform.header), row, fixed=fixed)
        self._sweep()

    def take_odometry(self, message: Any) -> None:
        """Process a nav_msgs Odometry; ignore it if tf has the same transform."""
        parent, child = frame_name(message.header.frame_id), frame_name(message.child_frame_id)
        if parent and child and (parent, child) not in self._edges_of_tf:
            row = pose_row(message.pose.pose)
            self._tree.add(parent, child, stamp_of(message.header), row, fixed=False)
            self._sweep()

    def take_imu(self, message: Any) -> None:
        """Process a sensor_msgs Imu; ignore it if it has no accelerometer."""
        if float(message.linear_acceleration_covariance[0]) < 0:
            return
        frame = frame_name(message.header.frame_id)
        if self._imu is None or self._imu[0] != frame:
            self._imu = frame, Accelerations()
        self._imu[1].add(
            stamp_of(message.header), vector_row(message.linear_acceleration),
            vector_row(message.angular_velocity),
        )  # fmt: skip
        self._sweep()

    def take_frame(self, message: Any) -> None:
        """Queue a sensor_msgs depth Image, CompressedImage or PointCloud2 until `step` has its
        transforms.
        """
        stamp = stamp_of(message.header)
        self.counts["frames"] += 1
        scan = None
        try:
            if stamp <= 0:
                raise SceneprintError("A frame has no stamp. Check the clock of the sensor driver.")
            if self.parameters.join_m > 0 and hasattr(message, "point_step"):
                scan = timed_points(message)
        except SceneprintError as error:
            self.counts["unreadable"] += 1
            self._record_error(error)
            return
        if self._newest_ns - stamp > _JUMP_S * 1e9:
            self._restart("the clock jumped back")
        self._newest_ns = max(self._newest_ns, stamp)
        self._waiting.append(_Arrival(stamp, message, scan))
        if len(self._waiting) > _MOST_WAITING:
            self._waiting.popleft()
            self.counts["without_transform"] += 1

    def take_livox_scan(self, data: bytes) -> None:
        """Queue a CustomMsg of livox_ros_driver2 that ROS 2 serialised; see `take_frame`."""
        try:
            message = read_livox_scan(data)
        except SceneprintError as error:
            self.counts["frames"] += 1
            self.counts["unreadable"] += 1
            self._record_error(error)
        else:
            self.take_frame(message)

    def relocalise(self, reason: str = "relocalisation was requested") -> None:
        """Forget the pose; the next frame is queried immediately, without a prior."""
        self._tracker.reset(reason)
        self._queried_ns, self._was_tracking = None, False

    def step(self) -> int:
        """Process frames whose transforms have arrived, and return their number.

        A frame whose transforms do not arrive within `wait_s` is dropped and counted.
        """
        done = 0
        while self._waiting:
            arrival = self._waiting[0]
            sensor = frame_name(arrival.message.header.frame_id)
            place = end = self._place(arrival.stamp_ns, sensor)
            if arrival.covered_ns > arrival.stamp_ns:
                end = self._place(arrival.covered_ns, sensor)
            is_recent = self._newest_ns - arrival.stamp_ns <= self.parameters.wait_s * 1e9
            if (place is None or end is None) and is_recent:
                break
            self._waiting.popleft()
            if place is None:
                self.counts["without_transform"] += 1
            elif arrival.stamp_ns > self._last_ns:
                self._process_frame(place, arrival)
                done += 1
        return done

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until all queries are answered; return False after a timeout."""
        return self._questions.wait(timeout_s)

    def close(self) -> None:
        """Stop querying; wait for a query in progress."""
        self._questions.close()

    def __enter__(self) -> Relocaliser:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def _last_ns(self) -> int:
        return 0 if self._last is None else self._last.stamp_ns

    def _sweep(self) -> None:
        """Remove old transforms and accelerations after every 512 messages."""
        self._unswept += 1
        if self._unswept >= _SWEEP_INTERVAL:
            self._unswept = 0
            self._tree.forget(round(_MEMORY_S * 1e9))
            if self._imu is not None:
                self._imu[1].forget(round(_MEMORY_S * 1e9))

    def _restart(self, reason: str) -> None:
        """Discard all data of the previous clock, except fixed transforms."""
        self._tree.forget_moving()
        self._imu, self._last, self._joiner = None, None, None
        self._waiting.clear()
        self._newest_ns = 0
        self.relocalise(reason)

    # Frames.

    def _place(self, stamp_ns: int, sensor: str) -> _Place | None:
        """Return the odometry poses at a stamp, or None if a transform is unknown."""
        odom, base = self.parameters.odom_frame, self.parameters.base_frame
        (T_odom_sensor,) = self._tree.poses(odom, sensor, [stamp_ns])
        (T_odom_base,) = self._tree.poses(odom, base, [stamp_ns])
        if T_odom_sensor is None or T_odom_base is None:
            return None
        return _Place(stamp_ns, T_odom_sensor, T_odom_base)

    def _process_frame(self, place: _Place, arrival: _Arrival) -> None:
        """Move the tracker to a frame, and query the frame if the interval has passed."""
        self._last, message = place, arrival.message
        stamp = place.stamp_ns * 1e-9
        if not self._join(arrival):
            self.counts["without_transform"] += 1
            self._tracker.move(place.T_odom_sensor, stamp)
            return
        previous = self._queried_ns
        if previous is not None and place.stamp_ns - previous < self.parameters.interval_s * 1e9:
            self._tracker.move(place.T_odom_sensor, stamp)
            return
        try:
            frame, camera = self._frame(message)
        except SceneprintError as error:
            self.counts["unreadable"] += 1
            self._record_error(error)
            self._tracker.move(place.T_odom_sensor, stamp)
            return
        try:
            up = self._up(message, place.stamp_ns)
            self._questions.submit(frame, place.T_odom_sensor, up, stamp, meta=camera)
        except SceneprintError as error:  # raised by the previous query
            self._record_error(error)
        else:
            self._queried_ns = place.stamp_ns
            self.counts["queried"] += 1

    def _join(self, arrival: _Arrival) -> bool:
        """Join a scan, if any, to earlier ones; return False if odometry does not cover it."""
        if arrival.scan is None:
            return True
        sensor = frame_name(arrival.message.header.frame_id)
        if self._joiner is None or self._joiner[0] != sensor:
            odometry = partial(self._tree.poses, self.parameters.odom_frame, sensor)
            self._joiner = sensor, Joiner(odometry, self.parameters.join_m)
        return self._joiner[1].add(arrival.stamp_ns, *arrival.scan)

    def _frame(self, message: Any) -> tuple[FrameInput, CameraIntrinsics | None]:
        """Return frame and camera for a query; raise SceneprintError if they cannot be read."""
        if self._joiner is not None:
            return self._joiner[1].cloud(), None
        if hasattr(message, "point_step"):
            return cloud_points(message), None
        if self._info is None:
            raise SceneprintError(
                "No calibrated camera info has arrived. Check the topic of the camera info."
            )
        k = camera_intrinsics(self._info, rectified=self.parameters.rectified)
        camera = CameraIntrinsics(
            width=k.width, height=k.height, fx=k.fx, fy=k.fy, cx=k.cx, cy=k.cy,
            distortion=list(k.distortion),
        )  # fmt: skip
        if hasattr(message, "encoding"):
            return depth_samples(message), camera
        return compressed_depth(message).body(), camera

    def _up(self, message: Any, stamp_ns: int) -> tuple[float, float, float] | None:
        """Return up in the sensor's axes while the robot is at rest, else None."""
        if self._imu is None:
            return None
        frame, accelerations = self._imu
        T_sensor_imu = self._tree.fixed_transform(frame_name(message.header.frame_id), frame)
        # The window ends at the frame because later measurements have not arrived yet.
        (up,) = accelerations.up_at([stamp_ns - round(WINDOW_S * 1e9)])
        if T_sensor_imu is None or up is None:
            return None
        x, y, z = T_sensor_imu[:3, :3] @ up
        return float(x), float(y), float(z)

    def _record_error(self, error: SceneprintError) -> None:
        self._error, self._error_at = str(error), self._questions.answered

    # Output.

    def report(self, now_ns: int) -> Report:
        """Return the state for other nodes, and remember whether it has a pose, for `is_fix`.

        Unless the parameters name a parent frame, that of the first fix is published from then on.

        Parameters
        ----------
        now_ns : current time on the clock of the stamps, nanoseconds
        """
        state, last = self._tracker.state(), self._last
        silent_s = (now_ns - self._last_ns) * 1e-9
        is_stale = last is None or silent_s > self.parameters.stale_s
        is_tracking = state.status == "tracking" and not is_stale
        if is_tracking and not self._parent:
            self._parent = state.parent_frame or ""
        is_elsewhere = is_tracking and state.parent_frame != self._parent
        pose = None
        if is_tracking and not is_elsewhere and last is not None:
            pose = self._pose(state, last)
        is_fix = pose is not None and not self._was_tracking
        if not is_stale:
            self._was_tracking = pose is not None
        level = Level.OK if pose is not None else Level.WARN
        message = f"{state.status}: {state.reason}"
        if is_elsewhere:
            message = f"tracked in {state.parent_frame}, but this map is {self._parent}"
        if is_stale:
            level = Level.STALE
            message = self._missing_frame_reason(silent_s)
        if self._questions.answered > self._error_at:
            self._error = ""
        if self._error:
            level, message = Level.ERROR, self._error
        return Report(
            state, self._last_ns, pose, is_fix, level, message, self._values(state)
        )  # fmt: skip

    def _pose(self, state: State, last: _Place) -> TrackedPose:
        """Return the pose of a tracked state at the last frame."""
        if state.T_map_odom is None or state.T_map_sensor is None or state.covariance is None:
            raise AssertionError("a tracked state has a pose")
        T_map_odom, T_map_base = state.T_map_odom, state.T_map_odom @ last.T_odom_base
        covariance = shifted_covariance(
            state.covariance, T_map_base[:3, 3] - state.T_map_sensor[:3, 3]
        )
        if self.parameters.planar:
            T_map_base = planar(T_map_base)
            T_map_odom = T_map_base @ inverse(planar(last.T_odom_base))
        return TrackedPose(T_map_odom, T_map_base, covariance)

    def _missing_frame_reason(self, silent_s: float) -> str:
        """Return the reason why there has been no frame with transforms for `silent_s` seconds."""
        p = self.parameters
        if not self.counts["frames"]:
            return _NOTHING
        if self._last is not None and not self._waiting:
            return f"no frame has arrived for {silent_s:.1f} s"
        sensor = (
            frame_name(self._waiting[-1].message.header.frame_id) if self._waiting else "the sensor"
        )
        ends = f"from {p.odom_frame} to {sensor} and {p.base_frame}"
        return f"no transforms {ends} at the stamps of the frames"

    def _values(self, state: State) -> dict[str, str]:
        values = {
            "status": state.status, "reason": state.reason,
            "parent_frame": state.parent_frame or "", "map_is": self._parent,
        }  # fmt: skip
        if state.covariance is not None and state.age is not None:
            values["age_s"] = f"{state.age:.1f}"
            deviations = np.sqrt(np.diag(state.covariance))
            values["deviation_m"] = f"{deviations[:3].max():.3f}"
            values["deviation_deg"] = f"{math.degrees(deviations[3:].max()):.2f}"
        counts = {**self.counts, "answered": self._questions.answered,
                  "superseded": self._questions.dropped}  # fmt: skip
        return {**values, **{name: str(count) for name, count in counts.items()}}


def planar(T: Floats) -> Floats:
    """Return a pose (4, 4) on the plane z = 0 with the same x, y and heading of the x axis."""
    cosine, sine = T[0, 0], T[1, 0]
    length = math.hypot(cosine, sine) or 1.0
    flat = np.eye(4)
    flat[:2, :2] = np.array([[cosine, -sine], [sine, cosine]]) / length
    flat[:2, 3] = T[:2, 3]
    return flat


def write_pose(message: Any, T: Floats) -> None:
    """Write a pose (4, 4) to a geometry_msgs Pose."""
    _write_vector(message.position, T[:3, 3])
    _write_rotation(message.orientation, T)


def write_transform(message: Any, T: Floats) -> None:
    """Write a transform (4, 4) to a geometry_msgs Transform."""
    _write_vector(message.translation, T[:3, 3])
    _write_rotation(message.rotation, T)


def write_stamp(message: Any, stamp_ns: int) -> None:
    """Write a stamp to a builtin_interfaces Time."""
    message.sec, message.nanosec = divmod(stamp_ns, 1_000_000_000)


def _write_vector(message: Any, vector: Floats) -> None:
    message.x, message.y, message.z = (float(value) for value in vector)


def _write_rotation(message: Any, T: Floats) -> None:
    message.x, message.y, message.z, message.w = map(float, quaternion_of(T[:3, :3]))
