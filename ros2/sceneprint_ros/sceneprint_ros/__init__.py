"""Nodes of ROS 2 over sceneprint_client."""
