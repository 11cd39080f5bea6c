"""Launch file of the node: ros2 launch sceneprint_ros relocaliser.launch.py params_file:=..."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """Return the launch description of the node with its parameter file."""
    own = PathJoinSubstitution([FindPackageShare("sceneprint_ros"), "config", "relocaliser.yaml"])
    return LaunchDescription(
        [
            DeclareLaunchArgument("params_file", default_value=own),
            DeclareLaunchArgument("use_sim_time", default_value="false"),
            Node(
                package="sceneprint_ros",
                executable="relocaliser",
                name="relocaliser",
                output="screen",
                parameters=[
                    LaunchConfiguration("params_file"),
                    {"use_sim_time": LaunchConfiguration("use_sim_time")},
                ],
            ),
        ]
    )
