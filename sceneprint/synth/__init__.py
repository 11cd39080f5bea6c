"""Synthetic depth frames of furnished rooms, with exact poses: seed to frames.

    seed, index  --synthesise_room-->  frames

Nothing here reads or writes files.
"""

from sceneprint.synth.noise import KINECT_V1, KinectNoise, kinect_noise
from sceneprint.synth.paths import trajectory
from sceneprint.synth.poses import scattered_poses
from sceneprint.synth.rays import Caster, cast_depth
from sceneprint.synth.rooms import Room, make_room
from sceneprint.synth.scenes import corridor, symmetric_box
from sceneprint.synth.synthesis import KINECT, SynthRoom, render, synthesise_room, take

__all__ = [
    "KINECT",
    "KINECT_V1",
    "Caster",
    "KinectNoise",
    "Room",
    "SynthRoom",
    "cast_depth",
    "corridor",
    "kinect_noise",
    "make_room",
    "render",
    "scattered_poses",
    "symmetric_box",
    "synthesise_room",
    "take",
    "trajectory",
]
