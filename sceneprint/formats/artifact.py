"""Geometry artifacts: an observed surface, quantised to 16 bits, with its patches.

    Surface  --pack_image | pack_points-->  (h, w, 3) or (N, 5) uint16
    uint16  --unpack_image | unpack_points-->  Surface

A pixel of a pinhole camera stores an inverse depth, in steps far below a sensor's noise. A pixel of
a sphere stores a range, and an unordered point stores an offset in a cube. A normal takes 2 x 16
bits on an octahedron, or 2 x 8 in scans with spread points. Steps of ranges and offsets are powers
of two, so packing an unpacked surface reproduces the same bytes.
"""

from __future__ import annotations

import math
import struct
from dataclasses import replace
from typing import Any, NoReturn

import numpy as np
from isal.isal_zlib import crc32
from numpy.typing import NDArray

from sceneprint.errors import InvalidIntrinsics, UnreadableGeometry
from sceneprint.geometry.kernel import disjoint_kernel, kernel
from sceneprint.geometry.registration.overlap import thin_points
from sceneprint.geometry.surface.range_image import SPREAD_POINTS, directions
from sceneprint.types import (
    Bytes,
    Floats,
    Floats32,
    Geometry,
    Intrinsics,
    Patches,
    Sphere,
    Surface,
    camera_of,
)

Packed = NDArray[np.uint16]
MOST = 65535
#: Smallest step, relative to the largest coordinate, that float32 resolves.
_RESOLUTION = 2.0**-22


@kernel
def _to_octahedron(nx: float, ny: float, nz: float, most: float) -> tuple[int, int]:
    total = abs(nx) + abs(ny) + abs(nz)
    u, v = nx / total, ny / total
    if nz > 0:  # normals that face the sensor (-z) lie in the middle of the square
        u, v = (
            (1.0 - abs(v)) * (1.0 if u >= 0 else -1.0),
            (1.0 - abs(u)) * (1.0 if v >= 0 else -1.0),
        )
    a, b = round((u * 0.5 + 0.5) * most), round((v * 0.5 + 0.5) * most)
    # two positions on the edge of the square denote the same direction; select the larger
    # coordinate
    a_on_edge, b_on_edge = a == 0 or a == most, b == 0 or b == most
    if a_on_edge:
        b = max(b, int(most) - b)
    if b_on_edge:
        a = max(a, int(most) - a)
    return a, b


@kernel
def _from_octahedron(a: int, b: int, most: float) -> tuple[float, float, float]:
    u, v = a / most * 2.0 - 1.0, b / most * 2.0 - 1.0
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
    points: Floats32, normals: Floats32, pinhole: bool, scale: float, most: float, out: Packed
) -> None:
    """Write inverse depth or range, and the normal, of each valid pixel to out (h, w, 3)."""
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
                float(normals[y, x, 0]), float(normals[y, x, 1]), float(normals[y, x, 2]), most
            )
            out[y, x, 1] = np.uint16(u)
            out[y, x, 2] = np.uint16(v)


@disjoint_kernel
def _unpack_line(
    inverse: Floats, across: Floats, down: Floats, most: float, xn: Floats, yn: float, area: float,
    out: Floats,
) -> None:  # fmt: skip
    """Write the points, normals and areas of a row of pixels to `out` (7, w).

    Invalid pixels are computed too, so that the compiler can vectorise the loop.
    """
    px, py, pz, nx, ny, nz, areas = out[0], out[1], out[2], out[3], out[4], out[5], out[6]
    for x in range(len(inverse)):
        z = 1.0 / inverse[x]
        u, v = across[x] / most * 2.0 - 1.0, down[x] / most * 2.0 - 1.0
        facing = -(1.0 - abs(u) - abs(v))
        folded_u = (1.0 - abs(v)) * (1.0 if u >= 0 else -1.0)
        folded_v = (1.0 - abs(u)) * (1.0 if v >= 0 else -1.0)
        u, v = (folded_u if facing > 0 else u), (folded_v if facing > 0 else v)
        length = np.sqrt(u * u + v * v + facing * facing)
        u, v, facing = u / length, v / length, facing / length
        px[x], py[x], pz[x] = xn[x] * z, yn * z, z
        nx[x], ny[x], nz[x] = u, v, facing
        ray = np.sqrt(xn[x] * xn[x] + yn * yn + 1.0)
        cosine = -(xn[x] * u + yn * v + facing) / ray
        areas[x] = z * z / (area * ray * max(cosine, 1e-3))


