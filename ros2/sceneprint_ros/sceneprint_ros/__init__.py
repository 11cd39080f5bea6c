"""ROS 2 nodes on top of sceneprint_client."""
