"""From a seed to depth frames with exact poses.

seed, index  --synthesise_room-->  SynthRoom: frames with poses
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sceneprint.synth.mesh import Mesh
from sceneprint.synth.noise import KINECT_V1, KinectNoise, kinect_noise
from sceneprint.synth.paths import trajectory
from sceneprint.synth.poses import scattered_poses
from sceneprint.synth.rays import Caster, cast_depth, cast_faces
from sceneprint.synth.rooms import Room, make_room
from sceneprint.types import Floats, Floats32, Frame, Intrinsics

LEAST_VALID = 0.45  #: share of a scattered view that has depth; others are taken again

#: the camera of 7-Scenes
KINECT = Intrinsics(640, 480, 585.0, 585.0, 320.0, 240.0)


@dataclass(frozen=True, eq=False)
class SynthRoom:
    """One synthetic sequence.

    Parameters
    ----------
    name : "room-000" and so on
    seed, index : what it was made from
    frames : depth in whole millimetres where noisy; pose is T_world_camera
    """

    name: str
    seed: int
    index: int
    frames: tuple[Frame, ...]


def synthesise_room(
    seed: int,
    index: int,
    views: int,
    *,
    along_path: bool = False,
    noise: KinectNoise | None = KINECT_V1,
    intrinsics: Intrinsics = KINECT,
) -> SynthRoom:
    """Furnish a room and take depth frames in it.

    The outcome depends on the arguments only, so rooms can be made in any order and in
    any process.

    Parameters
    ----------
    seed, index : the room is number `index` of the collection `seed`
    views : how many frames
    along_path : whether the frames follow one hand-held path; else they are independent
    noise : the sensor; None gives ideal depth
    intrinsics : the camera

    Raises
    ------
    MissingDependency : Embree cannot be imported.
    """
    room, rng = room_and_rng(seed, index)
    sensor = own_sensor(noise, intrinsics, rng) if noise else None

    def shots(poses: list[Floats]) -> list[tuple[Floats32, Floats]]:
        if sensor is None:
            return [(render(room, T, intrinsics), T) for T in poses]
        return [(take(room, T, intrinsics, rng, sensor), T) for T in poses]

    if along_path:
        taken = shots(trajectory(room, views, rng))
    else:
        taken, least = [], LEAST_VALID
        while len(taken) < views:
            new = shots(scattered_poses(room, views - len(taken), rng))
            taken += [(depth, T) for depth, T in new if np.mean(depth > 0) >= least]
            least *= 0.98  # never for ever
    name = f"room-{index:03d}"
    frames = (
        Frame(depth, intrinsics, f"{name}/frame-{k:06d}", T) for k, (depth, T) in enumerate(taken)
    )
    return SynthRoom(name, seed, index, tuple(frames))


def room_and_rng(seed: int, index: int) -> tuple[Room, np.random.Generator]:
    """Room number `index` of collection `seed`, and the generator as it stands after it."""
    rng = np.random.default_rng(np.random.SeedSequence((seed, index)))
    return make_room(rng), rng


def render(
    scene: Room | Mesh | Caster, T_world_camera: Floats, intrinsics: Intrinsics = KINECT
) -> Floats32:
    """(H, W) float32 ideal depth in metres, 0 where nothing is met."""
    return cast_depth(_caster(scene), T_world_camera, intrinsics)[0]


def take(
    scene: Room | Mesh | Caster,
    T_world_camera: Floats,
    intrinsics: Intrinsics,
    rng: np.random.Generator,
    noise: KinectNoise = KINECT_V1,
) -> Floats32:
    """(H, W) float32 depth as a Kinect gives it: whole millimetres, in metres, 0 missing."""
    caster = _caster(scene)
    depth, cosine, face = cast_faces(caster, T_world_camera, intrinsics)
    loss = np.append(caster.mesh.loss, np.float32(0))[face]
    noisy = kinect_noise(depth, cosine, intrinsics, rng, noise, loss)
    return np.asarray(np.round(noisy * 1000) / 1000, np.float32)


def _caster(scene: Room | Mesh | Caster) -> Caster:
    if isinstance(scene, Room):
        return scene.caster
    return Caster(scene) if isinstance(scene, Mesh) else scene


def own_sensor(noise: KinectNoise, intrinsics: Intrinsics, rng: np.random.Generator) -> KinectNoise:
    """The sensor of one room: no two are quite equal."""
    s = rng.uniform(0.8, 1.4)
    most = intrinsics.width // 18 if rng.random() < 0.4 else 0
    left, right, top, bottom = rng.integers(0, most + 1, 4).tolist()
    return replace(
        noise,
        disparity_sigma=noise.disparity_sigma * s,
        warp=noise.warp * s,
        border=(left, right, top, bottom),
    )
