"""Ray casting, and models of a Kinect v1 and of laser scanners.

    depth (H, W), cosine (H, W)  --kinect_noise-->  depth (H, W), 0 missing

A Kinect measures the disparity d = f b / z of a projected pattern. Errors and steps are uniform in
disparity, so they grow with z^2 in depth. Samples are missing in the projector's shadow, at grazing
incidence and on surfaces that do not reflect.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, special

from sceneprint.errors import MissingDependency
from sceneprint.types import Floats, Floats32, Intrinsics, Ints32
from sceneprint_lab.synth.mesh import SyntheticMesh

# Ray casting from a mesh and a camera to a depth image.
#
#     SyntheticMesh, T_world_camera (4, 4), Intrinsics  --cast_depth-->  depth, cosine (H, W)
#
# Embree builds the tree over the triangles once per mesh, in `Caster`.


@dataclass(frozen=True, eq=False)
class RayHits:
    """The first hits of rays.

    Parameters
    ----------
    distance : (R,) float32, in lengths of the ray's direction; inf without a hit
    face : (R,) int32, index of the face; -1 for a miss
    normal : (R, 3) float32, outward unit normals of the faces; 0 for a miss
    """

    distance: Floats32
    face: Ints32
    normal: Floats32


class Caster:
    """A ray caster for a mesh; creation raises MissingDependency if Embree cannot be imported."""

    def __init__(self, mesh: SyntheticMesh) -> None:
        self.mesh = mesh
        self._scene = _embree_scene(mesh)
        v = mesh.vertices.astype(np.float32)
        a, b, c = (v[mesh.faces[:, k]] for k in range(3))
        normals = np.cross(b - a, c - a)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
        self._normals = np.concatenate([normals, np.zeros((1, 3))]).astype(np.float32)

    def cast(self, origins: Floats32, directions: Floats32) -> RayHits:
        """Return the first hit of each ray.

        `origins`, `directions`: (R, 3) float32, metres; directions may have any length.
        """
        hits = self._scene.run(
            np.ascontiguousarray(origins, np.float32),
            np.ascontiguousarray(directions, np.float32),
            output=True,
        )
        face = np.asarray(hits["primID"], np.int32)
        distance = np.where(face >= 0, hits["tfar"], np.float32(np.inf)).astype(np.float32)
        return RayHits(distance, face, self._normals[face])  # face -1 selects the zero row


def cast_depth(
    caster: Caster, T_world_camera: Floats, intrinsics: Intrinsics
) -> tuple[Floats32, Floats32]:
    """Return an ideal depth image, and the cosine of incidence of each sample.

    Parameters
    ----------
    caster : scene, metres
    T_world_camera : (4, 4) pose of the optical frame
    intrinsics : camera without distortion

    Returns
    -------
    depth : (H, W) float32, metres along the optical axis; 0 for a miss
    cosine : (H, W) float32, |cos| between ray and normal, [0, 1]; 0 for a miss

    Raises
    ------
    MissingDependency : If Embree cannot be imported
    """
    depth, cosine, _ = cast_faces(caster, T_world_camera, intrinsics)
    return depth, cosine


def cast_faces(
    caster: Caster, T_world_camera: Floats, intrinsics: Intrinsics
) -> tuple[Floats32, Floats32, Ints32]:
    """Return the result of `cast_depth`, and the indices of the faces (H, W), -1 for a miss."""
    shape = (intrinsics.height, intrinsics.width)
    rays = pixel_rays(intrinsics) @ T_world_camera[:3, :3].T.astype(np.float32)
    origins = np.broadcast_to(T_world_camera[:3, 3].astype(np.float32), rays.shape)
    hits = caster.cast(origins, rays)
    # Ray directions have z = 1 in the camera's frame, so the distance of a hit is its depth.
    depth = np.where(hits.face >= 0, hits.distance, np.float32(0))
    cosine = np.abs(np.einsum("ij,ij->i", rays, hits.normal))
    cosine /= np.sqrt(np.einsum("ij,ij->i", rays, rays))
    return depth.reshape(shape), cosine.reshape(shape), hits.face.reshape(shape)


def pixel_rays(intrinsics: Intrinsics) -> Floats32:
    """Return ray directions (H W, 3) float32 through the pixel centres, row by row, with z = 1."""
    x = (np.arange(intrinsics.width) - intrinsics.cx) / intrinsics.fx
    y = (np.arange(intrinsics.height) - intrinsics.cy) / intrinsics.fy
    rays = np.ones((intrinsics.height, intrinsics.width, 3), np.float32)
    rays[..., 0] = x
    rays[..., 1] = y[:, None]
    return rays.reshape(-1, 3)


def _embree_scene(mesh: SyntheticMesh) -> Any:
    try:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene
    except ImportError as error:
        raise MissingDependency(
            "Synthetic scenes are ray-traced with Embree, but the package embreex cannot be "
            f"imported ({error}). Install it: pip install 'embreex>=4.4,<5' (x86_64 only)."
        ) from error
    scene = EmbreeScene()
    TriangleMesh(scene, mesh.vertices.astype(np.float32), np.ascontiguousarray(mesh.faces))
    return scene


@dataclass(frozen=True)
class KinectNoise:
    """Parameters of a Kinect; "m" are metres, "px" are pixels of the image."""

    baseline: float = 0.075  #: m; distance from camera to projector, which is on the right
    disparity_sigma: float = 0.052  #: px; gives depth steps of 1.5 mm at 1 m, 13 mm at 3 m
    correlation: float = 2.2  #: px; standard deviation of the blur of the disparity error
    warp: float = 0.06  #: px; disparity error that is smooth over the image
    disparity_step: float = 0.125  #: px; resolution of disparity
    edge_jitter: float = 0.9  #: px; displacement of samples, which makes edges ragged
    edge_block: int = 3  #: px; size of blocks that are displaced together
    shadow_margin: float = 0.5  #: px; smallest disparity difference that casts a shadow
    shadow_growth: int = 3  #: px; width of the window that smears shadows
    grazing_start: float = math.radians(71.0)  #: rad; incidence from which samples are lost
    grazing_end: float = math.radians(84.0)  #: rad; incidence from which all samples are lost
    speckle: float = 0.0008  #: share of samples that are lost anywhere, in patches
    patch: float = 7.0  #: px; size of lost patches
    border: tuple[int, int, int, int] = (0, 0, 0, 0)  #: px; missing at left, right, top, bottom
    nearest: float = 0.45  #: m; smallest measured depth
    farthest: float = 8.0  #: m; greatest measured depth


#: The sensor of 7-Scenes and TUM RGB-D.
KINECT_V1 = KinectNoise()


def kinect_noise(
    depth: Floats32, cosine: Floats32, intrinsics: Intrinsics, rng: np.random.Generator,
    parameters: KinectNoise = KINECT_V1, loss: Floats32 | None = None,
) -> Floats32:  # fmt: skip
    """Return a depth image with the noise and losses of a Kinect v1.

    Parameters
    ----------
    depth : (H, W) ideal depth, metres, 0 if missing
    cosine : (H, W) |cos| of incidence, [0, 1]
    intrinsics : camera
    rng : source of all noise
    parameters : parameters of the noise
    loss : (H, W) share of samples that are lost on the visible surface, [0, 1]; None stands for 0

    Returns
    -------
    depth : (H, W) float32, metres, 0 if missing
    """
    p = parameters
    rows, columns = _displaced_pixels(depth, rng, p)
    z, cos = depth[rows, columns], cosine[rows, columns]
    measured = (z >= p.nearest) & (z <= p.farthest) & _inside_border(depth.shape, p)
    gain = np.float32(intrinsics.fx * p.baseline)
    disparity = np.divide(gain, np.where(measured, z, 1), dtype=np.float32)
    measured &= ~_shadow_mask(depth, gain, p)[rows, columns]
    lost = _loss_probability(cos, None if loss is None else loss[rows, columns], p)
    # A threshold on a smooth field groups losses into patches.
    hole = _field(depth.shape, p.patch, rng) * np.float32(0.9)
    hole += np.float32(math.sqrt(1 - 0.81)) * rng.standard_normal(depth.shape, np.float32)
    measured &= hole > special.ndtri(lost)
    disparity += np.float32(p.disparity_sigma) * _field(depth.shape, p.correlation, rng)
    disparity += np.float32(p.warp) * _field(depth.shape, 80.0, rng)
    step = np.float32(p.disparity_step)
    z = np.divide(gain, np.maximum(np.round(disparity / step) * step, step), dtype=np.float32)
    measured &= (z >= p.nearest) & (z <= p.farthest)
    return np.where(measured, z, np.float32(0))


def _displaced_pixels(
    depth: Floats32, rng: np.random.Generator, p: KinectNoise
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return rows and columns (H, W) of samples; blocks near depth edges are displaced."""
    height, width = depth.shape
    small = (-(-height // p.edge_block), -(-width // p.edge_block))
    stray = np.round(rng.normal(0, p.edge_jitter, (2, *small))).astype(np.intp)
    stray = stray.repeat(p.edge_block, axis=1).repeat(p.edge_block, axis=2)[:, :height, :width]
    rows, columns = np.arange(height)[:, None], np.arange(width)
    other_rows = np.clip(stray[0] + rows, 0, height - 1)
    other_columns = np.clip(stray[1] + columns, 0, width - 1)
    edge = np.abs(depth[other_rows, other_columns] - depth) > 0.02 * depth
    return np.where(edge, other_rows, rows), np.where(edge, other_columns, columns)


def _inside_border(shape: tuple[int, ...], p: KinectNoise) -> NDArray[np.bool_]:
    """Return a mask (H, W) of the pixels inside the border."""
    left, right, top, bottom = p.border
    within = np.zeros(shape, bool)
    within[top : shape[0] - bottom, left : shape[1] - right] = True
    return within


def _shadow_mask(depth: Floats32, gain: np.float32, p: KinectNoise) -> NDArray[np.bool_]:
    """Return a mask (H, W) of samples in the shadow of the projector, which is on the right.

    A sample in column u is lit by column u - d of the projector. If two samples need the same
    column of the projector, the farther one, with the smaller u, is in the shadow.
    """
    far = np.where(depth > 0, depth, np.float32(1e3))
    column = np.arange(depth.shape[1], dtype=np.float32) - gain / far
    nearest = np.minimum.accumulate(column[:, ::-1], axis=1)[:, ::-1]
    dark = column > nearest + np.float32(p.shadow_margin)
    return ndimage.maximum_filter1d(dark, p.shadow_growth, axis=1)


def _loss_probability(cosine: Floats32, loss: Floats32 | None, p: KinectNoise) -> Floats32:
    """Return the probability (H, W) of losing a sample that is not in a shadow or the border."""
    steep = (math.cos(p.grazing_start) - cosine) / (
        math.cos(p.grazing_start) - math.cos(p.grazing_end)
    )
    valid = (1 - np.float32(p.speckle)) * (1 - np.clip(steep, 0, 1, dtype=np.float32))
    if loss is not None:
        valid *= 1 - loss
    return np.asarray(1 - valid, np.float32)


def _field(shape: tuple[int, ...], size: float, rng: np.random.Generator) -> Floats32:
    """Return normal noise (H, W) of unit variance with a correlation length of `size` pixels.

    Coarse noise is generated on a coarse grid and enlarged, at a tenth of the cost of a blur.
    """
    step = max(1, int(size / 1.5))
    small = (shape[0] // step + 4, shape[1] // step + 4)
    noise = rng.standard_normal(small, np.float32)
    noise = ndimage.gaussian_filter(noise, size / step, mode="wrap")
    if step > 1:
        noise = _enlarge(noise, step)
    noise = noise[: shape[0], : shape[1]]
    # After a Gaussian blur, white noise has the standard deviation 1 / (2 sqrt(pi) sigma).
    return np.asarray(noise * np.float32(2 * math.sqrt(math.pi) * size / step), np.float32)


def _enlarge(coarse: Floats32, step: int) -> Floats32:
    """Interpolate linearly: return `step` samples for each coarse sample."""
    share = (np.arange(step, dtype=np.float32) / step)[:, None]
    rows = coarse[:-1, None] * (1 - share) + coarse[1:, None] * share
    rows = rows.reshape(-1, coarse.shape[1])
    share = share[:, 0]
    full = rows[:, :-1, None] * (1 - share) + rows[:, 1:, None] * share
    return np.asarray(full.reshape(len(rows), -1), np.float32)


# Laser scanners: from a mesh and a pose to a cloud.
#
# Caster, T_world_sensor (4, 4), Scanner, rng  --scan-->  points (N, 3) in the sensor's frame


@dataclass(frozen=True)
class Spinning:
    """A scanner that rotates about its z axis, and its errors.

    Parameters
    ----------
    rings : number of lasers, one above the other
    lowest, highest : elevation of the first and of the last laser, rad
    azimuth_step : angle between two firings, rad
    minimum, maximum : range limits, metres
    sigma : standard deviation of a range, metres
    ring_sigma : standard deviation of the offset of all ranges of a ring, metres
    loss : share of returns that are lost at random
    grazing : cosine of incidence at which half of the returns at the maximum range are lost
    blind_middle, blind_width : centre and width of the azimuths that the carrier hides, rad
    blind_below : elevation below which the carrier hides these azimuths, rad
    """

    rings: int = 64
    lowest: float = math.radians(-22.5)
    highest: float = math.radians(22.5)
    azimuth_step: float = math.radians(0.35)
    minimum: float = 0.5
    maximum: float = 80.0
    sigma: float = 0.02
    ring_sigma: float = 0.005
    loss: float = 0.01
    grazing: float = 0.1
    blind_middle: float = math.pi
    blind_width: float = math.radians(60.0)
    blind_below: float = math.radians(-5.0)

    @property
    def elevations(self) -> Floats:
        """Return the elevations (rings,), rad, in increasing order."""
        return np.linspace(self.lowest, self.highest, self.rings)

    @property
    def azimuths(self) -> Floats32:
        """Return the azimuths (firings,), rad, from -pi."""
        n = round(2 * math.pi / self.azimuth_step)
        return (np.arange(n) * (2 * math.pi / n) - math.pi).astype(np.float32)

    def rays(self, rng: np.random.Generator) -> Floats32:  # noqa: ARG002
        """Return unit directions (rings x firings, 3), ring by ring, the same for every scan."""
        azimuth, elevation = self.azimuths, self.elevations.astype(np.float32)[:, None]
        c = np.cos(elevation)
        rays = np.empty((self.rings, len(azimuth), 3), np.float32)
        rays[..., 0] = c * np.cos(azimuth)
        rays[..., 1] = c * np.sin(azimuth)
        rays[..., 2] = np.sin(elevation)
        return rays.reshape(-1, 3)

    def offsets(self, rng: np.random.Generator) -> Floats32:
        """Return range errors (rings x firings,), metres; each ring has a common error."""
        own = rng.normal(0, self.ring_sigma, self.rings).astype(np.float32)
        return np.repeat(own, len(self.azimuths))

    def hidden(self) -> NDArray[np.bool_]:
        """Return a mask (rings x firings,) of the rays that the carrier blocks."""
        away = np.abs((self.azimuths - self.blind_middle + math.pi) % (2 * math.pi) - math.pi)
        below = (self.elevations < self.blind_below)[:, None]
        return np.asarray(((away < self.blind_width / 2) & below).ravel())

    def perfect(self) -> Spinning:
        """Return the same scanner without errors, losses and blind angles."""
        return replace(self, sigma=0.0, ring_sigma=0.0, loss=0.0, grazing=0.0, blind_width=0.0)


@dataclass(frozen=True)
class Rosette:
    """A scanner with a narrow view about its x axis and a non-repeating pattern.

    Two prisms of equal deflection rotate at different speeds in the beams of a few lasers, as in a
    Livox Avia (70 degrees, about 24,000 firings in 0.1 s). Each scan starts with the prisms at
    random angles.

    Parameters
    ----------
    half_angle : half the apex angle of the cone that the centres of the beams fill, rad
    firings : number of firings in a scan
    turns : number of turns of the first prism and of the second prism in a scan
    lasers : number of lasers, one above the other
    laser_step : angle between two lasers, rad
    """

    half_angle: float = math.radians(35.0)
    firings: int = 24_000
    turns: tuple[float, float] = (12.16, -7.77)
    lasers: int = 6
    laser_step: float = math.radians(0.8)
    minimum: float = 0.5
    maximum: float = 80.0
    sigma: float = 0.02
    loss: float = 0.01
    grazing: float = 0.1

    def rays(self, rng: np.random.Generator) -> Floats32:
        """Return unit directions (firings, 3) in chronological order; they differ in every scan."""
        start = rng.uniform(-math.pi, math.pi, 2)
        turned = np.arange(self.firings)[:, None] / self.firings * (2 * math.pi) * self.turns
        waves: NDArray[np.complex128] = np.exp(1j * (turned + start))
        bent = self.half_angle / 2 * waves.sum(axis=1)
        laser = np.arange(self.firings) % self.lasers
        bent += 1j * self.laser_step * (laser - (self.lasers - 1) / 2)
        angle, around = np.abs(bent), np.angle(bent)
        across = np.sin(angle)
        rays = [np.cos(angle), across * np.cos(around), across * np.sin(around)]
        return np.stack(rays, axis=1).astype(np.float32)

    def offsets(self, rng: np.random.Generator) -> Floats32:  # noqa: ARG002
        """Return zeros (firings,), since ranges have no common error."""
        return np.zeros(self.firings, np.float32)

    def hidden(self) -> NDArray[np.bool_]:
        """Return a mask (firings,) of False, since the carrier blocks no ray."""
        return np.zeros(self.firings, np.bool_)

    def perfect(self) -> Rosette:
        """Return the same scanner without errors and losses."""
        return replace(self, sigma=0.0, loss=0.0, grazing=0.0)


Scanner = Spinning | Rosette


def own_scanner(rng: np.random.Generator) -> Spinning:
    """Return a random realistic scanner with 16 to 128 rings."""
    rings = int(rng.choice((16, 32, 64, 64, 96, 128)))
    low, high = np.radians(rng.uniform((-45.0, 8.0), (-14.0, 45.0)))
    if rings < 64:  # a sensor with few rings has a narrow vertical field of view
        low, high = max(low, -rings * 0.018), min(high, rings * 0.018)
    # Scanners with many rings have larger azimuth steps, so that they return a similar number of
    # points.
    step = math.radians(rng.uniform(0.18, 0.4)) * (1.0 if rings <= 64 else 1.6)
    return Spinning(
        rings=rings, lowest=float(low), highest=float(high), azimuth_step=step,
        minimum=float(rng.uniform(0.4, 1.2)), maximum=float(rng.uniform(45.0, 100.0)),
        sigma=float(rng.uniform(0.01, 0.03)), ring_sigma=float(rng.uniform(0.0, 0.015)),
        loss=float(rng.uniform(0.0, 0.05)), grazing=float(rng.uniform(0.03, 0.2)),
        blind_middle=float(rng.uniform(-math.pi, math.pi)),
        blind_width=float(rng.choice((0.0, rng.uniform(0.2, 1.8)))),
        blind_below=float(rng.uniform(-0.3, 0.6)),
    )  # fmt: skip


def own_rosette(rng: np.random.Generator) -> Rosette:
    """Return a scanner with a view of 60 to 80 degrees and 8,000 to 24,000 firings."""
    return Rosette(
        half_angle=float(np.radians(rng.uniform(30.0, 40.0))),
        firings=int(rng.integers(8_000, 24_001)), minimum=float(rng.uniform(0.4, 1.2)),
        maximum=float(rng.uniform(60.0, 120.0)), sigma=float(rng.uniform(0.01, 0.03)),
        loss=float(rng.uniform(0.0, 0.05)), grazing=float(rng.uniform(0.03, 0.2)),
    )  # fmt: skip


def scan(
    caster: Caster, T_world_sensor: Floats, sensor: Scanner, rng: np.random.Generator
) -> Floats32:
    """Scan a scene with a scanner at rest.

    Parameters
    ----------
    caster : scene, metres
    T_world_sensor : (4, 4) pose
    rng : generator of noise and losses, and of the directions of a Rosette

    Returns
    -------
    points : (N, 3) float32 returns, metres, in the sensor frame and in the order of the sensor's
        rays
    """
    rays = sensor.rays(rng)
    turned = rays @ T_world_sensor[:3, :3].T.astype(np.float32)
    origins = np.broadcast_to(T_world_sensor[:3, 3].astype(np.float32), turned.shape)
    hits = caster.cast(origins, turned)
    distance = hits.distance
    cosine = np.abs(np.einsum("ij,ij->i", turned, hits.normal))
    # The probability of losing a return grows with range and with the angle of incidence.
    far = np.minimum(distance / np.float32(sensor.maximum), 1.0)
    held = 1 - 0.5 ** (cosine / (sensor.grazing * far + 1e-6))
    held *= (1 - sensor.loss) * (1 - np.append(caster.mesh.loss, np.float32(0))[hits.face])
    noise = rng.normal(0, sensor.sigma, len(rays)).astype(np.float32)
    measured = distance + noise + sensor.offsets(rng)
    valid = (hits.face >= 0) & (rng.random(len(rays)) < held)
    valid &= (measured >= sensor.minimum) & (measured <= sensor.maximum)
    valid &= ~sensor.hidden()
    return np.asarray(rays[valid] * measured[valid, None], np.float32)
