"""Tests of the node with a stand-in for rclpy: topics, parameters and published messages.

The real rclpy is not tested here.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint_client.poses import rotation_of
from sceneprint_client.tracker import replay
from sceneprint_client.tracker_core import difference

SECOND = 1_000_000_000
DEPTH = "/camera/depth/image_raw"


def pose_of(message):
    place = getattr(message, "position", None) or message.translation
    turn = getattr(message, "orientation", None) or message.rotation
    T = np.eye(4)
    T[:3, 3] = place.x, place.y, place.z
    T[:3, :3] = rotation_of(np.array([turn.x, turn.y, turn.z, turn.w]))
    return T


def play(node, bus, arrived):
    """Give a node its messages; its timers run when a transform came, answers are waited for."""
    for topic, name, message in arrived:
        assert bus.kinds[topic] == name
        bus.callbacks[topic](message)
        if topic == "/tf":
            stamp = message.transforms[0].header.stamp
            bus.now_ns = stamp.sec * SECOND + stamp.nanosec
            tick, diagnose = (callback for _, callback in bus.timers)
            tick()
            assert node._core.wait(PATIENCE_S)
            tick()
            diagnose()


def started(node_module):
    node = node_module.RelocaliserNode()
    assert (node.trigger_configure(), node.trigger_activate()) == ("success", "success")
    return node


def test_a_node_on_a_drive(bus, node_module, drive, room, service_url, ros, tmp_path):
    bus.parameters = {
        "url": service_url, "map": "room", "topic": DEPTH, "map_frame": "world",
        "transform_tolerance_s": 0.25, "log_file": str(tmp_path / "drive.jsonl"),
    }  # fmt: skip
    node = started(node_module)
    assert bus.kinds == {
        "/tf": "tf2_msgs/msg/TFMessage", "/tf_static": "tf2_msgs/msg/TFMessage",
        DEPTH: "sensor_msgs/msg/Image",
        "/camera/depth/camera_info": "sensor_msgs/msg/CameraInfo",
    }  # fmt: skip
    arrived = drive(frames=6)
    play(node, bus, arrived)

    (fix,) = bus.on("/initialpose")
    poses = bus.on("~/pose")
    assert fix.header.frame_id == poses[0].header.frame_id == "world"
    np.testing.assert_array_equal(pose_of(fix.pose.pose), pose_of(poses[0].pose.pose))
    stamps = [ros.start + 0.5 * i for i in range(6)]
    for message in poses:
        i = stamps.index(message.header.stamp.sec + message.header.stamp.nanosec * 1e-9)
        truth = room[i].pose @ np.linalg.inv(ros.camera)
        assert difference(pose_of(message.pose.pose), truth)[0] < 0.08
        covariance = np.reshape(message.pose.covariance, (6, 6))
        assert (np.linalg.eigvalsh(covariance) > 0).all()
    assert len(poses) >= 4
    transforms = [transform for message in bus.on("/tf") for transform in message.transforms]
    T_odom_base = pose_of(arrived[-1][2].transforms[0].transform)
    last = transforms[-1]
    assert (last.header.frame_id, last.child_frame_id) == ("world", "odom")
    assert (last.header.stamp.sec, last.header.stamp.nanosec) == (ros.start + 2, 750_000_000)
    np.testing.assert_allclose(
        pose_of(last.transform) @ T_odom_base, pose_of(poses[-1].pose.pose), atol=1e-9
    )
    (status,) = bus.on("/diagnostics")[-1].status
    assert (status.level, status.hardware_id) == (0, DEPTH)
    assert status.message.startswith("tracking: ")
    values = {value.key: value.value for value in status.values}
    assert (values["map"], values["map_is"], values["frames"]) == ("room", "site", "6")
    assert bus.log[0].startswith("lost: ") or bus.log[0].startswith("tracking: ")

    response = bus.services["~/relocalise"](None, SimpleNamespace(success=False, message=""))
    assert response.success
    count = len(bus.published)
    bus.timers[0][1]()
    assert len(bus.published) == count  # nothing is told of a place that is forgotten
    node.destroy_node()
    with (tmp_path / "drive.jsonl").open() as log:
        states = list(replay(log))
    assert "tracking" in {state.status for state in states}
    assert states[-1].status == "lost"


def test_a_manager_starts_and_stops_a_node(bus, node_module, drive):
    """Topics exist from configuration to cleanup; frames count only while the node is active."""
    bus.parameters = {"map": "m", "topic": DEPTH, "autostart": False, "url": "http://127.0.0.1:9"}
    assert node_module.main() == 0
    assert (bus.callbacks, bus.log) == ({}, [])
    bus.parameters["map"] = ""
    node = node_module.RelocaliserNode()
    assert node.trigger_configure() == "failure"
    assert node.error.startswith("The parameters map = ''")
    bus.parameters["map"] = "m"
    assert node.trigger_configure() == "success"
    assert bus.qos[DEPTH] == bus.qos["/camera/depth/camera_info"] == "sensor"
    assert bus.qos["/tf_static"] == (100, "latched")
    (frame,) = [message for topic, _, message in drive(frames=1) if topic == DEPTH]
    tick, diagnose = (callback for _, callback in bus.timers)
    for is_active, count in ((False, "0"), (True, "1"), (False, "1")):
        if is_active:
            assert node.on_activate(None) == "success"
        elif count == "1":
            assert node.on_deactivate(None) == "success"
        bus.callbacks[DEPTH](frame)
        tick()
        diagnose()
        (status,) = bus.on("/diagnostics")[-1].status
        assert {value.key: value.value for value in status.values}["frames"] == count
        assert (status.message == "the node is not active") is not is_active
        assert status.level == (3 if is_active else 1)  # STALE, for no transform has arrived
    assert node.on_cleanup(None) == "success"
    assert (bus.callbacks, bus.publishers, bus.services, bus.timers) == ({}, [], {}, [])
    assert node.trigger_configure() == "success"
    assert bus.timers != []
    node.destroy_node()


@pytest.mark.parametrize(
    "wrong", [{"map": ""}, {"topic": ""}, {"kind": "colour"}, {"url": "no address"}]
)
def test_parameters_that_are_none_end_it(wrong, bus, node_module, capsys):
    bus.parameters = {"map": "m", "topic": DEPTH, **wrong}
    assert node_module.main() == 2
    output = capsys.readouterr().err
    assert output.startswith("relocaliser: ")
    assert output.count("\n") == 1
    assert not bus.is_up
