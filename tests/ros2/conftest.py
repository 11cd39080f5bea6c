"""Fixtures of the node tests: a drive as topics, a service with its map, and a stand-in for rclpy.

rosbags creates, serialises and reads the messages.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sceneprint.formats.dataset import decode_png, find_sequences
from sceneprint_client import Client
from sceneprint_client.frame_files import meta_of

PACKAGE = Path(__file__).resolve().parents[2] / "ros2" / "sceneprint_ros"
#: Number of frames, of which every second is in the map, and interval of frames, seconds.
FRAMES, STEP_S = 12, 0.5
#: Origin of the odometry in the map, which the odometry does not know.
T_MAP_ODOM = np.array([[0.0, -1, 0, 2], [1, 0, 0, -3], [0, 0, 1, 0], [0, 0, 0, 1]])

#: A topic, a type, and a message.
Arrived = tuple[str, str, Any]


@pytest.fixture(scope="session")
def room(building):
    (sequence,) = find_sequences(building / "room-0" / "seq-01")
    return sequence.frames[:FRAMES]


@pytest.fixture(scope="session")
def service_url(service_url, room):
    with Client(service_url) as client:
        client.create_map("room", model="depth")
        added = [
            client.upload("room", view, meta_of(view, session="s", parent_frame="site"))
            for view in room[::2]
        ]
        client.wait([frame.job_id for frame in added])
    return service_url


@pytest.fixture(scope="session")
def drive(room, ros):
    """A function that returns the messages of a drive through the room, with a frame every 0.5 s.

    `kind` is the encoding of depth, and `turn` a delay of all messages, seconds.
    """

    def carried(kind="depth", *, later=0.0, frames=FRAMES):
        writer = ros.messages()
        writer.transforms(0.0, {("base_link", "camera"): ros.camera}, "/tf_static")
        for i, view in enumerate(room[:frames]):
            t = later + STEP_S * i
            k = view.camera.intrinsics
            T_odom_base = np.linalg.inv(T_MAP_ODOM) @ view.pose @ np.linalg.inv(ros.camera)
            samples = decode_png(view.read_bytes())
            writer.camera_info(t, k=(k.fx, k.fy, k.cx, k.cy), size=(k.width, k.height))
            send(writer, kind, t, samples, k)  # odometry of the same time follows
            writer.transforms(t, {("odom", "base_link"): T_odom_base})
        return list(writer.written)

    return carried


def send(writer, kind, t, samples, k):
    if kind == "depth":
        writer.image(t, samples)
    else:
        v, u = np.mgrid[0 : k.height : 2, 0 : k.width : 2]
        z = np.where(samples[v, u] > 0, samples[v, u] / 1000.0, np.nan)
        points = np.zeros(z.shape, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")])
        points["x"], points["y"], points["z"] = (u - k.cx) / k.fx * z, (v - k.cy) / k.fy * z, z
        writer.points(t, points.reshape(-1), frame="camera", height=len(points))


def message_class(writer, name):
    """Return a class for messages like rclpy's, with named fields and zero defaults."""

    def make(**fields):
        return writer.make(name, **fields)

    make.ros_name = name
    return make


# The part of rclpy that our node uses.


@dataclass
class Bus:
    parameters: dict[str, Any] = field(default_factory=dict)
    now_ns: int = 0
    callbacks: dict[str, Callable[[Any], None]] = field(default_factory=dict)
    kinds: dict[str, str] = field(default_factory=dict)
    qos: dict[str, object] = field(default_factory=dict)
    publishers: list[object] = field(default_factory=list)
    declared: dict[str, Any] = field(default_factory=dict)
    services: dict[str, Callable[[Any, Any], Any]] = field(default_factory=dict)
    timers: list[tuple[float, Callable[[], None]]] = field(default_factory=list)
    published: list[Arrived] = field(default_factory=list)
    log: list[str] = field(default_factory=list)
    is_up: bool = False

    def on(self, topic):
        return [message for name, _, message in self.published if name == topic]


