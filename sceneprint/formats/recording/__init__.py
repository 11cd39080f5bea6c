"""Readers for ROS recordings: bags with depth or points, cameras and transforms.

path  --recording_sequences-->  FrameSequence, ...

Only `bag.py` imports rosbags, and only when a bag is opened.
"""

from sceneprint.formats.recording.bag import Bag, is_recording
from sceneprint.formats.recording.outline import BagOutline, bag_outline
from sceneprint.formats.recording.selection import (
    RecordingOptions,
    recording_name,
    recording_sequences,
)

__all__ = [
    "Bag",
    "BagOutline",
    "RecordingOptions",
    "bag_outline",
    "is_recording",
    "recording_name",
    "recording_sequences",
]
