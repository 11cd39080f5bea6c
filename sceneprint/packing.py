"""Surfaces as 16-bit numbers, and back: what geometry artifacts hold of what a sensor saw.

    Surface  --pack_*-->  (h, w, 3) or (N, 5) uint16        --unpack_*-->  Surface

A pinhole's pixels are inverse depths (its steps are far below a sensor's noise), a sphere's are
ranges, points in no order are offsets in a cube. A normal is 2 x 16 bits on an octahedron. Steps
of range and offset are powers of two, so that to pack again what was unpacked changes nothing.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.framing import directions
from sceneprint.geometry.kernel import kernel
from sceneprint.geometry.projecting import camera_of
from sceneprint.types import Floats, Floats32, Intrinsics, Sphere, Surface

Packed = NDArray[np.uint16]
MOST = 65535
#: Least share of its largest coordinate that a step of 32 bits can tell.
_TOLD = 2.0**-22


@kernel
def _to_octahedron(nx: float, ny: float, nz: float) -> tuple[int, int]:
    total = abs(nx) + abs(ny) + abs(nz)
    u, v = nx / total, ny / total
    if nz > 0:  # normals face a depth sensor, -z: that half is the middle of the square
        u, v = (
            (1.0 - abs(v)) * (1.0 if u >= 0 else -1.0),
            (1.0 - abs(u)) * (1.0 if v >= 0 else -1.0),
        )
    return round((u * 0.5 + 0.5) * 65535.0), round((v * 0.5 + 0.5) * 65535.0)


@kernel
def _of_octahedron(a: int, b: int) -> tuple[float, float, float]:
    u, v = a / 65535.0 * 2.0 - 1.0, b / 65535.0 * 2.0 - 1.0
    nz = -(1.0 - abs(u) - abs(v))
    if nz > 0:
        u, v = (
            (1.0 - abs(v)) * (1.0 if u >= 0 else -1.0),
            (1.0 - abs(u)) * (1.0 if v >= 0 else -1.0),
        )
    length = np.sqrt(u * u + v * v + nz * nz)
    return u / length, v / length, nz / length


@kernel
def _pack_image(
    points: Floats32, normals: Floats32, pinhole: bool, scale: float, out: Packed
) -> None:
    """Inverse depth or range, and normal, of every pixel; 0 where not valid: out (h, w, 3)."""
    height, width = points.shape[0], points.shape[1]
    for y in range(height):
        for x in range(width):
            z = float(points[y, x, 2])
            if pinhole:
                if z <= 0:
                    continue
                out[y, x, 0] = np.uint16(max(round(1.0 / (z * scale)), 1.0))
            else:
                a, b = float(points[y, x, 0]), float(points[y, x, 1])
                away = np.sqrt(a * a + b * b + z * z)
                if away <= 0:
                    continue
                out[y, x, 0] = np.uint16(min(max(round(away / scale), 1.0), 65535.0))
            u, v = _to_octahedron(
                float(normals[y, x, 0]), float(normals[y, x, 1]), float(normals[y, x, 2])
            )
            out[y, x, 1] = np.uint16(u)
            out[y, x, 2] = np.uint16(v)


@kernel
def _unpack_pinhole(
    packed: Packed, scale: float, camera: Floats, points: Floats32,
    normals: Floats32, areas: Floats32, valid: NDArray[np.bool_],
) -> None:  # fmt: skip
    height, width = packed.shape[0], packed.shape[1]
    fx, fy, cx, cy = camera[2], camera[3], camera[4], camera[5]
    for y in range(height):
        yn = (y - cy) / fy
        for x in range(width):
            if packed[y, x, 0] == 0:
                continue
            xn = (x - cx) / fx
            z = 1.0 / (packed[y, x, 0] * scale)
            u, v, nz = _of_octahedron(packed[y, x, 1], packed[y, x, 2])
            points[y, x, 0], points[y, x, 1], points[y, x, 2] = xn * z, yn * z, z
            normals[y, x, 0], normals[y, x, 1], normals[y, x, 2] = u, v, nz
            ray = np.sqrt(xn * xn + yn * yn + 1.0)
            cosine = -(xn * u + yn * v + nz) / ray
            areas[y, x] = z * z / (fx * fy * ray * max(cosine, 1e-3))
            valid[y, x] = True


@kernel
def _unpack_sphere(
    packed: Packed, scale: float, rays: Floats, solid: Floats, points: Floats32,
    normals: Floats32, areas: Floats32, valid: NDArray[np.bool_],
) -> None:  # fmt: skip
    height, width = packed.shape[0], packed.shape[1]
    for y in range(height):
        for x in range(width):
            if packed[y, x, 0] == 0:
                continue
            away = packed[y, x, 0] * scale
            a, b, c = rays[y, x, 0], rays[y, x, 1], rays[y, x, 2]
            nx, ny, nz = _of_octahedron(packed[y, x, 1], packed[y, x, 2])
            points[y, x, 0], points[y, x, 1], points[y, x, 2] = a * away, b * away, c * away
            normals[y, x, 0], normals[y, x, 1], normals[y, x, 2] = nx, ny, nz
            cosine = -(a * nx + b * ny + c * nz)
            areas[y, x] = away * away * solid[y] / max(cosine, 1e-3)
            valid[y, x] = True


@kernel
def _pack_normals(normals: Floats32, out: Packed) -> None:
    for n in range(len(normals)):
        u, v = _to_octahedron(float(normals[n, 0]), float(normals[n, 1]), float(normals[n, 2]))
        out[n, 0] = np.uint16(u)
        out[n, 1] = np.uint16(v)


@kernel
def _unpack_normals(packed: Packed, out: Floats32) -> None:
    for n in range(len(packed)):
        nx, ny, nz = _of_octahedron(packed[n, 0], packed[n, 1])
        out[n, 0], out[n, 1], out[n, 2] = nx, ny, nz


def _step(span: float) -> float:
    """The power of two of which 65535 reach as far, but for what rounding may have added."""
    return 2.0 ** math.ceil(math.log2(span / MOST) - 1e-4) if span > 0 else 1.0


def pack_image(surface: Surface) -> tuple[Packed, float]:
    """Pixels (h, w, 3) of a surface that a camera saw; and the inverse depth of 1 (of a pinhole),
    or the range of 1 (of a sphere).
    """
    pinhole = isinstance(surface.camera, Intrinsics)
    if pinhole:
        z = surface.points[..., 2][surface.valid]
        scale = 1.0 / (float(z.min()) * MOST) if z.size else 1.0
    else:
        seen = surface.points[surface.valid].astype(float)
        scale = _step(float(np.linalg.norm(seen, axis=1).max(initial=0.0)))
    packed = np.zeros((*surface.valid.shape, 3), np.uint16)
    _pack_image(surface.points, surface.normals, pinhole, scale, packed)
    return packed, scale


def unpack_image(packed: Packed, scale: float, camera: Intrinsics | Sphere) -> Surface:
    """The surface of `pack_image`."""
    shape = (camera.height, camera.width)
    points, normals = np.zeros((*shape, 3), np.float32), np.zeros((*shape, 3), np.float32)
    areas, valid = np.zeros(shape, np.float32), np.zeros(shape, np.bool_)
    if isinstance(camera, Intrinsics):
        of = camera_of(camera, 0.0)
        _unpack_pinhole(packed, scale, of, points, normals, areas, valid)
    else:
        elevation = camera.top - camera.step * np.arange(camera.height)
        solid = camera.step**2 * np.maximum(np.cos(elevation), 0.0)
        _unpack_sphere(packed, scale, directions(camera), solid, points, normals, areas, valid)
    return Surface(points, normals, valid, areas, camera)


def pack_points(surface: Surface) -> tuple[Packed, Floats, float]:
    """Points in no order as (N, 5): offsets and normal; the corner they are from, and a step."""
    points, normals = surface.points[surface.valid], surface.normals[surface.valid]
    packed = np.zeros((len(points), 5), np.uint16)
    if not len(points):
        return packed, np.zeros(3), 1.0
    corner = points.min(axis=0).astype(float)
    span = float(np.ptp(points.astype(float), axis=0).max())
    step = _step(max(span, float(np.abs(points).max()) * _TOLD * MOST))
    offsets = np.rint((points - corner) / step)
    packed[:, :3] = np.clip(offsets, 0, MOST).astype(np.uint16)
    _pack_normals(normals, packed[:, 3:])
    return packed, corner, step


def unpack_points(packed: Packed, corner: Floats, step: float) -> Surface:
    """The surface of `pack_points`, a map of one row without areas."""
    points = (packed[:, :3] * step + corner).astype(np.float32)
    normals = np.zeros((len(packed), 3), np.float32)
    _unpack_normals(packed[:, 3:], normals)
    shape = (1, len(packed))
    return Surface(
        points[None], normals[None], np.ones(shape, np.bool_), np.zeros(shape, np.float32), None
    )
