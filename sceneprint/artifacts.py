"""Geometry artifacts as bytes: what is kept of a frame so that its upload is not read again.

    Geometry  --write_geometry-->  bytes  --read_geometry-->  Geometry

Little-endian, in this order: magic, schema, CRC-32 of all that follows, sizes and camera, id of
the model, then the arrays. Inverse depth is 16 bits (its steps are far below a sensor's noise),
a normal 2 x 16 bits on an octahedron.
"""

from __future__ import annotations

import struct
import zlib

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import InvalidIntrinsics, UnreadableGeometry
from sceneprint.geometry.kernel import kernel
from sceneprint.types import Bytes, Floats, Floats32, Geometry, Intrinsics, Patches, Surface

MAGIC = b"SPGEO"
#: Of the bytes and of what they mean. Raise it when either changes.
SCHEMA_VERSION = 1
#: magic, schema, checksum | width, height, patches, bytes of a descriptor, fx, fy, cx, cy,
#: inverse depth of 65535, model
_HEAD, _BODY = struct.Struct("<5sHI"), struct.Struct("<HHHH5d32s")
#: Most patches and longest descriptor that are believed: validation compares all patches with all,
#: and no model makes more of either.
MAXIMUM_PATCHES, MAXIMUM_DESCRIPTOR = 4096, 1024
#: Least and most of the nearest depth, metres: points and areas stay finite in 32 bits.
NEAREST = (1e-6, 1e6)
#: Farthest patch, metres, and largest, square metres, that are believed.
FARTHEST, LARGEST = 1e9, 1e18
#: Bytes of a patch beside its descriptor: mean, normal, area, coherence as float32, and its size.
_PATCH = np.dtype(
    [
        ("mean", "<f4", 3), ("normal", "<f4", 3), ("area", "<f4"), ("coherence", "<f4"),
        ("size", "<i4"),
    ]
)  # fmt: skip


@kernel
def _pack(points: Floats32, normals: Floats32, scale: float, out: NDArray[np.uint16]) -> None:
    """Inverse depth and octahedral normal of every pixel, 0 where not valid: out (h, w, 3)."""
    height, width = points.shape[0], points.shape[1]
    for y in range(height):
        for x in range(width):
            z = points[y, x, 2]
            if z <= 0:
                continue
            out[y, x, 0] = np.uint16(max(round(1.0 / (z * scale)), 1.0))
            nx, ny, nz = (
                float(normals[y, x, 0]), float(normals[y, x, 1]), float(normals[y, x, 2])
            )  # fmt: skip
            total = abs(nx) + abs(ny) + abs(nz)
            u, v = nx / total, ny / total
            if nz > 0:  # normals face the sensor, -z: that half is the middle of the square
                u, v = (
                    (1.0 - abs(v)) * (1.0 if u >= 0 else -1.0),
                    (1.0 - abs(u)) * (1.0 if v >= 0 else -1.0),
                )
            out[y, x, 1] = np.uint16(round((u * 0.5 + 0.5) * 65535.0))
            out[y, x, 2] = np.uint16(round((v * 0.5 + 0.5) * 65535.0))


@kernel
def _unpack(
    packed: NDArray[np.uint16], scale: float, camera: Floats, points: Floats32,
    normals: Floats32, areas: Floats32, valid: NDArray[np.bool_],
) -> None:  # fmt: skip
    height, width = packed.shape[0], packed.shape[1]
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    for y in range(height):
        yn = (y - cy) / fy
        for x in range(width):
            if packed[y, x, 0] == 0:
                continue
            xn = (x - cx) / fx
            z = 1.0 / (packed[y, x, 0] * scale)
            u, v = packed[y, x, 1] / 65535.0 * 2.0 - 1.0, packed[y, x, 2] / 65535.0 * 2.0 - 1.0
            nz = -(1.0 - abs(u) - abs(v))
            if nz > 0:
                u, v = (
                    (1.0 - abs(v)) * (1.0 if u >= 0 else -1.0),
                    (1.0 - abs(u)) * (1.0 if v >= 0 else -1.0),
                )
            length = np.sqrt(u * u + v * v + nz * nz)
            u, v, nz = u / length, v / length, nz / length
            points[y, x, 0], points[y, x, 1], points[y, x, 2] = xn * z, yn * z, z
            normals[y, x, 0], normals[y, x, 1], normals[y, x, 2] = u, v, nz
            ray = np.sqrt(xn * xn + yn * yn + 1.0)
            cosine = -(xn * u + yn * v + nz) / ray
            areas[y, x] = z * z / (fx * fy * ray * max(cosine, 1e-3))
            valid[y, x] = True


