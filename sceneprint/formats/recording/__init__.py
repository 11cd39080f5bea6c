"""Readers for ROS recordings: bags with depth or points, cameras and transforms.

Only `bag.py` imports rosbags, and only when a bag is opened.
"""
