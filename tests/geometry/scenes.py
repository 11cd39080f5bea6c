"""Exact scenes: planes in a pinhole camera, and sets of patches."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from sceneprint.geometry.rigid import transform_points
from sceneprint.pipeline import geometry_of
from sceneprint.signing import see
from sceneprint.types import DepthFrame, Intrinsics, Patches, Surface
from sceneprint_lab.synth import KINECT, take, trajectory
from sceneprint_lab.synth.dataset import room_and_rng

#: Camera with the field of view of a Kinect and a quarter of the pixels.
CAMERA = Intrinsics(80, 60, 73.0, 73.0, 39.5, 29.5)


def rays(camera):
    """Return directions (h, w, 3) with z = 1, by the pinhole equation."""
    y, x = np.mgrid[: camera.height, : camera.width]
    return np.dstack(
        [(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x, float)]
    )


def plane(camera, normal, point):
    """Return 1 / z of the plane through `point`, 0 where it is not in front of the camera."""
    q = rays(camera) @ normal / float(np.dot(normal, point))
    return np.maximum(q, 0.0)


def unit(*v):
    return np.array(v) / np.linalg.norm(v)


def degrees_between(a, b):
    """Return the angle of unit vectors in degrees, more accurate than arccos at small angles."""
    return np.degrees(2 * np.arcsin(np.linalg.norm(a - b, axis=-1).clip(0, 2) / 2))


def corner(camera=CAMERA):
    """Return an exact corner of a room, seen from inside, and the plane of each pixel."""
    axes = Rotation.from_euler("xyz", [32, -40, 8], degrees=True).as_matrix().T
    apex = np.array([0.1, 0.0, 2.5])
    # Every wall faces the sensor, so its normal points against the ray to the corner.
    normals = np.array([-np.sign(a[2]) * a for a in axes])
    q = np.array([plane(camera, n, apex) for n in normals])
    seen = q.argmax(axis=0)
    return lifted(camera, q.max(axis=0), normals[seen]), seen


def lifted(camera, q, normals):
    """Return the surface with exact inverse depths and normals; 0 is missing."""
    valid = q > 0
    z = np.where(valid, 1 / np.where(valid, q, 1.0), 0.0)
    points = rays(camera) * z[..., None]
    # The area is the solid angle 1 / (fx fy |ray|^3) times range^2 over the cosine of incidence:
    # z^2 / (fx fy |ray| cosine), whose last two factors are -n . ray.
    lean = -(normals * rays(camera)).sum(axis=2)
    areas = np.where(valid, z**2 / (camera.fx * camera.fy * np.where(valid, lean, 1.0)), 0.0)
    return Surface(
        points.astype(np.float32),
        np.where(valid[..., None], normals, 0.0).astype(np.float32),
        valid,
        areas.astype(np.float32),
        camera,
    )


def rigid(rng, metres, degrees=None):
    """Return a random transform (4, 4); without `degrees` all rotations are equally likely."""
    if degrees is None:
        turn = Rotation.random(rng=rng)
    else:
        turn = Rotation.from_rotvec(rng.normal(0, np.radians(degrees), 3))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turn.as_matrix(), rng.normal(0, metres, 3)
    return T


def patches_of(means, normals, areas=None):
    """Return patches of 20 samples each, by default of area 1."""
    n = len(means)
    return Patches(
        np.array(means, float).reshape(n, 3), np.array(normals, float).reshape(n, 3),
        np.ones(n) if areas is None else areas, np.full(n, 20, np.int32), np.ones(n),
    )  # fmt: skip


def carried(patches, T):
    """Return patches in the coordinates to which T takes theirs."""
    means = transform_points(T, patches.means)
    return replace(patches, means=means, normals=patches.normals @ T[:3, :3].T)


def furnished(model, number, stop=60):
    """Return (pose, geometry) of views of a furnished room, a fifth of its path apart."""
    room, rng = room_and_rng(11, number)
    poses = trajectory(room, 61, rng)[12:stop:12]
    frames = [DepthFrame(take(room, T, KINECT, rng), KINECT) for T in poses]
    views = [geometry_of(see(frame, model.parameters), model) for frame in frames]
    return list(zip(poses, views, strict=True))


def random_patches(rng, n, extent=2.0):
    normals = rng.normal(size=(n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return patches_of(rng.uniform(-extent, extent, (n, 3)), normals, rng.uniform(0.01, 0.1, n))


def room(rng, n=110):
    """Return patches on the walls of a room and of boxes in it, with normals off by 2 degrees."""
    size = np.array([rng.uniform(2.5, 6), rng.uniform(2.5, 6), 2.5])
    boxes = [(np.zeros(3), size, -1.0)]
    for _ in range(rng.integers(1, 4)):
        extent = rng.uniform(0.3, 1.5, 3)
        boxes.append((rng.uniform(0, 1, 3) * (size - extent), extent, 1.0))
    means, normals = [], []
    for k in range(n):
        low, extent, outwards = boxes[k % len(boxes)]
        axis, side = rng.integers(3), rng.integers(2)
        point = rng.uniform(0, 1, 3)
        point[axis] = side
        normal = rng.normal(0, 0.035, 3)
        normal[axis] += outwards * (2 * side - 1)
        means.append(low + point * extent)
        normals.append(normal / np.linalg.norm(normal))
    return patches_of(means, normals)