class StubNode:
    """Stand-in for rclpy.lifecycle.LifecycleNode that serialises published messages."""

    bus: Bus
    types: Any

    def __init__(self, name):
        self.name = name

    def get_name(self):
        return self.name

    def declare_parameter(self, name, default, descriptor):
        self.bus.declared[name] = default

    def get_parameter(self, name):
        default = self.bus.declared[name]
        value = self.bus.parameters.get(name, default)
        assert type(value) is type(default), name  # rclpy checks this too
        return SimpleNamespace(value=value)

    def trigger_configure(self):
        return self.on_configure(None)

    def trigger_activate(self):
        return self.on_activate(None)

    def create_subscription(self, kind, topic, callback, qos, *, raw=False):
        def serialized(message):
            callback(bytes(self.types.serialize_cdr(message, kind.ros_name)))

        self.bus.callbacks[topic] = serialized if raw else callback
        self.bus.kinds[topic] = kind.ros_name
        self.bus.qos[topic] = qos
        return topic

    def destroy_subscription(self, topic):
        del self.bus.callbacks[topic]

    def destroy_publisher(self, publisher):
        self.bus.publishers.remove(publisher)

    def destroy_service(self, name):
        del self.bus.services[name]

    def destroy_timer(self, timer):
        self.bus.timers.remove(timer)

    def create_publisher(self, kind, topic, qos):
        def publish(message):
            data = self.types.serialize_cdr(plain(message), kind.ros_name)
            read = self.types.deserialize_cdr(data, kind.ros_name)
            self.bus.published.append((topic, kind.ros_name, read))

        publisher = SimpleNamespace(publish=publish)
        self.bus.publishers.append(publisher)
        return publisher

    def create_service(self, kind, name, callback):
        self.bus.services[name] = callback
        return name

    def create_timer(self, period_s, callback):
        self.bus.timers.append((period_s, callback))
        return self.bus.timers[-1]

    def get_clock(self):
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=self.bus.now_ns))

    def get_logger(self):
        return SimpleNamespace(info=self.bus.log.append, error=self.bus.log.append)

    def destroy_node(self):
        self.bus.is_up = False


def plain(message):
    """Return a message for rosbags, which uses numbers for rclpy's bytes of length 1."""
    if hasattr(message, "level"):
        assert isinstance(message.level, bytes)
        assert len(message.level) == 1
        message.level = message.level[0]
    for one in getattr(message, "status", ()):
        plain(one)
    return message


@pytest.fixture
def bus(ros, monkeypatch):
    """A bus on which `start_node` runs a node with stand-in modules."""
    result = Bus()
    writer = ros.messages()

    def module(name, **names):
        one = ModuleType(name)
        vars(one).update(names)
        monkeypatch.setitem(sys.modules, name, one)

    kind = type("LifecycleNode", (StubNode,), {"bus": result, "types": writer.types})
    stopped = type("ExternalShutdownException", (Exception,), {})
    module(
        "rclpy",
        init=lambda args=None: setattr(result, "is_up", True),
        spin=lambda node: [callback() for _, callback in result.timers[:1]],
        try_shutdown=lambda: setattr(result, "is_up", False),
    )
    outcomes = SimpleNamespace(SUCCESS="success", FAILURE="failure")
    module("rclpy.lifecycle", LifecycleNode=kind, TransitionCallbackReturn=outcomes)
    module("rcl_interfaces")
    module("rcl_interfaces.msg", ParameterDescriptor=SimpleNamespace)
    module("rclpy.executors", ExternalShutdownException=stopped)
    module(
        "rclpy.qos", qos_profile_sensor_data="sensor",
        DurabilityPolicy=SimpleNamespace(TRANSIENT_LOCAL="latched"),
        QoSProfile=lambda depth, durability: (depth, durability),
    )  # fmt: skip
    module("std_srvs")
    module("std_srvs.srv", Trigger=SimpleNamespace(ros_name="std_srvs/srv/Trigger"))
    for package, names in {
        "diagnostic_msgs": ("DiagnosticArray", "DiagnosticStatus", "KeyValue"),
        "livox_ros_driver2": ("CustomMsg",),
        "geometry_msgs": ("PoseWithCovarianceStamped", "TransformStamped"),
        "nav_msgs": ("Odometry",),
        "sensor_msgs": ("CameraInfo", "CompressedImage", "Image", "Imu", "PointCloud2"),
        "tf2_msgs": ("TFMessage",),
    }.items():
        module(package)
        made_of = {name: message_class(writer, f"{package}/msg/{name}") for name in names}
        module(f"{package}.msg", **made_of)
    monkeypatch.syspath_prepend(str(PACKAGE))
    for name in ("sceneprint_ros", "sceneprint_ros.relocaliser_node"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return result


@pytest.fixture
def node_module(bus, monkeypatch):
    yield import_module("sceneprint_ros.relocaliser_node")
    for name in ("sceneprint_ros", "sceneprint_ros.relocaliser_node"):
        sys.modules.pop(name, None)
