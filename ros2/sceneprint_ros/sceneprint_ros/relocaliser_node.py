"""The node `relocaliser`: parameters, subscriptions and publishers of the class `Relocaliser`.

All decisions are in sceneprint_client.relocaliser, which does not depend on ROS.
"""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TextIO

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu, PointCloud2
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

from sceneprint_client import Client, Tracker
from sceneprint_client.errors import InvalidRequest, SceneprintError
from sceneprint_client.http import DEFAULT_URL
from sceneprint_client.relocaliser import (
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


@dataclass(frozen=True)
class NodeParameters:
    """Parameters of the node. Those of the tracker are named `tracker.NAME`.

    Parameters
    ----------
    url : address of the service
    key : API key; empty: that of the environment variable SCENEPRINT_KEY
    map : name of the map in the service
    topic, kind : topic of the frames, and `depth`, `compressed_depth` or `points`
    camera_info_topic : topic of the camera info; empty: `camera_info` beside the frames
    imu_topic, odometry_topic : optional topics; empty: none
    map_frame, odom_frame, base_frame, parent_frame, interval_s, wait_s, stale_s, planar : see
        RelocaliserParameters; `map_frame` is the name of the map's frame in messages
    publish_tf : whether to publish map -> odom while tracking; false beside AMCL, which does so
    transform_tolerance_s : time in the future until which that transform is valid
    initial_pose_topic : topic of the fixes; empty: none
    rate_hz : publishing rate of everything except diagnostics, which are published once a second
    log_file : log for `sceneprint_client.tracker.replay`; empty: none
    """

    url: str = DEFAULT_URL
    key: str = ""
    map: str = ""
    topic: str = ""
    kind: str = "depth"
    camera_info_topic: str = ""
    imu_topic: str = ""
    odometry_topic: str = ""
    map_frame: str = "map"
    odom_frame: str = "odom"
    base_frame: str = "base_link"
    parent_frame: str = ""
    interval_s: float = 0.5
    wait_s: float = 0.5
    stale_s: float = 2.0
    planar: bool = False
    publish_tf: bool = True
    transform_tolerance_s: float = 0.2
    initial_pose_topic: str = "/initialpose"
    rate_hz: float = 20.0
    log_file: str = ""

    def relocaliser(self) -> RelocaliserParameters:
        """Return the parameters of the relocaliser."""
        names = {one.name for one in fields(RelocaliserParameters)} - {"rectified"}
        values = {name: getattr(self, name) for name in names}
        return RelocaliserParameters(rectified=is_rectified(self.topic), **values)


class RelocaliserNode(Node):  # type: ignore[misc]  # rclpy has no types
    """A node that publishes the pose of a robot; see README.md for its topics and parameters.

    Raises
    ------
    SceneprintError : If a parameter is missing or invalid.
    """

    def __init__(self) -> None:
        super().__init__("relocaliser")
        self._p = NodeParameters(**self._declared(NodeParameters))
        tracking = TrackerParameters(**self._declared(TrackerParameters, "tracker."))
        if not self._p.map or not self._p.topic or self._p.kind not in KINDS:
            raise InvalidRequest(
                f"The parameters map = {self._p.map!r}, topic = {self._p.topic!r} and kind = "
                f"{self._p.kind!r} are not valid: map and topic must not be empty, and kind must "
                f"be one of {', '.join(KINDS)}. Set them in the launch file or with -p."
            )
        self._client = Client(self._p.url, self._p.key or os.environ.get("SCENEPRINT_KEY") or None)
        self._log: TextIO | None = None
        if self._p.log_file:
            path = Path(self._p.log_file)
            self._log = path.open("w", buffering=1, encoding="utf-8")
        tracker = Tracker(self._client, self._p.map, parameters=tracking, log=self._log)
        self._core = Relocaliser(tracker, self._p.relocaliser())
        self._last_report = ("", 0)
        self._subscribe()
        self._poses = self.create_publisher(PoseWithCovarianceStamped, "~/pose", 10)
        self._fixes = None
        if self._p.initial_pose_topic:
            topic = self._p.initial_pose_topic
            self._fixes = self.create_publisher(PoseWithCovarianceStamped, topic, 10)
        self._transforms = self.create_publisher(TFMessage, "/tf", 100)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.create_service(Trigger, "~/relocalise", self._relocalise)
        self._report = self._core.report(self._now_ns())
        self.create_timer(1.0 / self._p.rate_hz, self._tick)
        self.create_timer(1.0, self._diagnose)

    def _declared(self, kind: type[Any], prefix: str = "") -> dict[str, Any]:
        """Declare parameters with the names and defaults of a record, and return their values."""
        return {
            one.name: self.declare_parameter(prefix + one.name, one.default).value
            for one in fields(kind)
        }

    def _subscribe(self) -> None:
        p, sensor = self._p, qos_profile_sensor_data
        fixed = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        listen = self.create_subscription
        listen(TFMessage, "/tf", lambda one: self._core.take_transforms(one, fixed=False), 100)
        listen(TFMessage, "/tf_static", lambda m: self._core.take_transforms(m, fixed=True), fixed)
        listen(KINDS[p.kind], p.topic, self._core.take_frame, sensor)
        if p.kind != "points":
            beside = topic_without_transport(p.topic).rpartition("/")[0] + "/camera_info"
            info = p.camera_info_topic or beside
            listen(CameraInfo, info, self._core.take_camera_info, sensor)
        if p.imu_topic:
            listen(Imu, p.imu_topic, self._core.take_imu, sensor)
        if p.odometry_topic:
            listen(Odometry, p.odometry_topic, self._core.take_odometry, sensor)

    # Publishers.

    def _tick(self) -> None:
        """Process frames, and publish the pose while it is known."""
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
                level=bytes([self._report.level]),
                name=f"{self.get_name()}: localisation",
                message=self._report.message,
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
        self._core.close()
        self._client.close()
        if self._log is not None:
            self._log.close()
        super().destroy_node()


def main(arguments: list[str] | None = None) -> int:
    """Run the node until it is stopped; return 2 if its parameters are not valid."""
    rclpy.init(args=arguments)
    try:
        node = RelocaliserNode()
    except SceneprintError as error:
        print(f"relocaliser: {error}", file=sys.stderr)
        rclpy.try_shutdown()
        return 2
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return 0