@kernel
def _unpack_pinhole(
    packed: Packed, scale: float, most: float, camera: Floats, points: Floats32,
    normals: Floats32, areas: Floats32, valid: NDArray[np.bool_],
) -> None:  # fmt: skip
    height, width = packed.shape[0], packed.shape[1]
    fx, fy, cx, cy = camera[2], camera[3], camera[4], camera[5]
    xn, line, out = (np.arange(width) - cx) / fx, np.empty((3, width)), np.empty((7, width))
    for y in range(height):
        for x in range(width):
            for k in range(3):
                line[k, x] = packed[y, x, k]
            line[0, x] = line[0, x] * scale if packed[y, x, 0] > 0 else 1.0
        _unpack_line(line[0], line[1], line[2], most, xn, (y - cy) / fy, fx * fy, out)
        for x in range(width):
            if packed[y, x, 0] == 0:
                continue
            for k in range(3):
                points[y, x, k], normals[y, x, k] = out[k, x], out[3 + k, x]
            areas[y, x] = out[6, x]
            valid[y, x] = True


@kernel
def _unpack_sphere(
    packed: Packed, scale: float, most: float, rays: Floats, solid: Floats, points: Floats32,
    normals: Floats32, areas: Floats32, valid: NDArray[np.bool_],
) -> None:  # fmt: skip
    height, width = packed.shape[0], packed.shape[1]
    for y in range(height):
        for x in range(width):
            if packed[y, x, 0] == 0:
                continue
            away = packed[y, x, 0] * scale
            a, b, c = rays[y, x, 0], rays[y, x, 1], rays[y, x, 2]
            nx, ny, nz = _from_octahedron(packed[y, x, 1], packed[y, x, 2], most)
            points[y, x, 0], points[y, x, 1], points[y, x, 2] = a * away, b * away, c * away
            normals[y, x, 0], normals[y, x, 1], normals[y, x, 2] = nx, ny, nz
            cosine = -(a * nx + b * ny + c * nz)
            areas[y, x] = away * away * solid[y] / max(cosine, 1e-3)
            valid[y, x] = True


@kernel
def _pack_normals(normals: Floats32, most: float, out: Packed) -> None:
    for n in range(len(normals)):
        u, v = _to_octahedron(
            float(normals[n, 0]), float(normals[n, 1]), float(normals[n, 2]), most
        )
        out[n, 0] = np.uint16(u)
        out[n, 1] = np.uint16(v)


@kernel
def _unpack_normals(packed: Packed, most: float, out: Floats32) -> None:
    for n in range(len(packed)):
        nx, ny, nz = _from_octahedron(packed[n, 0], packed[n, 1], most)
        out[n, 0], out[n, 1], out[n, 2] = nx, ny, nz


def _step(span: float) -> float:
    """Return the smallest power of two such that 65535 steps cover `span`, within rounding."""
    return 2.0 ** math.ceil(math.log2(span / MOST) - 1e-4) if span > 0 else 1.0


def pack_image(surface: Surface, most: int = MOST) -> tuple[Packed, float]:
    """Pack the surface that a camera observed.

    Returns
    -------
    packed : (h, w, 3) uint16: inverse depth or range; and a normal as two numbers from 0 to `most`
    scale : inverse depth (pinhole, 1/m) or range (sphere, m) that the number 1 represents
    """
    pinhole = isinstance(surface.camera, Intrinsics)
    if pinhole:
        z = surface.points[..., 2][surface.valid]
        scale = 1.0 / (float(z.min()) * MOST) if z.size else 1.0
    else:
        points = surface.points[surface.valid].astype(float)
        scale = _step(float(np.linalg.norm(points, axis=1).max(initial=0.0)))
    packed = np.zeros((*surface.valid.shape, 3), np.uint16)
    _pack_image(surface.points, surface.normals, pinhole, scale, float(most), packed)
    return packed, scale


