"""Points as ROS 2 sends them: a serialised sensor_msgs/PointCloud2.

bytes  --read_pointcloud2-->  FilePoints
"""

from __future__ import annotations

from sceneprint.formats.points.float_rows import FilePoints
from sceneprint_client.files import read_point_cloud
from sceneprint_client.ros_messages import cloud_blocks, cloud_table


def read_pointcloud2(data: bytes) -> FilePoints:
    """The points of a serialised PointCloud2, those exactly at the sensor missing.

    Raises
    ------
    UnreadableCloud : the bytes are no such message or damaged, it has no x, y and z, or its sizes
        contradict each other.
    """
    table = cloud_table(read_point_cloud(data))
    return FilePoints(table.size, cloud_blocks(table))