def write_geometry(geometry: Geometry) -> bytes:
    """A geometry artifact as bytes, the same ones for the same artifact.

    Parameters
    ----------
    geometry : see Geometry; its model id is 64 hexadecimal digits
    """
    surface, patches, k = geometry.surface, geometry.patches, geometry.surface.camera
    assert isinstance(k, Intrinsics)
    z = surface.points[..., 2][surface.valid]
    scale = 1.0 / (float(z.min()) * 65535.0) if z.size else 1.0
    packed = np.zeros((k.height, k.width, 3), np.uint16)
    _pack(surface.points, surface.normals, scale, packed)
    rows = np.zeros(len(patches), _PATCH)
    rows["mean"], rows["normal"], rows["area"] = patches.means, patches.normals, patches.areas
    rows["coherence"], rows["size"] = patches.coherences, patches.sizes
    body = b"".join(
        [
            _BODY.pack(
                k.width, k.height, len(patches), geometry.descriptors.shape[1],
                k.fx, k.fy, k.cx, k.cy, scale, bytes.fromhex(geometry.model_id),
            ),
            packed.astype("<u2").tobytes(),
            rows.tobytes(),
            np.ascontiguousarray(geometry.descriptors).tobytes(),
        ]
    )  # fmt: skip
    return _HEAD.pack(MAGIC, SCHEMA_VERSION, zlib.crc32(body)) + body


def read_geometry(data: bytes) -> Geometry:
    """A geometry artifact from its bytes.

    Parameters
    ----------
    data : of `write_geometry`

    Raises
    ------
    UnreadableGeometry : not an artifact, cut short, damaged, of another schema, or with numbers
        that are no camera, no depth or no patches.
    """
    if len(data) < _HEAD.size + _BODY.size or data[: len(MAGIC)] != MAGIC:
        raise UnreadableGeometry(
            f"{len(data)} bytes are no geometry artifact. Sign the frame again from its upload."
        )
    _, schema, checksum = _HEAD.unpack_from(data)
    if schema != SCHEMA_VERSION:
        raise UnreadableGeometry(
            f"The geometry artifact has schema {schema}, and this version reads "
            f"{SCHEMA_VERSION}. Sign the frame again from its upload."
        )
    body = memoryview(data)[_HEAD.size :]
    width, height, count, length, fx, fy, cx, cy, scale, model = _BODY.unpack_from(body)
    ends = np.cumsum([_BODY.size, width * height * 6, count * _PATCH.itemsize, count * length])
    if len(body) != ends[-1] or zlib.crc32(body) != checksum:
        raise UnreadableGeometry(
            "The geometry artifact is damaged: its checksum does not fit. "
            "Sign the frame again from its upload."
        )
    try:
        camera = Intrinsics(width, height, fx, fy, cx, cy)
    except InvalidIntrinsics as error:
        raise UnreadableGeometry(f"The geometry artifact has no camera: {error}") from error
    # false for NaN as well
    if not (scale > 0 and NEAREST[0] <= 1.0 / (scale * 65535.0) <= NEAREST[1]):
        raise UnreadableGeometry(
            f"The geometry artifact has {scale} for its scale of depth. "
            "Sign the frame again from its upload."
        )
    patches = _patches(np.frombuffer(body[ends[1] : ends[2]], _PATCH))
    if count > MAXIMUM_PATCHES or length > MAXIMUM_DESCRIPTOR or not _sound(patches):
        raise UnreadableGeometry(
            f"The geometry artifact's {count} patches with descriptors of {length} bytes are none "
            "that a model makes. Sign the frame again from its upload."
        )
    packed = np.frombuffer(body[ends[0] : ends[1]], "<u2").reshape(height, width, 3)
    descriptors: Bytes = np.frombuffer(body[ends[2] :], np.uint8).reshape(count, length)
    return Geometry(_surface(packed, scale, camera), patches, descriptors, model.hex())


def _surface(packed: NDArray[np.uint16], scale: float, k: Intrinsics) -> Surface:
    shape = (k.height, k.width)
    points, normals = np.zeros((*shape, 3), np.float32), np.zeros((*shape, 3), np.float32)
    areas, valid = np.zeros(shape, np.float32), np.zeros(shape, np.bool_)
    camera = np.array([k.fx, k.fy, k.cx, k.cy])
    _unpack(packed, scale, camera, points, normals, areas, valid)
    return Surface(points, normals, valid, areas, k)


def _patches(rows: NDArray[np.void]) -> Patches:
    with np.errstate(invalid="ignore"):  # a signalling NaN; `_sound` refuses it
        return Patches(
            means=rows["mean"].astype(float),
            normals=rows["normal"].astype(float),
            areas=rows["area"].astype(float),
            sizes=rows["size"].astype(np.int32),
            coherences=rows["coherence"].astype(float),
        )


def _sound(patches: Patches) -> bool:
    """Whether the numbers are those of patches: comparisons with NaN are false."""
    length = np.sqrt((patches.normals**2).sum(axis=1))
    return bool(
        (np.abs(patches.means) <= FARTHEST).all()
        and (np.abs(length - 1.0) < 1e-3).all()
        and ((patches.areas >= 0) & (patches.areas <= LARGEST)).all()
        and ((patches.coherences >= 0) & (patches.coherences <= 1)).all()
        and (patches.sizes >= 0).all()
    )
