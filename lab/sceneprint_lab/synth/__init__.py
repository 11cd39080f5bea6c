"""Synthetic depth frames of furnished rooms, and laser scans of large sites, with exact poses.

    seed, index  --synthesise_room-->  frames        seed, index  --synthesise_survey-->  clouds
    kind, seed, index  --synthesise_lookalike-->  frames of a map, and queries
    kind, seed, index  --synthesise_lookalike_survey-->  clouds of a map, and queries

This package does not read or write files.
"""

from sceneprint_lab.synth.dataset import (
    KINECT,
    Survey,
    SynthRoom,
    render,
    synthesise_room,
    synthesise_survey,
    take,
)
from sceneprint_lab.synth.large_scenes import corridor, symmetric_box
from sceneprint_lab.synth.lookalike_surveys import synthesise_lookalike_survey
from sceneprint_lab.synth.lookalikes import LookalikeSite, synthesise_lookalike
from sceneprint_lab.synth.rooms import Room, make_room
from sceneprint_lab.synth.sensors import (
    KINECT_V1,
    Caster,
    KinectNoise,
    Spinning,
    cast_depth,
    kinect_noise,
    scan,
)
from sceneprint_lab.synth.trajectories import scattered_poses, trajectory

__all__ = [
    "KINECT", "KINECT_V1", "Caster", "KinectNoise", "LookalikeSite", "Room", "Spinning", "Survey",
    "SynthRoom", "cast_depth", "corridor", "kinect_noise", "make_room", "render", "scan",
    "scattered_poses", "symmetric_box", "synthesise_lookalike", "synthesise_lookalike_survey",
    "synthesise_room", "synthesise_survey", "take", "trajectory",
]  # fmt: skip
