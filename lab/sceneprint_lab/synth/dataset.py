"""Synthetic sequences of depth frames and laser scans, with exact poses.

seed, index  --synthesise_room-->  SynthRoom: frames with poses
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sceneprint.types import Cloud, DepthFrame, Floats, Floats32, Intrinsics
from sceneprint_lab.synth.large_scenes import Premises, make_block, make_hall, make_storey
from sceneprint_lab.synth.mesh import SyntheticMesh
from sceneprint_lab.synth.rooms import Room, make_room
from sceneprint_lab.synth.sensors import (
    KINECT_V1,
    Caster,
    KinectNoise,
    Spinning,
    cast_depth,
    cast_faces,
    kinect_noise,
    own_scanner,
    scan,
)
from sceneprint_lab.synth.trajectories import scattered, scattered_poses, trajectory, walk

LEAST_VALID = 0.45  #: minimum share of valid pixels in an independent view

#: The camera of 7-Scenes.
KINECT = Intrinsics(640, 480, 585.0, 585.0, 320.0, 240.0)


@dataclass(frozen=True, eq=False)
class SynthRoom:
    """A synthetic sequence of a room.

    Parameters
    ----------
    name : name such as "room-000"
    seed, index : arguments from which the room was generated
    frames : frames with T_world_camera; depth has sensor noise and is in steps of a millimetre
    """

    name: str
    seed: int
    index: int
    frames: tuple[DepthFrame, ...]


def synthesise_room(
    seed: int, index: int, views: int, *, along_path: bool = False, step: int = 1,
    noise: KinectNoise | None = KINECT_V1, intrinsics: Intrinsics = KINECT,
) -> SynthRoom:  # fmt: skip
    """Generate a furnished room, and return depth frames rendered in it.

    The result depends only on the arguments, so rooms can be generated in any order and process.

    Parameters
    ----------
    seed, index : seed of the collection, and index of the room in it
    views : number of frames
    along_path : whether the frames follow a hand-held path; otherwise they are independent
    step : use every n-th frame along the path
    noise : sensor noise; None for ideal depth
    intrinsics : camera

    Raises
    ------
    MissingDependency : If Embree cannot be imported
    """
    room, rng = room_and_rng(seed, index)
    sensor = own_sensor(noise, intrinsics, rng) if noise else None

    def shots(poses: list[Floats]) -> list[tuple[Floats32, Floats]]:
        if sensor is None:
            return [(render(room, T, intrinsics), T) for T in poses]
        return [(take(room, T, intrinsics, rng, sensor), T) for T in poses]

    if along_path:
        images = shots(trajectory(room, views, rng)[::step])
    else:
        images, least = [], LEAST_VALID
        while len(images) < views:
            new = shots(scattered_poses(room, views - len(images), rng))
            images += [(depth, T) for depth, T in new if np.mean(depth > 0) >= least]
            least *= 0.98  # lower the limit, so that the loop ends
    name = f"room-{index:03d}"
    frames = (
        DepthFrame(depth, intrinsics, f"{name}/frame-{k:06d}", T)
        for k, (depth, T) in enumerate(images)
    )
    return SynthRoom(name, seed, index, tuple(frames))


def room_and_rng(seed: int, index: int) -> tuple[Room, np.random.Generator]:
    """Return room `index` of the collection `seed`, and the random generator to continue with."""
    rng = np.random.default_rng(np.random.SeedSequence((seed, index)))
    return make_room(rng), rng


def render(
    scene: Room | SyntheticMesh | Caster, T_world_camera: Floats, intrinsics: Intrinsics = KINECT
) -> Floats32:
    """Return ideal depth (H, W) float32, metres; 0 where a ray does not meet a surface."""
    return cast_depth(_caster(scene), T_world_camera, intrinsics)[0]


def take(
    scene: Room | SyntheticMesh | Caster, T_world_camera: Floats, intrinsics: Intrinsics,
    rng: np.random.Generator, noise: KinectNoise = KINECT_V1,
) -> Floats32:  # fmt: skip
    """Return Kinect depth (H, W) float32, metres in steps of a millimetre, 0 if missing."""
    caster = _caster(scene)
    depth, cosine, face = cast_faces(caster, T_world_camera, intrinsics)
    loss = np.append(caster.mesh.loss, np.float32(0))[face]
    noisy = kinect_noise(depth, cosine, intrinsics, rng, noise, loss)
    return np.asarray(np.round(noisy * 1000) / 1000, np.float32)


def _caster(scene: Room | SyntheticMesh | Caster) -> Caster:
    if isinstance(scene, Room):
        return scene.caster
    return Caster(scene) if isinstance(scene, SyntheticMesh) else scene


def own_sensor(noise: KinectNoise, intrinsics: Intrinsics, rng: np.random.Generator) -> KinectNoise:
    """Return a random variation of a sensor: its errors are scaled, and a border may be missing."""
    s = rng.uniform(0.8, 1.4)
    most = intrinsics.width // 18 if rng.random() < 0.4 else 0
    left, right, top, bottom = rng.integers(0, most + 1, 4).tolist()
    return replace(
        noise, disparity_sigma=noise.disparity_sigma * s, warp=noise.warp * s,
        border=(left, right, top, bottom),
    )  # fmt: skip


# Laser scans of a hall, a storey or a block.
#
# seed, index  --synthesise_survey-->  Survey: clouds with poses

LEAST_POINTS = 2000  #: minimum number of points of an independent scan, unless _TRIES tries fail
_TRIES = 5

_MAKERS = {"hall": make_hall, "storey": make_storey, "block": make_block}
#: Kinds of sites by index modulo 5.
_ORDER = ("hall", "storey", "hall", "block", "storey")


@dataclass(frozen=True, eq=False)
class Survey:
    """The scans of a synthetic site.

    Parameters
    ----------
    name : name such as "site-000"
    kind : "hall", "storey" or "block"
    sensor : scanner
    clouds : points in the sensor frame, with T_world_sensor
    """

    name: str
    kind: str
    sensor: Spinning
    clouds: tuple[Cloud, ...]


def synthesise_survey(
    seed: int, index: int, views: int, *, along_path: bool = False, kind: str | None = None,
    sensor: Spinning | None = None, perfect: bool = False,
) -> Survey:  # fmt: skip
    """Generate a site, and return scans of it.

    The result depends only on the arguments, so sites can be generated in any order and process.

    Parameters
    ----------
    seed, index : seed of the collection, and index of the site in it
    views : number of scans
    along_path : whether the scans follow a walk, 1.5 m apart; otherwise they are independent
    kind : "hall", "storey" or "block"; by default, the index selects it
    sensor : scanner; by default, each site has a random scanner
    perfect : whether to disable errors and losses of the scanner

    Raises
    ------
    MissingDependency : If Embree cannot be imported
    """
    premises, rng = premises_and_rng(seed, index, kind)
    drawn = own_scanner(rng)
    sensor = sensor or drawn
    if perfect:
        sensor = sensor.perfect()
    name, clouds = f"site-{index:03d}", []
    poses = walk(premises, views, rng) if along_path else scattered(premises, views, rng)
    for number, first in enumerate(poses):
        T, tries = first, 1
        points = scan(premises.caster, T, sensor, rng)
        while len(points) < LEAST_POINTS and tries < _TRIES and not along_path:
            T, tries = scattered(premises, 1, rng)[0], tries + 1
            points = scan(premises.caster, T, sensor, rng)
        clouds.append(Cloud(points, name=f"{name}/scan-{number:06d}", pose=T))
    return Survey(name, premises.kind, sensor, tuple(clouds))


def premises_and_rng(
    seed: int, index: int, kind: str | None = None
) -> tuple[Premises, np.random.Generator]:
    """Return site `index` of the collection `seed`, and the random generator to continue with."""
    rng = np.random.default_rng(np.random.SeedSequence((seed, index, 1)))
    return _MAKERS[kind or _ORDER[index % len(_ORDER)]](rng), rng
