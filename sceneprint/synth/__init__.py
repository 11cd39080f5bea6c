"""Synthetic depth frames of furnished rooms and laser scans of large sites, with exact poses.

    seed, index  --synthesise_room-->  frames        seed, index  --synthesise_survey-->  clouds

Nothing here reads or writes files.
"""

from sceneprint.synth.noise import KINECT_V1, KinectNoise, kinect_noise
from sceneprint.synth.paths import trajectory
from sceneprint.synth.poses import scattered_poses
from sceneprint.synth.rays import Caster, cast_depth
from sceneprint.synth.rooms import Room, make_room
from sceneprint.synth.scenes import corridor, symmetric_box
from sceneprint.synth.spinning import Spinning, scan
from sceneprint.synth.surveys import Survey, synthesise_survey
from sceneprint.synth.synthesis import KINECT, SynthRoom, render, synthesise_room, take

__all__ = [
    "KINECT",
    "KINECT_V1",
    "Caster",
    "KinectNoise",
    "Room",
    "Spinning",
    "Survey",
    "SynthRoom",
    "cast_depth",
    "corridor",
    "kinect_noise",
    "make_room",
    "render",
    "scan",
    "scattered_poses",
    "symmetric_box",
    "synthesise_room",
    "synthesise_survey",
    "take",
    "trajectory",
]
