"""Reading of depth images, and construction of a `DepthFrame` from samples and a camera.

bytes  --decode_png | decode_npy-->  samples (H, W)  --make_frame-->  DepthFrame
"""

from __future__ import annotations

import io
import math
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, cast

import numpy as np
from isal import isal_zlib
from isal.isal_zlib import crc32
from numpy.typing import NDArray

from sceneprint.errors import InvalidIntrinsics, UnreadableFrame, UselessFrame
from sceneprint.formats.depth_plausibility import check_camera, check_depth
from sceneprint.geometry.surface.camera import ray_to_axis, undistort
from sceneprint.types import MAXIMUM_SAMPLES, DepthFrame, Floats, Floats32, Intrinsics
from sceneprint_client.files import (
    MAXIMUM_IMAGE_BYTES,
    NPY_SIGNATURE,
    PNG_SIGNATURE,
    NpyHeader,
    naming,
    npy_header,
    read_bytes,
)
from sceneprint_client.formats import foreign_file, format_at, function_at, titles_of
from sceneprint_client.poses import rigid_transform
from sceneprint_client.ros_messages import TRANSPORT_BYTES, inverse_depth

#: Samples of a depth image: uint16 in stored units, or float32 metres.
Samples = NDArray[np.uint16] | Floats32

#: Maximum number of chunks: 16 megapixels in chunks of 1 KB. Even empty chunks take time.
_MAXIMUM_CHUNKS = 65_536
_COLOURS = {2: "colour (RGB)", 3: "palette", 4: "greyscale with alpha", 6: "colour with alpha"}
#: First column, first row, column step and row step of each pass of Adam7 interlacing.
_PASSES = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2),
           (0, 1, 1, 2))  # fmt: skip
_TRUNCATED = "The PNG is truncated. Copy or write the file again."


def decode_png(data: bytes) -> NDArray[np.uint16]:
    """Decode the samples of a 16-bit greyscale PNG, in stored units.

    Returns
    -------
    samples : (H, W) uint16

    Raises
    ------
    UnreadableFrame : If the file is empty, damaged, truncated, animated or too large, or has
        another pixel format.
    """
    check_length(data)
    if not data.startswith(PNG_SIGNATURE):
        raise UnreadableFrame("This is not a PNG. Write the depth as a 16-bit greyscale PNG.")

    header, pixels = b"", bytearray()
    for kind, content in _read_chunks(data):
        if not header and kind != b"IHDR":
            raise UnreadableFrame("The PNG does not start with its header. Write it again.")
        if kind == b"IHDR":
            if header:
                raise UnreadableFrame("The PNG has two headers. Write it again.")
            header = _checked_header(content)
        elif kind == b"IDAT":
            pixels += content
        elif kind == b"acTL":
            raise UnreadableFrame("The PNG is animated. Send one image per frame.")
        elif kind != b"IEND" and kind[0:1].isupper():  # an uppercase letter marks a critical chunk
            raise UnreadableFrame(
                f"The PNG has a {kind!r} chunk, which 16-bit greyscale images do not have. "
                "Write it as a plain PNG."
            )
    return _decode_rows(header, _inflate(bytes(pixels), header))


def check_length(data: bytes) -> None:
    """Raise UnreadableFrame if a file is empty or too large for a depth image."""
    if not data:
        raise UnreadableFrame("The file is empty. Copy or write it again.")
    if len(data) > MAXIMUM_IMAGE_BYTES:
        raise UnreadableFrame(
            f"The file has {len(data)} bytes; the limit is {MAXIMUM_IMAGE_BYTES}. "
            "Send the image at a lower resolution."
        )


def png_size(head: bytes) -> tuple[int, int]:
    """Return the width and height of a PNG; raise UnreadableFrame if its header is truncated."""
    if len(head) < 24:
        raise UnreadableFrame(_TRUNCATED)
    width, height = struct.unpack_from(">II", head, 16)
    return width, height