def unpack_image(
    packed: Packed, scale: float, camera: Intrinsics | Sphere, most: int = MOST
) -> Surface:
    """Return the surface that `pack_image` packed; areas are computed again.

    Parameters
    ----------
    packed : (h, w, 3) uint16; pixels whose first number is 0 are invalid
    scale : result of `pack_image`
    most : maximum value of a packed normal, as passed to `pack_image`
    """
    shape = (camera.height, camera.width)
    points, normals = np.zeros((*shape, 3), np.float32), np.zeros((*shape, 3), np.float32)
    areas, valid = np.zeros(shape, np.float32), np.zeros(shape, np.bool_)
    if isinstance(camera, Intrinsics):
        of = camera_of(camera, 0.0)
        _unpack_pinhole(packed, scale, float(most), of, points, normals, areas, valid)
    else:
        elevation = camera.top - camera.step * np.arange(camera.height)
        solid = camera.step**2 * np.maximum(np.cos(elevation), 0.0)
        rays = directions(camera)
        _unpack_sphere(packed, scale, float(most), rays, solid, points, normals, areas, valid)
    return Surface(points, normals, valid, areas, camera)


def pack_points(surface: Surface, most: int = MOST) -> tuple[Packed, Floats, float]:
    """Pack unordered points: return offsets and normals (N, 5), corner (3,) and step, metres."""
    points, normals = surface.points[surface.valid], surface.normals[surface.valid]
    packed = np.zeros((len(points), 5), np.uint16)
    if not len(points):
        return packed, np.zeros(3), 1.0
    corner = points.min(axis=0).astype(float)
    span = float(np.ptp(points.astype(float), axis=0).max())
    step = _step(max(span, float(np.abs(points).max()) * _RESOLUTION * MOST))
    offsets = np.rint((points - corner) / step)
    packed[:, :3] = np.clip(offsets, 0, MOST).astype(np.uint16)
    _pack_normals(normals, float(most), packed[:, 3:])
    return packed, corner, step


def unpack_points(packed: Packed, corner: Floats, step: float, most: int = MOST) -> Surface:
    """Return the surface that `pack_points` packed, as an image of one row, without areas."""
    points = (packed[:, :3] * step + corner).astype(np.float32)
    normals = np.zeros((len(packed), 3), np.float32)
    _unpack_normals(packed[:, 3:], float(most), normals)
    shape = (1, len(packed))
    return Surface(
        points[None], normals[None], np.ones(shape, np.bool_), np.zeros(shape, np.float32), None
    )


# Artifacts as bytes, which suffice to validate a frame without its upload.
#
#     Geometry  --write_geometry-->  bytes  --read_geometry-->  Geometry
#
# The order is: magic number, schema, CRC-32 of the rest, sizes and camera, id of the model, arrays.
# Numbers are little-endian. Depth images have schema 1, clouds 2, and scans with spread points 3.
# In schema 3, all offsets and ranges precede the normals.

MAGIC = b"SPGEO"
#: Versions of the format for depth images, clouds, and scans with spread points. Replace a version
#: if its bytes or their meaning change.
SCHEMA_VERSION, CLOUD_SCHEMA, SCAN_SCHEMA = 1, 2, 3
#: Magic number, schema, checksum.
_HEAD = struct.Struct("<5sHI")
#: Depth image: width, height, number of patches, bytes per descriptor, fx, fy, cx, cy, scale of
#: `pack_image`, model.
_DEPTH = struct.Struct("<HHHH5d32s")
#: Cloud: width, height, number of patches, bytes per descriptor, kind, pole; step, left and top of
#: a sphere, or corner of unordered points; scale of `pack_image` or step of `pack_points`; model.
_CLOUD = struct.Struct("<HHHHBB4d32s")
_SPHERE, _POINTS = 1, 2
#: Scan, after the fields of a cloud: number of spread points, their corner, and their step.
_SPREAD = struct.Struct("<H4d")
#: Maximum value of a packed normal in scans with spread points; the error is at most half a degree.
_COARSE = 255
#: Maximum number of unordered points, about the number of pixels in the surface of a depth image.
MAXIMUM_POINTS = 20_000
#: Maximum number of patches, and of bytes per descriptor. Validation compares all pairs of patches;
#: no model exceeds these numbers.
MAXIMUM_PATCHES, MAXIMUM_DESCRIPTOR = 4096, 1024
#: Bounds of the smallest depth, metres, within which points and areas are finite in float32.
NEAREST = (1e-6, 1e6)
#: Minimum and maximum step of ranges and offsets, metres.
STEPS = (2.0**-40, 16.0)
#: Maximum distance, metres, and maximum area, square metres, of a patch.
FARTHEST, LARGEST = 1e9, 1e18
#: Record of a patch without its descriptor.
_PATCH = np.dtype(
    [
        ("mean", "<f4", 3), ("normal", "<f4", 3), ("area", "<f4"), ("coherence", "<f4"),
        ("size", "<i4"),
    ]
)  # fmt: skip


