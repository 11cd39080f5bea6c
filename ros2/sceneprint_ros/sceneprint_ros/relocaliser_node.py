"""The node `relocaliser`: parameters, subscriptions and publishers of the class `Relocaliser`.

All decisions are in sceneprint_client.relocaliser, which does not depend on ROS.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, TextIO, TypeVar

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu, PointCloud2
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

from sceneprint_client import Client, Tracker
from sceneprint_client.errors import InvalidRequest, MissingDependency, SceneprintError
from sceneprint_client.http import DEFAULT_URL
from sceneprint_client.relocaliser import (
    Level,
    Relocaliser,
    RelocaliserParameters,
    TrackedPose,
    write_pose,
    write_stamp,
    write_transform,
)
from sceneprint_client.ros_messages import is_rectified, topic_without_transport
from sceneprint_client.tracker import TrackerParameters

#: Message types of the topic of frames, by the parameter `kind`.
KINDS = {"depth": Image, "compressed_depth": CompressedImage, "points": PointCloud2}
#: Further kind: CustomMsg of livox_ros_driver2, a package that other robots need not install.
LIVOX = "livox"


T = TypeVar("T")


def described(default: T, text: str) -> T:
    """Return a field with a description, which `ros2 param describe` prints."""
    return field(default=default, metadata={"description": text})


@dataclass(frozen=True)
class NodeParameters:
    """Parameters of the node. Those of the tracker are named `tracker.NAME`."""

    url: str = described(DEFAULT_URL, "address of the service")
    key: str = described("", "API key; empty: the environment variable SCENEPRINT_KEY")
    map: str = described("", "name of the map in the service")
    topic: str = described("", "topic of the frames")
    kind: str = described("depth", "depth, compressed_depth, points or livox")
    camera_info_topic: str = described("", "camera info; empty: camera_info beside the frames")
    imu_topic: str = described("", "accelerations; empty: none")
    odometry_topic: str = described("", "odometry, if tf does not have it; empty: none")
    map_frame: str = described("map", "name of the map's frame in messages")
    odom_frame: str = described("odom", "frame of the odometry")
    base_frame: str = described("base_link", "frame of the robot")
    parent_frame: str = described("", "parent frame that equals map_frame; empty: the first fix's")
    interval_s: float = described(0.5, "minimum time between two queries, seconds")
    join_m: float = described(0.0, "length of the way whose scans are joined, metres; 0: none")
    wait_s: float = described(0.5, "maximum time that a frame waits for its transforms, seconds")
    stale_s: float = described(2.0, "time without frames after which nothing is published, seconds")
    planar: bool = described(False, "whether the robot drives on the plane z = 0 of the map")
    publish_tf: bool = described(True, "publish map -> odom; false beside AMCL, which does so")
    transform_tolerance_s: float = described(0.2, "validity of map -> odom, seconds")
    initial_pose_topic: str = described("/initialpose", "topic of the fixes; empty: none")
    rate_hz: float = described(20.0, "publishing rate; diagnostics are published once a second")
    log_file: str = described("", "log for sceneprint_client.tracker.replay; empty: none")
    autostart: bool = described(True, "start by itself; false under a lifecycle manager")

    def relocaliser(self) -> RelocaliserParameters:
        """Return the parameters of the relocaliser."""
        names = {one.name for one in fields(RelocaliserParameters)} - {"rectified"}
        values = {name: getattr(self, name) for name in names}
        return RelocaliserParameters(rectified=is_rectified(self.topic), **values)


class RelocaliserNode(LifecycleNode):  # type: ignore[misc]  # rclpy has no types
    """A managed node that publishes the pose of a robot while it is active; see README.md."""

    def __init__(self) -> None:
        super().__init__("relocaliser")
        self.error = ""  #: reason of the last failed transition
        self._declare(NodeParameters)
        self._declare(TrackerParameters, "tracker.")
        self._is_active = False
        self._closing: list[Callable[[], object]] = []

    def on_configure(self, _: object) -> Any:
        """Read the parameters, and subscribe; FAILURE if a parameter is missing or invalid."""
        try:
            self._open()
        except (SceneprintError, OSError) as error:
            self.on_cleanup(None)
            self.error = str(error)
            self.get_logger().error(self.error)
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, _: object) -> Any:
        """Begin to query and to publish."""
        self._is_active = True
        return TransitionCallbackReturn.SUCCESS

    def on_deactivate(self, _: object) -> Any:
        """Stop, and forget the pose: the robot may be moved before the next activation."""
        self._is_active = False
        self._core.relocalise("the node was deactivated")
        return TransitionCallbackReturn.SUCCESS

    def on_cleanup(self, _: object) -> Any:
        """Undo `on_configure`."""
        self._is_active = False
        while self._closing:
            self._closing.pop()()
        return TransitionCallbackReturn.SUCCESS

    on_shutdown = on_cleanup

    def _open(self) -> None:
        self._p = NodeParameters(**self._values(NodeParameters))
        tracking = TrackerParameters(**self._values(TrackerParameters, "tracker."))
        if not self._p.map or not self._p.topic or self._p.kind not in (*KINDS, LIVOX):
            raise InvalidRequest(
                f"The parameters map = {self._p.map!r}, topic = {self._p.topic!r} and kind = "
                f"{self._p.kind!r} are not valid: map and topic must not be empty, and kind must "
                f"be one of {', '.join((*KINDS, LIVOX))}. Set them in the launch file or with -p."
            )
        client = Client(self._p.url, self._p.key or os.environ.get("SCENEPRINT_KEY") or None)
        self._closing.append(client.close)
        log: TextIO | None = None
        if self._p.log_file:
            log = Path(self._p.log_file).open("w", buffering=1, encoding="utf-8")  # noqa: SIM115
            self._closing.append(log.close)
        tracker = Tracker(client, self._p.map, parameters=tracking, log=log)
        self._core = Relocaliser(tracker, self._p.relocaliser())
        self._closing.append(self._core.close)
        self._last_report = ("", 0)
        self._subscribe()
        self._poses = self._publisher(PoseWithCovarianceStamped, "~/pose", 10)
        self._fixes = None
        if self._p.initial_pose_topic:
            topic = self._p.initial_pose_topic
            self._fixes = self._publisher(PoseWithCovarianceStamped, topic, 10)
        self._transforms = self._publisher(TFMessage, "/tf", 100)
        self._diagnostics = self._publisher(DiagnosticArray, "/diagnostics", 10)
        service = self.create_service(Trigger, "~/relocalise", self._relocalise)
        self._closing.append(partial(self.destroy_service, service))
        self._report = self._core.report(self._now_ns())
        for period_s, callback in ((1.0 / self._p.rate_hz, self._tick), (1.0, self._diagnose)):
            timer = self.create_timer(period_s, callback)
            self._closing.append(partial(self.destroy_timer, timer))

    def _declare(self, kind: type[Any], prefix: str = "") -> None:
        """Declare parameters with the names, defaults and descriptions of a record."""
        for one in fields(kind):
            text = one.metadata.get("description", f"see sceneprint_client.tracker.{kind.__name__}")
            descriptor = ParameterDescriptor(description=text)
            self.declare_parameter(prefix + one.name, one.default, descriptor)

    def _values(self, kind: type[Any], prefix: str = "") -> dict[str, Any]:
        return {one.name: self.get_parameter(prefix + one.name).value for one in fields(kind)}

    def _publisher(self, kind: Any, topic: str, depth: int) -> Any:
        publisher = self.create_publisher(kind, topic, depth)
        self._closing.append(partial(self.destroy_publisher, publisher))
        return publisher

    def _listen(
        self, kind: Any, topic: str, callback: Callable[[Any], None], qos: Any, *,
        raw: bool = False,
    ) -> None:  # fmt: skip
        subscription = self.create_subscription(kind, topic, callback, qos, raw=raw)
        self._closing.append(partial(self.destroy_subscription, subscription))

    def _subscribe(self) -> None:
        p, sensor = self._p, qos_profile_sensor_data
        fixed = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        take = self._core.take_transforms
        self._listen(TFMessage, "/tf", partial(take, fixed=False), 100)
        self._listen(TFMessage, "/tf_static", partial(take, fixed=True), fixed)
        if p.kind == LIVOX:
            try:
                kind = import_module("livox_ros_driver2.msg").CustomMsg
            except ImportError as cause:
                raise MissingDependency(
                    "The kind livox requires the ROS package livox_ros_driver2, which is not "
                    f"found ({cause}). Build it, and source its workspace."
                ) from cause
            self._listen(kind, p.topic, self._take_frame, sensor, raw=True)
        else:
            self._listen(KINDS[p.kind], p.topic, self._take_frame, sensor)
        if p.kind not in ("points", LIVOX):
            beside = topic_without_transport(p.topic).rpartition("/")[0] + "/camera_info"
            info = p.camera_info_topic or beside
            self._listen(CameraInfo, info, self._core.take_camera_info, sensor)
        if p.imu_topic:
            self._listen(Imu, p.imu_topic, self._core.take_imu, sensor)
        if p.odometry_topic:
            self._listen(Odometry, p.odometry_topic, self._core.take_odometry, sensor)

    def _take_frame(self, message: Any) -> None:
        if self._is_active and isinstance(message, bytes):
            self._core.take_livox_scan(message)
        elif self._is_active:
            self._core.take_frame(message)

    # Publishers.

    def _tick(self) -> None:
        """Process frames, and publish the pose while it is known."""
        if not self._is_active:
            return
        self._core.step()
        report = self._report = self._core.report(self._now_ns())
        is_new = (report.state.status, report.stamp_ns) != self._last_report
        if report.state.status != self._last_report[0]:
            self.get_logger().info(f"{report.state.status}: {report.state.reason}")
        self._last_report = (report.state.status, report.stamp_ns)
        if report.pose is None:
            return
        if self._p.publish_tf:
            transform = self._transform(report.pose, report.stamp_ns)
            self._transforms.publish(TFMessage(transforms=[transform]))
        pose = self._pose(report.pose, report.stamp_ns)
        if is_new:
            self._poses.publish(pose)
        if report.is_fix and self._fixes is not None:
            self._fixes.publish(pose)

    def _transform(self, pose: TrackedPose, stamp_ns: int) -> Any:
        """Return map -> odom, stamped slightly in the future so that no consumer waits for it."""
        message = TransformStamped()
        tolerance_ns = round(self._p.transform_tolerance_s * 1e9)
        write_stamp(message.header.stamp, stamp_ns + tolerance_ns)
        message.header.frame_id, message.child_frame_id = self._p.map_frame, self._p.odom_frame
        write_transform(message.transform, pose.T_map_odom)
        return message

    def _pose(self, pose: TrackedPose, stamp_ns: int) -> Any:
        message = PoseWithCovarianceStamped()
        write_stamp(message.header.stamp, stamp_ns)
        message.header.frame_id = self._p.map_frame
        write_pose(message.pose.pose, pose.T_map_base)
        message.pose.covariance = pose.covariance.ravel()
        return message

    def _diagnose(self) -> None:
        message = DiagnosticArray()
        write_stamp(message.header.stamp, self._now_ns())
        values = {"url": self._p.url, "map": self._p.map, **self._report.values}
        message.status = [
            DiagnosticStatus(
                level=bytes([self._report.level if self._is_active else Level.WARN]),
                name=f"{self.get_name()}: localisation",
                message=self._report.message if self._is_active else "the node is not active",
                hardware_id=self._p.topic,
                values=[KeyValue(key=key, value=value) for key, value in values.items()],
            )
        ]
        self._diagnostics.publish(message)

    def _relocalise(self, _: Any, response: Any) -> Any:
        """Forget the pose, and query with the next frame at once."""
        self._core.relocalise()
        response.success = True
        response.message = "The pose is forgotten; the next frame will be queried."
        return response

    def _now_ns(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    def destroy_node(self) -> None:
        """Stop all queries and close the log."""
        self.on_cleanup(None)
        super().destroy_node()


def main(arguments: list[str] | None = None) -> int:
    """Run the node until it is stopped; return 2 if it starts itself and cannot."""
    rclpy.init(args=arguments)
    node = RelocaliserNode()
    try:
        if node.get_parameter("autostart").value:
            if node.trigger_configure() != TransitionCallbackReturn.SUCCESS:
                print(f"relocaliser: {node.error}", file=sys.stderr)
                return 2
            node.trigger_activate()
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return 0
