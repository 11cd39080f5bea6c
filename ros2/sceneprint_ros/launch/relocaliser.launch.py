"""Launch file of the node: ros2 launch sceneprint_ros relocaliser.launch.py params_file:=...

With `sensor:=realsense` and the like, it also starts the driver of the sensor, and the node reads
the topics of this driver; `driver:=false` leaves the driver out.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, OpaqueFunction
from launch.conditions import IfCondition
from launch.launch_description_sources import AnyLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare


class Sensor(NamedTuple):
    """Topics of a sensor, and the launch file of its driver with its arguments."""

    topic: str
    imu_topic: str
    package: str
    file: str
    arguments: Mapping[str, str] = MappingProxyType({})
    kind: str = "depth"


#: As in docs/sensors.
SENSORS = {
    "azure_kinect": Sensor(
        "/depth/image_raw", "/imu", "azure_kinect_ros_driver", "driver.launch.py",
        {"depth_mode": "NFOV_UNBINNED", "fps": "15"},
    ),
    "hesai": Sensor("/lidar_points", "", "hesai_ros_driver", "start.py", kind="points"),
    "livox": Sensor(
        "/livox/lidar", "", "livox_ros_driver2", "rviz_MID360_launch.py", kind="points"
    ),
    "oak": Sensor(
        "/oak/stereo/image_raw", "/oak/imu/data", "depthai_ros_driver", "camera.launch.py"
    ),
    "orbbec": Sensor(
        "/camera/depth/image_raw", "/camera/gyro_accel/sample", "orbbec_camera",
        "gemini_330_series.launch.py",
        {"depth_registration": "false", "enable_accel": "true", "enable_gyro": "true",
         "enable_sync_output_accel_gyro": "true"},
    ),
    "ouster": Sensor(
        "/ouster/points", "/ouster/imu", "ouster_ros", "sensor.launch.xml",
        {"timestamp_mode": "TIME_FROM_ROS_TIME", "viz": "false"}, "points",
    ),
    "realsense": Sensor(
        "/camera/camera/depth/image_rect_raw", "/camera/camera/imu", "realsense2_camera",
        "rs_launch.py",
        {"enable_gyro": "true", "enable_accel": "true", "unite_imu_method": "2"},
    ),
    "velodyne": Sensor(
        "/velodyne_points", "", "velodyne", "velodyne-all-nodes-VLP16-launch.py", kind="points"
    ),
    "zed": Sensor(
        "/zed/zed_node/depth/depth_registered", "/zed/zed_node/imu/data", "zed_wrapper",
        "zed_camera.launch.py", {"camera_model": "zed2i"},
    ),
}  # fmt: skip


def _nodes(context: LaunchContext) -> list[Any]:
    """Return the node, and with a sensor its driver."""
    name = LaunchConfiguration("sensor").perform(context)
    parameters: dict[str, Any] = {"use_sim_time": LaunchConfiguration("use_sim_time")}
    actions: list[Any] = []
    if name:
        sensor, driver = SENSORS[name], IfCondition(LaunchConfiguration("driver"))
        parameters |= {"topic": sensor.topic, "kind": sensor.kind, "imu_topic": sensor.imu_topic}
        file = PathJoinSubstitution([FindPackageShare(sensor.package), "launch", sensor.file])
        source = AnyLaunchDescriptionSource(file)
        arguments = sensor.arguments.items()
        actions.append(
            IncludeLaunchDescription(source, launch_arguments=arguments, condition=driver)
        )
    node = Node(
        package="sceneprint_ros",
        executable="relocaliser",
        name="relocaliser",
        output="screen",
        parameters=[LaunchConfiguration("params_file"), parameters],
    )
    return [*actions, node]


def generate_launch_description() -> LaunchDescription:
    """Return the launch description of the node with its parameter file and its sensor."""
    own = PathJoinSubstitution([FindPackageShare("sceneprint_ros"), "config", "relocaliser.yaml"])
    return LaunchDescription(
        [
            DeclareLaunchArgument("params_file", default_value=own),
            DeclareLaunchArgument("use_sim_time", default_value="false"),
            DeclareLaunchArgument("sensor", default_value="", choices=["", *SENSORS]),
            DeclareLaunchArgument("driver", default_value="true"),
            OpaqueFunction(function=_nodes),
        ]
    )