def write_geometry(geometry: Geometry) -> bytes:
    """Return a geometry artifact as bytes; equal artifacts have equal bytes.

    `geometry`: artifact whose model id has 64 hexadecimal digits; more than MAXIMUM_POINTS
    unordered points are thinned.
    """
    patches, camera, spread = geometry.patches, geometry.surface.camera, geometry.surface.spread
    schema = SCHEMA_VERSION if isinstance(camera, Intrinsics) else CLOUD_SCHEMA
    model, sizes = bytes.fromhex(geometry.model_id), (len(patches), geometry.descriptors.shape[1])
    if camera is None:
        packed, corner, step = pack_points(thin_points(geometry.surface, MAXIMUM_POINTS))
        head = _CLOUD.pack(len(packed), 1, *sizes, _POINTS, 0, *corner, step, model)
        body = packed.astype("<u2").tobytes()
    else:
        packed, scale = pack_image(geometry.surface, MOST if spread is None else _COARSE)
        size = camera.width, camera.height, *sizes
        if isinstance(camera, Intrinsics):
            head = _DEPTH.pack(*size, camera.fx, camera.fy, camera.cx, camera.cy, scale, model)
        else:
            turn = camera.step, camera.left, camera.top
            head = _CLOUD.pack(*size, _SPHERE, camera.pole, *turn, scale, model)
        body = packed.astype("<u2").tobytes()
        if isinstance(camera, Sphere) and spread is not None:
            schema = SCAN_SCHEMA
            points, corner, step = pack_points(spread, _COARSE)
            head += _SPREAD.pack(len(points), *corner, step)
            body = _split(packed, 1) + _split(points, 3)
    rows = np.zeros(len(patches), _PATCH)
    rows["mean"], rows["normal"], rows["area"] = patches.means, patches.normals, patches.areas
    rows["coherence"], rows["size"] = patches.coherences, patches.sizes
    descriptors = np.ascontiguousarray(geometry.descriptors).tobytes()
    body = b"".join([head, body, rows.tobytes(), descriptors])
    return _HEAD.pack(MAGIC, schema, crc32(body)) + body


def _split(packed: Packed, places: int) -> bytes:
    """Return the first `places` numbers of each row as 16 bits, then its normal as 2 x 8 bits."""
    return (
        packed[..., :places].astype("<u2").tobytes() + packed[..., places:].astype("u1").tobytes()
    )


def _join(data: memoryview, shape: tuple[int, ...], places: int) -> Packed:
    """Restore the numbers (*shape, places + 2) from the bytes of `_split`."""
    end = 2 * places * math.prod(shape)
    first = np.frombuffer(data[:end], "<u2").reshape(*shape, places)
    normals = np.frombuffer(data[end:], np.uint8).reshape(*shape, 2)
    return np.concatenate([first, normals.astype(np.uint16)], axis=-1)


