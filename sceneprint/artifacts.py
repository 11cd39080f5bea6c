"""Geometry artifacts as bytes: what is kept of a frame so that its upload is not read again.

    Geometry  --write_geometry-->  bytes  --read_geometry-->  Geometry

Little-endian, in this order: magic, schema, CRC-32 of all that follows, sizes and camera, id of
the model, then the arrays; `packing.py` says what is in those of the surface. Depth images have
schema 1, clouds 2.
"""

from __future__ import annotations

import struct
import zlib
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import InvalidIntrinsics, UnreadableGeometry
from sceneprint.geometry.targets import thinned
from sceneprint.packing import pack_image, pack_points, unpack_image, unpack_points
from sceneprint.types import Bytes, Geometry, Intrinsics, Patches, Sphere, Surface

MAGIC = b"SPGEO"
#: Of the bytes and of what they mean, for depth images and for clouds. Raise it when either
#: changes.
SCHEMA_VERSION, CLOUD_SCHEMA = 1, 2
#: magic, schema, checksum
_HEAD = struct.Struct("<5sHI")
#: Of a depth image: width, height, patches, bytes of a descriptor, fx, fy, cx, cy, inverse depth
#: of 65535, model
_DEPTH = struct.Struct("<HHHH5d32s")
#: Of a cloud: width, height, patches, bytes of a descriptor, kind, pole, then step, left and top
#: of a sphere or the corner of points in no order, then the step of 1, model
_CLOUD = struct.Struct("<HHHHBB4d32s")
_SPHERE, _POINTS = 1, 2
#: Most points in no order that are kept: as many as pixels of a depth image.
MAXIMUM_POINTS = 20_000
#: Most patches and longest descriptor that are believed: validation compares all patches with all,
#: and no model makes more of either.
MAXIMUM_PATCHES, MAXIMUM_DESCRIPTOR = 4096, 1024
#: Least and most of the nearest depth, metres: points and areas stay finite in 32 bits.
NEAREST = (1e-6, 1e6)
#: Least and most of a step of range or offset, metres.
STEPS = (2.0**-40, 16.0)
#: Farthest patch, metres, and largest, square metres, that are believed.
FARTHEST, LARGEST = 1e9, 1e18
#: Bytes of a patch beside its descriptor: mean, normal, area, coherence as float32, and its size.
_PATCH = np.dtype(
    [
        ("mean", "<f4", 3), ("normal", "<f4", 3), ("area", "<f4"), ("coherence", "<f4"),
        ("size", "<i4"),
    ]
)  # fmt: skip


def write_geometry(geometry: Geometry) -> bytes:
    """A geometry artifact as bytes, the same ones for the same artifact.

    Parameters
    ----------
    geometry : see Geometry; its model id is 64 hexadecimal digits. Of points in no order at most
        MAXIMUM_POINTS are kept
    """
    patches, camera = geometry.patches, geometry.surface.camera
    model, sizes = bytes.fromhex(geometry.model_id), (len(patches), geometry.descriptors.shape[1])
    if camera is None:
        packed, corner, step = pack_points(thinned(geometry.surface, MAXIMUM_POINTS))
        head = _CLOUD.pack(len(packed), 1, *sizes, _POINTS, 0, *corner, step, model)
    else:
        packed, scale = pack_image(geometry.surface)
        size = camera.width, camera.height, *sizes
        if isinstance(camera, Intrinsics):
            head = _DEPTH.pack(*size, camera.fx, camera.fy, camera.cx, camera.cy, scale, model)
        else:
            turn = camera.step, camera.left, camera.top
            head = _CLOUD.pack(*size, _SPHERE, camera.pole, *turn, scale, model)
    rows = np.zeros(len(patches), _PATCH)
    rows["mean"], rows["normal"], rows["area"] = patches.means, patches.normals, patches.areas
    rows["coherence"], rows["size"] = patches.coherences, patches.sizes
    body = b"".join(
        [
            head,
            packed.astype("<u2").tobytes(),
            rows.tobytes(),
            np.ascontiguousarray(geometry.descriptors).tobytes(),
        ]
    )
    schema = SCHEMA_VERSION if isinstance(camera, Intrinsics) else CLOUD_SCHEMA
    return _HEAD.pack(MAGIC, schema, zlib.crc32(body)) + body


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
    nothing = f"{len(data)} bytes are no geometry artifact."
    if len(data) < _HEAD.size or data[: len(MAGIC)] != MAGIC:
        _refuse(nothing)
    _, schema, checksum = _HEAD.unpack_from(data)
    if schema not in (SCHEMA_VERSION, CLOUD_SCHEMA):
        _refuse(
            f"The geometry artifact has schema {schema}, and this version reads "
            f"{SCHEMA_VERSION} and {CLOUD_SCHEMA}."
        )
    body = memoryview(data)[_HEAD.size :]
    layout = _DEPTH if schema == SCHEMA_VERSION else _CLOUD
    if len(body) < layout.size:
        _refuse(nothing)
    width, height, count, length, *told, model = layout.unpack_from(body)
    numbers = 5 if schema == CLOUD_SCHEMA and told[0] == _POINTS else 3
    arrays = [width * height * 2 * numbers, count * _PATCH.itemsize, count * length]
    ends = np.cumsum([layout.size, *arrays])
    if len(body) != ends[-1] or zlib.crc32(body) != checksum:
        _refuse("The geometry artifact is damaged: its checksum does not fit.")
    packed = np.frombuffer(body[ends[0] : ends[1]], "<u2").reshape(height, width, numbers)
    try:
        surface = _depth(packed, *told) if schema == SCHEMA_VERSION else _cloud(packed, *told)
    except InvalidIntrinsics as error:
        raise UnreadableGeometry(f"The geometry artifact has no camera: {error}") from error
    patches = _patches(np.frombuffer(body[ends[1] : ends[2]], _PATCH))
    if count > MAXIMUM_PATCHES or length > MAXIMUM_DESCRIPTOR or not _sound(patches):
        _refuse(
            f"The geometry artifact's {count} patches with descriptors of {length} bytes are none "
            "that a model makes."
        )
    descriptors: Bytes = np.frombuffer(body[ends[2] :], np.uint8).reshape(count, length)
    return Geometry(surface, patches, descriptors, model.hex())


def _refuse(why: str) -> NoReturn:
    raise UnreadableGeometry(f"{why} Sign the frame again from its upload.")


def _depth(
    packed: NDArray[np.uint16], fx: float, fy: float, cx: float, cy: float, scale: float
) -> Surface:
    camera = Intrinsics(packed.shape[1], packed.shape[0], fx, fy, cx, cy)
    # false for NaN as well
    if not (scale > 0 and NEAREST[0] <= 1.0 / (scale * 65535.0) <= NEAREST[1]):
        _refuse(f"The geometry artifact has {scale} for its scale of depth.")
    return unpack_image(packed, scale, camera)


def _cloud(
    packed: NDArray[np.uint16], kind: int, pole: int, a: float, b: float, c: float, step: float
) -> Surface:
    if not STEPS[0] <= step <= STEPS[1]:
        _refuse(f"The geometry artifact has {step} for its step of range.")
    height, width = packed.shape[:2]
    if kind == _SPHERE:
        return unpack_image(packed, step, Sphere(width, height, a, b, c, pole))
    near = all(abs(one) <= NEAREST[1] for one in (a, b, c))  # false for NaN
    if kind != _POINTS or pole or height != 1 or width > MAXIMUM_POINTS or not near:
        _refuse("The geometry artifact has points that no cloud has.")
    return unpack_points(packed[0], np.array([a, b, c]), step)


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