def _read_chunks(data: bytes) -> Iterator[tuple[bytes, memoryview]]:
    """Verify the checksum of each chunk up to IEND, and yield its kind and content."""
    view, position = memoryview(data), len(PNG_SIGNATURE)
    for _ in range(_MAXIMUM_CHUNKS):
        if position + 12 > len(data):
            raise UnreadableFrame(_TRUNCATED)
        (length,) = struct.unpack_from(">I", data, position)
        end = position + 8 + length
        if end + 4 > len(data):
            raise UnreadableFrame(_TRUNCATED)
        kind = data[position + 4 : position + 8]
        if struct.unpack_from(">I", data, end)[0] != crc32(view[position + 4 : end]):
            raise UnreadableFrame(
                f"The PNG is damaged: the checksum of its {kind!r} chunk is wrong. "
                "Copy or write the file again."
            )
        yield kind, view[position + 8 : end]
        position = end + 4
        if kind == b"IEND":
            if data[position:].strip(b"\0\r\n"):
                raise UnreadableFrame(
                    f"{len(data) - position} bytes follow after the end of the PNG, such as a "
                    "second image. Send one image per frame."
                )
            return
    raise UnreadableFrame(
        f"The PNG has more than {_MAXIMUM_CHUNKS} chunks. Write it with larger chunks."
    )


def _checked_header(content: memoryview) -> bytes:
    """Return the content of IHDR; raise UnreadableFrame if the image is not supported."""
    if len(content) != 13:
        raise UnreadableFrame("The header of the PNG has the wrong length. Write it again.")
    width, height, bits, colour, compression, filtering, interlace = struct.unpack(
        ">IIBBBBB", content
    )
    if colour != 0 or bits != 16:
        kind = _COLOURS.get(colour, "greyscale")
        raise UnreadableFrame(
            f"The PNG is {kind} with {bits} bits per sample, but depth must be 16-bit greyscale. "
            "Send the depth image itself, written from a uint16 array."
        )
    if width < 1 or height < 1 or width * height > MAXIMUM_SAMPLES:
        raise UnreadableFrame(
            f"The PNG declares {width} x {height} samples; it must have 1 to {MAXIMUM_SAMPLES}. "
            "Send the image at a lower resolution."
        )
    if compression or filtering or interlace > 1:
        raise UnreadableFrame(
            "The PNG has an unknown compression, filter or interlacing method. Write it again."
        )
    return bytes(content)


#: Error of isal, which its stub declares as an instance.
_DAMAGED = cast(type[Exception], isal_zlib.error)