def read_geometry(data: bytes) -> Geometry:
    """Parse a geometry artifact from the bytes of `write_geometry`.

    Raise UnreadableGeometry if the bytes are not an artifact, are truncated or damaged, have
    another schema, or describe an impossible camera, depth or patch.
    """
    nothing = f"The {len(data)} bytes are not a geometry artifact."
    if len(data) < _HEAD.size or data[: len(MAGIC)] != MAGIC:
        _refuse(nothing)
    _, schema, checksum = _HEAD.unpack_from(data)
    if schema not in (SCHEMA_VERSION, CLOUD_SCHEMA, SCAN_SCHEMA):
        _refuse(
            f"The geometry artifact has schema {schema}; this version reads "
            f"{SCHEMA_VERSION} to {SCAN_SCHEMA}."
        )
    body = memoryview(data)[_HEAD.size :]
    layout = _DEPTH if schema == SCHEMA_VERSION else _CLOUD
    is_scan = schema == SCAN_SCHEMA
    start = layout.size + _SPREAD.size * is_scan
    if len(body) < start:
        _refuse(nothing)
    width, height, count, length, *projection, model = layout.unpack_from(body)
    spread = _SPREAD.unpack_from(body, layout.size) if is_scan else None
    pixel = 4 if is_scan else 10 if schema == CLOUD_SCHEMA and projection[0] == _POINTS else 6
    points = 8 * spread[0] if spread else 0
    arrays = [width * height * pixel, points, count * _PATCH.itemsize, count * length]
    ends = np.cumsum([start, *arrays])
    if len(body) != ends[-1] or crc32(body) != checksum:
        _refuse("The geometry artifact is damaged: its checksum does not match.")
    pixels = body[ends[0] : ends[1]]
    try:
        if spread:
            surface = _read_scan(
                _join(pixels, (height, width), 1), body[ends[1] : ends[2]], projection, spread
            )
        else:
            packed = np.frombuffer(pixels, "<u2").reshape(height, width, pixel // 2)
            surface = (
                _read_depth(packed, *projection)
                if schema == SCHEMA_VERSION
                else _read_cloud(packed, *projection)
            )
    except InvalidIntrinsics as error:
        raise UnreadableGeometry(f"The geometry artifact has an invalid camera: {error}") from error
    patches = _read_patches(np.frombuffer(body[ends[2] : ends[3]], _PATCH))
    if count > MAXIMUM_PATCHES or length > MAXIMUM_DESCRIPTOR or not _are_sound(patches):
        _refuse(
            f"The geometry artifact has {count} patches with descriptors of {length} bytes, which "
            "are invalid or exceed the limits."
        )
    descriptors: Bytes = np.frombuffer(body[ends[3] :], np.uint8).reshape(count, length)
    return Geometry(surface, patches, descriptors, model.hex())


def _refuse(why: str) -> NoReturn:
    raise UnreadableGeometry(f"{why} Sign the frame again from its upload.")


def _read_depth(
    packed: NDArray[np.uint16], fx: float, fy: float, cx: float, cy: float, scale: float
) -> Surface:
    camera = Intrinsics(packed.shape[1], packed.shape[0], fx, fy, cx, cy)
    if not (scale > 0 and NEAREST[0] <= 1.0 / (scale * 65535.0) <= NEAREST[1]):
        _refuse(f"The geometry artifact has the invalid depth scale {scale}.")
    return unpack_image(packed, scale, camera)


def _read_scan(
    packed: Packed, points: memoryview, projection: list[Any], spread: tuple[Any, ...]
) -> Surface:
    count, *corner, step = spread
    near = all(abs(x) <= NEAREST[1] for x in corner)
    if not (projection[0] == _SPHERE and 0 < count <= SPREAD_POINTS and near):
        _refuse("The geometry artifact has invalid spread points.")
    if not STEPS[0] <= step <= STEPS[1]:
        _refuse(f"The geometry artifact has the invalid offset step {step}.")
    surface = _read_cloud(packed, *projection, most=_COARSE)
    spread_surface = unpack_points(_join(points, (count,), 3), np.array(corner), step, _COARSE)
    return replace(surface, spread=spread_surface)


def _read_cloud(
    packed: NDArray[np.uint16], kind: int, pole: int, a: float, b: float, c: float, step: float,
    *, most: int = MOST,
) -> Surface:  # fmt: skip
    if not STEPS[0] <= step <= STEPS[1]:
        _refuse(f"The geometry artifact has the invalid range step {step}.")
    height, width = packed.shape[:2]
    if kind == _SPHERE:
        return unpack_image(packed, step, Sphere(width, height, a, b, c, pole), most)
    near = all(abs(x) <= NEAREST[1] for x in (a, b, c))
    if kind != _POINTS or pole or height != 1 or width > MAXIMUM_POINTS or not near:
        _refuse("The geometry artifact has invalid unordered points.")
    return unpack_points(packed[0], np.array([a, b, c]), step)


def _read_patches(rows: NDArray[np.void]) -> Patches:
    with np.errstate(invalid="ignore"):  # `_are_sound` rejects NaN
        return Patches(
            means=rows["mean"].astype(float),
            normals=rows["normal"].astype(float),
            areas=rows["area"].astype(float),
            sizes=rows["size"].astype(np.int32),
            coherences=rows["coherence"].astype(float),
        )


def _are_sound(patches: Patches) -> bool:
    """Return whether the numbers of all patches are valid; NaN is invalid."""
    length = np.sqrt((patches.normals**2).sum(axis=1))
    return bool(
        (np.abs(patches.means) <= FARTHEST).all()
        and (np.abs(length - 1.0) < 1e-3).all()
        and ((patches.areas >= 0) & (patches.areas <= LARGEST)).all()
        and ((patches.coherences >= 0) & (patches.coherences <= 1)).all()
        and (patches.sizes >= 0).all()
    )
