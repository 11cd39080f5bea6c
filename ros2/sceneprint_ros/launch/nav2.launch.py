"""Launch file of Nav2 with the relocaliser: ros2 launch sceneprint_ros nav2.launch.py map:=...

With `amcl:=true`, AMCL localises and the relocaliser publishes its initial pose; otherwise the
relocaliser publishes map -> odom.
"""

from launch import Condition, LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.conditions import IfCondition, UnlessCondition
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, NotSubstitution, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def _nav2(name: str, **more: object) -> IncludeLaunchDescription:
    """Return the action that includes a launch file of nav2_bringup."""
    file = PathJoinSubstitution([FindPackageShare("nav2_bringup"), "launch", name])
    return IncludeLaunchDescription(PythonLaunchDescriptionSource(file), **more)


def _manager(
    name: str, sim: LaunchConfiguration, condition: Condition | None = None, **more: object
) -> Node:
    """Return a lifecycle manager that starts one node."""
    values = {"use_sim_time": sim, "autostart": True, "node_names": [name], **more}
    return Node(
        package="nav2_lifecycle_manager",
        executable="lifecycle_manager",
        name=f"lifecycle_manager_{name}",
        output="screen",
        parameters=[values],
        condition=condition,
    )


def generate_launch_description() -> LaunchDescription:
    """Return the launch description of Nav2 and the relocaliser; only one publishes map -> odom."""
    own = PathJoinSubstitution([FindPackageShare("sceneprint_ros"), "config", "relocaliser.yaml"])
    amcl, sim = LaunchConfiguration("amcl"), LaunchConfiguration("use_sim_time")
    nav2 = {"use_sim_time": sim, "params_file": LaunchConfiguration("nav2_params_file")}
    nav2_own = PathJoinSubstitution(
        [FindPackageShare("nav2_bringup"), "params", "nav2_params.yaml"]
    )
    yaml = LaunchConfiguration("map")
    return LaunchDescription(
        [
            DeclareLaunchArgument("map", description="YAML file of a map for nav2_map_server"),
            DeclareLaunchArgument("params_file", default_value=own),
            DeclareLaunchArgument("nav2_params_file", default_value=nav2_own),
            DeclareLaunchArgument("use_sim_time", default_value="false"),
            DeclareLaunchArgument("amcl", default_value="false"),
            Node(
                package="sceneprint_ros",
                executable="relocaliser",
                name="relocaliser",
                output="screen",
                parameters=[
                    LaunchConfiguration("params_file"),
                    {
                        "use_sim_time": sim,
                        "publish_tf": ParameterValue(NotSubstitution(amcl), value_type=bool),
                        "autostart": False,
                    },
                ],
            ),
            # Nodes of rclpy do not send the manager a heartbeat.
            _manager("relocaliser", sim, bond_timeout=0.0),
            _nav2(
                "localization_launch.py",
                launch_arguments={**nav2, "map": yaml}.items(),
                condition=IfCondition(amcl),
            ),
            Node(
                package="nav2_map_server",
                executable="map_server",
                name="map_server",
                output="screen",
                parameters=[{"yaml_filename": yaml, "use_sim_time": sim}],
                condition=UnlessCondition(amcl),
            ),
            _manager("map_server", sim, UnlessCondition(amcl)),
            _nav2("navigation_launch.py", launch_arguments=nav2.items()),
        ]
    )
