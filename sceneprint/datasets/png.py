"""16-bit greyscale PNG, read so that no file can surprise.

    bytes  --decode_png-->  samples (H, W) uint16

Pillow takes a PNG whose data end early as an image with black rows, and does not look at
the check sums of the data. So the file is taken apart and checked here, and Pillow, which knows
interlacing, gets only plain pixels of those that are interlaced.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import UnreadableFrame
from sceneprint.types import MAXIMUM_SAMPLES

SIGNATURE = b"\x89PNG\r\n\x1a\n"
#: Most bytes a frame may have: all samples as float64, and room for a header.
MAXIMUM_BYTES = 8 * MAXIMUM_SAMPLES + 65_536
_MAXIMUM_CHUNKS = 65_536  # 16 megapixels in pieces of 1 KB; each costs time even if empty
_COLOURS = {2: "colour (RGB)", 3: "palette", 4: "greyscale with alpha", 6: "colour with alpha"}
#: Adam7: first column and row of each pass, and its steps
_PASSES = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2),
           (0, 1, 1, 2))  # fmt: skip
_TRUNCATED = "The PNG ends early. Copy or write the file again."


def decode_png(data: bytes) -> NDArray[np.uint16]:
    """Return the samples of a 16-bit greyscale PNG, in stored units.

    Parameters
    ----------
    data : the whole file

    Returns
    -------
    samples : (H, W) uint16

    Raises
    ------
    UnreadableFrame : the file is empty, damaged, truncated, animated, too large, or has
        another kind of pixels.
    """
    if not data:
        raise UnreadableFrame("The file is empty. Copy or write it again.")
    if len(data) > MAXIMUM_BYTES:
        raise UnreadableFrame(
            f"The file has {len(data)} bytes, the limit is {MAXIMUM_BYTES}. "
            "Send the image at a lower resolution."
        )
    if not data.startswith(SIGNATURE):
        raise UnreadableFrame("This is no PNG. Write the depth as a 16-bit greyscale PNG.")

    header, pixels = b"", bytearray()
    for kind, content in _chunks(data):
        if not header and kind != b"IHDR":
            raise UnreadableFrame("The PNG does not begin with its header. Write it again.")
        if kind == b"IHDR":
            if header:
                raise UnreadableFrame("The PNG has two headers. Write it again.")
            header = _checked_header(content)
        elif kind == b"IDAT":
            pixels += content
        elif kind == b"acTL":
            raise UnreadableFrame("The PNG is animated. Send one image per frame.")
        elif kind != b"IEND" and kind[0:1].isupper():  # upper case: not to be ignored
            raise UnreadableFrame(
                f"The PNG has a {kind!r} chunk, which 16-bit greyscale has not. "
                "Write it as a plain PNG."
            )
    return _unfilter(header, _inflate(bytes(pixels), header))


def _chunks(data: bytes) -> Iterator[tuple[bytes, memoryview]]:
    """Yield kind and content of each chunk up to IEND, check sums compared."""
    view, position = memoryview(data), len(SIGNATURE)
    for _ in range(_MAXIMUM_CHUNKS):
        if position + 12 > len(data):
            raise UnreadableFrame(_TRUNCATED)
        (length,) = struct.unpack_from(">I", data, position)
        end = position + 8 + length
        if end + 4 > len(data):
            raise UnreadableFrame(_TRUNCATED)
        kind = data[position + 4 : position + 8]
        if struct.unpack_from(">I", data, end)[0] != zlib.crc32(view[position + 4 : end]):
            raise UnreadableFrame(
                f"The PNG is damaged: the check sum of its {kind!r} chunk is wrong. "
                "Copy or write the file again."
            )
        yield kind, view[position + 8 : end]
        if kind == b"IEND":
            return
        position = end + 4
    raise UnreadableFrame(
        f"The PNG has more than {_MAXIMUM_CHUNKS} chunks. Write it with larger ones."
    )


def _checked_header(content: memoryview) -> bytes:
    """Return the content of IHDR if it announces a 16-bit greyscale image of sane size."""
    if len(content) != 13:
        raise UnreadableFrame("The header of the PNG has a wrong length. Write it again.")
    width, height, bits, colour, compression, filtering, interlace = struct.unpack(
        ">IIBBBBB", content
    )
    if colour != 0 or bits != 16:
        kind = _COLOURS.get(colour, "greyscale")
        raise UnreadableFrame(
            f"The PNG is {kind} with {bits} bits per sample, and depth is 16-bit greyscale. "
            "Send the depth image itself, written from a uint16 array."
        )
    if width < 1 or height < 1 or width * height > MAXIMUM_SAMPLES:
        raise UnreadableFrame(
            f"The PNG announces {width} x {height} samples; 1 to {MAXIMUM_SAMPLES} are read. "
            "Send the image at a lower resolution."
        )
    if compression or filtering or interlace > 1:
        raise UnreadableFrame(
            "The PNG uses a compression, filter or interlacing that PNG has not. Write it again."
        )
    return bytes(content)


def _inflate(pixels: bytes, header: bytes) -> bytes:
    """Return the filtered rows, exactly as many bytes as the header announces."""
    width, height, interlaced = *struct.unpack_from(">II", header), header[12]
    passes = _PASSES if interlaced else ((0, 0, 1, 1),)
    expected = 0
    for column, row, across, down in passes:
        columns, rows = -(-(width - column) // across), -(-(height - row) // down)
        if columns > 0 and rows > 0:  # an empty pass has no filter bytes either
            expected += rows * (1 + 2 * columns)
    stream = zlib.decompressobj()
    try:
        rows_bytes = stream.decompress(pixels, expected + 1)
    except zlib.error as cause:
        raise UnreadableFrame(
            f"The PNG is damaged: its pixels do not decompress ({cause}). Write it again."
        ) from cause
    if len(rows_bytes) != expected or not stream.eof:
        raise UnreadableFrame(
            f"The PNG announces {width} x {height} samples and holds "
            f"{'fewer' if len(rows_bytes) <= expected else 'more'}. Copy or write it again."
        )
    return rows_bytes


def _unfilter(header: bytes, rows: bytes) -> NDArray[np.uint16]:
    """Undo the filters; what is interlaced, and rare, is left to Pillow."""
    width, height, interlaced = *struct.unpack_from(">II", header), header[12]
    if interlaced:
        return _deinterlaced(header, rows)
    from sceneprint.datasets.unfiltering import unfilter

    samples = unfilter(np.frombuffer(rows, np.uint8).reshape(height, 1 + 2 * width))
    if samples is None:
        raise UnreadableFrame(
            "The PNG is damaged: its rows do not decode, as one has a filter that PNG has not. "
            "Write it again."
        )
    return samples


def _deinterlaced(header: bytes, rows: bytes) -> NDArray[np.uint16]:
    """Undo filters and interlacing: Pillow on a PNG of nothing but header and pixels."""
    from PIL import Image

    def chunk(kind: bytes, content: bytes) -> bytes:
        check = zlib.crc32(content, zlib.crc32(kind))
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", check)

    plain = SIGNATURE + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows, 0))
    try:
        with Image.open(io.BytesIO(plain + chunk(b"IEND", b"")), formats=("PNG",)) as image:
            samples = np.asarray(image)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as cause:
        raise UnreadableFrame(
            f"The PNG is damaged: its rows do not decode ({cause}). Write it again."
        ) from cause
    return np.array(samples, dtype=np.uint16)  # some versions of Pillow give int32