def _inflate(pixels: bytes, header: bytes) -> bytes:
    """Decompress the filtered rows; raise UnreadableFrame if their size contradicts the header."""
    width, height, interlaced = *struct.unpack_from(">II", header), header[12]
    passes = _PASSES if interlaced else ((0, 0, 1, 1),)
    expected = 0
    for column, row, across, down in passes:
        columns, rows = -(-(width - column) // across), -(-(height - row) // down)
        if columns > 0 and rows > 0:  # an empty pass has no filter bytes
            expected += rows * (1 + 2 * columns)
    stream = isal_zlib.decompressobj()
    try:
        rows_bytes = stream.decompress(pixels, expected + 1)
    except _DAMAGED as cause:
        raise UnreadableFrame(
            f"The PNG is damaged: its pixels do not decompress ({cause}). Write it again."
        ) from cause
    if len(rows_bytes) != expected or not stream.eof:
        raise UnreadableFrame(
            f"The PNG declares {width} x {height} samples, but contains "
            f"{'fewer' if len(rows_bytes) <= expected else 'more'}. Copy or write it again."
        )
    return rows_bytes


def _decode_rows(header: bytes, rows: bytes) -> NDArray[np.uint16]:
    """Decode filtered rows with Pillow, from a minimal PNG."""
    from PIL.PngImagePlugin import PngImageFile

    plain = _build_png(header, zlib.compress(rows, 0))
    try:
        # Image.open has a pixel limit that applies to the whole process
        with PngImageFile(io.BytesIO(plain)) as image:
            samples = np.asarray(image)
    except (OSError, ValueError, SyntaxError) as cause:
        raise UnreadableFrame(
            f"The PNG is damaged: its rows do not decode ({cause}). Write it again."
        ) from cause
    return np.array(samples, dtype=np.uint16)  # some versions of Pillow return int32


def encode_npy(array: NDArray[Any]) -> bytes:
    """Encode an array as an NPY file."""
    file = io.BytesIO()
    np.save(file, np.ascontiguousarray(array), allow_pickle=False)
    return file.getvalue()


def encode_png(samples: NDArray[np.uint16]) -> bytes:
    """Encode samples (H, W) as a 16-bit greyscale PNG, in a sixth of Pillow's time.

    Rows store differences from their previous rows, and ISA-L compresses them.
    """
    height, width = samples.shape
    raw = samples.astype(">u2").view(np.uint8)
    rows = np.zeros((height, 1 + raw.shape[1]), np.uint8)
    rows[:, 1:] = raw
    rows[1:, 1:] -= raw[:-1]
    rows[1:, 0] = 2  # filter type Up; the first row has filter type None
    header = struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    return _build_png(header, isal_zlib.compress(rows.tobytes(), 1))


def _build_png(header: bytes, pixels: bytes) -> bytes:

    def chunk(kind: bytes, content: bytes) -> bytes:
        check = crc32(content, crc32(kind))
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", check)

    return (
        PNG_SIGNATURE + chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")
    )  # fmt: skip


# An image of ROS's compressed_depth_image_transport is a PNG preceded by a 12-byte header.

#: Limits of the parameter a of a 32FC1 image; a = q (q + 1) for the quantisation q, by default 100.
_A = (1.0, 1e8)
#: Limits of the depth that the value 1 encodes, metres: the transport's depth_max, by default 10.
_DEEPEST_M = (0.1, 1e3)


def transported_size(head: bytes) -> tuple[int, int]:
    """Return the width and height of the PNG in a compressedDepth message; see `png_size`."""
    return png_size(head[TRANSPORT_BYTES:])


def decode_transported(data: bytes) -> Samples:
    """Decode the samples of a compressedDepth message: stored units (16UC1) or metres (32FC1).

    Raise UnreadableFrame as `decode_png` does, or if the header fits neither encoding.
    """
    samples = decode_png(data[TRANSPORT_BYTES:])
    a, b = struct.unpack_from("<ff", data, 4)
    # for 16UC1 images, the transport does not set these numbers; they are mostly zero or tiny
    if not (1e-3 < a < 1e9 and 1e-3 < abs(b) < 1e9):
        return samples
    if b < 1 and _A[0] < a < _A[1] and _DEEPEST_M[0] <= a / (1 - b) <= _DEEPEST_M[1]:
        return inverse_depth(samples, a, b)
    raise UnreadableFrame(
        f"The header of the compressedDepth image (a = {a:g}, b = {b:g}) is neither that of a "
        "16UC1 nor of a 32FC1 image. Send the PNG without the first 12 bytes, or float32 metres "
        "a / (v - b) as NPY."
    )


# The headers of NPY files are not trusted.
#
# bytes  --decode_npy-->  samples (H, W) float32 or uint16

_TYPES = (
    "depth must be float32, float64 or float16 in metres, or uint16 in stored units. Convert it."
)
_SHAPES = (
    "The NPY array does not have the two dimensions of an image. "
    "Send one image with the shape (height, width)."
)


def decode_npy(data: bytes) -> Samples:
    """Decode the samples of an NPY file with a two-dimensional array.

    Returns
    -------
    samples : (H, W); float32 metres for a floating-point array, including NaN and infinities;
        uint16 stored units for a uint16 array

    Raises
    ------
    UnreadableFrame : If the file is empty, too large or not NPY, has another type or shape,
        contains Python objects, or its size contradicts its header.
    """
    check_length(data)
    if not data.startswith(NPY_SIGNATURE):
        raise UnreadableFrame("This is not an NPY file. Write the depth with numpy.save.")
    header = _checked_npy_header(data)
    height, width = header.shape
    expected = height * width * header.dtype.itemsize
    if len(data) - header.start != expected:
        raise UnreadableFrame(
            f"The NPY header declares {height} x {width} samples of {header.dtype.itemsize} "
            f"bytes, but {len(data) - header.start} of {expected} bytes follow. Copy or write the "
            "file again."
        )
    numbers = np.frombuffer(data, header.dtype, offset=header.start)
    samples = numbers.reshape(header.shape, order=header.order)
    if header.dtype.kind == "u":
        return np.array(samples, dtype=np.uint16, order="C")
    with np.errstate(all="ignore"):  # values beyond float32 become infinite, and so missing
        return np.array(samples, dtype=np.float32, order="C")


def npy_size(head: bytes) -> tuple[int, int]:
    """Return the width and height of an NPY file; raise UnreadableFrame unless it is an image."""
    height, width = _checked_npy_header(head).shape
    return width, height


def _checked_npy_header(data: bytes) -> NpyHeader:
    header = npy_header(data, UnreadableFrame, _TYPES, _SHAPES, whole=True)
    height, width = header.shape
    if not 1 <= height * width <= MAXIMUM_SAMPLES:
        raise UnreadableFrame(
            f"The NPY file must have 1 to {MAXIMUM_SAMPLES} samples, but declares none, or too "
            "many. Send the image at a lower resolution."
        )
    return header


#: Value that some sensors store for missing samples; others store 0.
_MISSING = 65_535


def make_frame(
    samples: NDArray[Any],
    intrinsics: Intrinsics,
    *,
    depth_scale: float = 1000.0,
    along_ray: bool = False,
    name: str = "",
    pose: Floats | None = None,
) -> DepthFrame:
    """Convert samples to a frame without lens distortion, in metres along the optical axis.

    Parameters
    ----------
    samples : (H, W) uint16 in stored units, where 0 and 65535 are missing; or floating-point
        metres, where NaN, infinite and non-positive values are missing
    intrinsics : camera of the image, with its distortion
    depth_scale : stored units per metre; ignored for floating-point samples
    along_ray : whether the samples are ranges along the pixel's ray instead of z
    pose : (4, 4) T_parent_sensor, or None if unknown

    Returns
    -------
    frame : depth (H, W) float32, metres, where 0 is missing

    Raises
    ------
    UnreadableFrame : If the samples have another type or are not two-dimensional.
    InvalidIntrinsics : If the intrinsics do not fit the image, or the depth scale is not positive.
    InvalidPose : If the pose is not a rigid transform.
    UselessFrame : If no valid sample remains.
    """
    with naming(name):
        if not (math.isfinite(depth_scale) and depth_scale > 0):
            raise InvalidIntrinsics(
                f"The depth scale {depth_scale} is not a positive number. "
                "Specify the stored units per metre, such as 1000 for millimetres."
            )
        depth = _to_metres(samples, depth_scale)
        height, width = depth.shape
        if (width, height) != (intrinsics.width, intrinsics.height):
            raise InvalidIntrinsics(
                f"The image has {width} x {height} pixels, but the intrinsics are for "
                f"{intrinsics.width} x {intrinsics.height}. Specify the intrinsics of this image; "
                "a resized image needs scaled intrinsics."
            )
        # this precedes `undistort`, because the rays are those of the distorted pixels
        if along_ray:
            depth = ray_to_axis(depth, intrinsics)
        if intrinsics.distortion:
            depth = undistort(depth, intrinsics)
        if not depth.any():
            raise UselessFrame(
                f"All {depth.size} samples are missing. Check that the sensor saw surfaces within "
                "its range."
            )
        return DepthFrame(
            depth=depth,
            intrinsics=intrinsics.without_distortion(),
            name=name,
            pose=None if pose is None else rigid_transform(pose),
        )


def read_frame(
    path: Path,
    intrinsics: Intrinsics,
    *,
    depth_scale: float = 1000.0,
    along_ray: bool = False,
    name: str = "",
    pose: Floats | None = None,
) -> DepthFrame:
    """Read a depth image file as a frame; for the other parameters, see `make_frame`.

    Raise UnreadableFrame if the file is missing or too large; for further errors, see
    `decode_frame`. The message names the file.
    """
    data = read_bytes(path, MAXIMUM_IMAGE_BYTES, UnreadableFrame)
    with naming(str(path)):
        frame = decode_frame(
            data, intrinsics, depth_scale=depth_scale, along_ray=along_ray, pose=pose
        )
    return replace(frame, name=name)


def decode_frame(
    data: bytes,
    intrinsics: Intrinsics,
    *,
    depth_scale: float = 1000.0,
    along_ray: bool = False,
    name: str = "",
    pose: Floats | None = None,
    samples_of: Callable[[bytes], Samples] | None = None,
    trust_depth: bool = False,
) -> DepthFrame:
    """Decode a depth image as a frame; for the other parameters, see `make_frame`.

    Parameters
    ----------
    samples_of : decoder of the file; None selects `decode_samples`
    trust_depth : whether to accept samples that do not look like depth, and implausible cameras

    Raises
    ------
    UnreadableFrame : See `decode_samples`, `check_depth` and `make_frame`.
    InvalidIntrinsics, InvalidPose, UselessFrame : See `make_frame`.
    """
    with naming(name):
        samples = (samples_of or decode_samples)(data)
        if not trust_depth:
            check_depth(samples, depth_scale)
        frame = make_frame(
            samples, intrinsics, depth_scale=depth_scale, along_ray=along_ray, pose=pose
        )
        if not trust_depth:
            check_camera(intrinsics)
    return replace(frame, name=name)


def decode_samples(data: bytes) -> Samples:
    """Decode the samples (H, W) of a depth image: uint16 in stored units, or float32 metres.

    Raise UnreadableFrame if the first bytes match no depth format, or the file is damaged.
    """
    check_length(data)
    file_format = format_at(data, "depth")
    if file_format is None:
        raise UnreadableFrame(
            f"{foreign_file(data)}The format is none of {titles_of('depth')}. Write the depth as "
            "a 16-bit greyscale PNG, or with numpy.save as a float32 array in metres or a uint16 "
            "array in stored units."
        )
    samples: Samples = function_at(file_format.reader)(data)
    return samples


def _to_metres(samples: NDArray[Any], depth_scale: float) -> Floats32:
    """Convert samples to metres (H, W), float32; 0 is missing."""
    if not isinstance(samples, np.ndarray):
        raise TypeError(f"samples must be a numpy array, not {type(samples).__name__}")
    if samples.ndim != 2 or samples.size == 0:
        raise UnreadableFrame(
            f"The samples have the shape {samples.shape}, but a depth image has two dimensions. "
            "Send one image with the shape (height, width)."
        )
    with np.errstate(all="ignore"):  # values beyond float32 are missing
        if samples.dtype.kind == "u" and samples.dtype.itemsize == 2:
            if samples.size > _MISSING + 1:  # a table of all values saves time
                metres: Floats32 = np.take(_metres_table(depth_scale), samples)
                return metres
            depth = (samples / depth_scale).astype(np.float32)
            depth[samples == _MISSING] = 0.0
        elif samples.dtype.kind == "f":
            depth = np.array(samples, dtype=np.float32, order="C")
        else:
            raise UnreadableFrame(
                f"The samples are {samples.dtype}, but depth must be uint16 in stored units or "
                "float32 in metres. Convert them."
            )
        depth[~(np.isfinite(depth) & (depth > 0.0))] = 0.0
    return depth


@lru_cache(maxsize=4)
def _metres_table(depth_scale: float) -> Floats32:
    """Return the metres (65536,) for all values of a 16-bit sample."""
    return _to_metres(np.arange(_MISSING + 1, dtype=np.uint16)[None], depth_scale).ravel()


def size_of(head: bytes) -> tuple[int, int] | None:
    """Return the width and height in a depth image's first `HEAD` bytes; None if unknown."""
    file_format = format_at(head, "depth")
    if file_format is None:
        return None
    try:
        size: tuple[int, int] = function_at(file_format.size)(head)
    except UnreadableFrame:  # the decoder reports the reason
        return None
    return size
