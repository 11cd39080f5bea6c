"""The table of file formats, which the command line, service, client, dashboard and docs read.

`tests/test_golden.py` generates `docs/formats.md` and the dashboard's `formats.js` from it.

file name    --format_named-->  Format
first bytes  --format_at-->  Format  --reader_of-->  function
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from pathlib import PurePath
from typing import Any, Literal, cast

#: Content: a depth image, the points of one scan, a whole map, an archive of frames, a ROS
#: recording, or a capture of another system with frames and poses.
Kind = Literal["depth", "cloud", "map", "archive", "recording", "capture"]
#: Names of the formats of point clouds.
CloudFormat = Literal["ply", "pcd", "kitti", "npy", "las", "pointcloud2"]

#: Number of leading bytes of a file that determine its format.
HEAD = 10_016
BYTES = "application/octet-stream"


@dataclass(frozen=True)
class Format:
    """A file format.

    Parameters
    ----------
    name : unique within its kind
    title : name of the format for people
    suffixes : lower-case suffixes of file names
    content : description of the data that the reader uses, in Markdown
    signature : regular expression for the first bytes, as Latin-1, for Python and JavaScript; empty
        if these bytes do not determine the format. The groups match width and height
    reader : MODULE:FUNCTION that accepts the bytes, or, for a capture, the path and a name; empty
        if one reader handles all formats of the kind
    size : MODULE:FUNCTION that returns width and height from the first bytes of a depth image
    """

    name: str
    kind: Kind
    title: str
    suffixes: tuple[str, ...]
    content: str
    signature: str = ""
    media_type: str = BYTES
    reader: str = ""
    size: str = ""

    def begins(self, head: bytes) -> bool:
        """Return whether the first bytes of a file match this format's signature."""
        return bool(self.signature) and _pattern(self.signature).match(head) is not None


@lru_cache(maxsize=64)
def _pattern(signature: str) -> re.Pattern[bytes]:
    return re.compile(signature.encode("latin-1"))


_PCD = r"[\r\n]*(?:#[^\n]{0,200}\n[\r\n]*){0,99}(?:VERSION|FIELDS|COLUMNS)[ \t]"
_PLY = r"ply[\n\r ]"
_PNG = r"\x89PNG\r\n\x1a\n"
_NUMPY = r"\x93NUMPY"
#: NPY signature that captures width and height if the shape has two numbers.
_NUMPY_IMAGE = _NUMPY + r"(?:[^}]*'shape': *\((?=\d+, *(\d+)\))(\d+))?"
#: Signature of NPY files of floating-point numbers with three or four columns.
_NUMPY_ROWS = (
    _NUMPY + r"[\s\S]{4,6}(?=[^}]*'descr': *'[<>]f[248]')(?=[^}]*'shape': *\(\d+L?, *[34]L?,? *\))"
)
#: CDR header of either byte order, followed anywhere by the field names x, y and z.
_CDR = r"\x00[\x00\x01]\x00[\x00-\x03]" + "".join(
    rf"(?=[\s\S]*?(?:\x02\x00\x00\x00|\x00\x00\x00\x02){axis}\x00)"
    for axis in ("[xX]", "[yY]", "[zZ]")
)
_ESTIMATED = "Units and up are estimated"
_SQLITE = r"SQLite format 3\x00"

#: The formats. Where signatures overlap, the more specific format comes first.
FORMATS = (
    Format(
        "png", "depth", "PNG", (".png",),
        "16 bits, one channel, in stored units; 0 and 65535 mean missing",
        _PNG, "image/png", "sceneprint.formats.depth_file:decode_png",
        "sceneprint.formats.depth_file:png_size",
    ),
    Format(
        "npy", "depth", "NPY", (".npy",),
        "two dimensions: float16, 32 or 64 in metres, or uint16 in stored units",
        _NUMPY_IMAGE, "application/x-npy", "sceneprint.formats.depth_file:decode_npy",
        "sceneprint.formats.depth_file:npy_size",
    ),
    Format(
        "pfm", "depth", "PFM", (".pfm",), "one channel of float32 metres, either byte order",
        r"Pf[\n\r ]+(?:(\d+) +(\d+))?", "image/x-portable-floatmap",
        "sceneprint.formats.pfm:decode_pfm", "sceneprint.formats.pfm:pfm_size",
    ),
    Format(
        "compresseddepth", "depth", "compressedDepth of ROS", (),
        "the data of a message: a 12-byte header and a PNG, 16UC1 or 32FC1",
        r"[\s\S]{12}" + _PNG, BYTES, "sceneprint.formats.depth_file:decode_transported",
        "sceneprint.formats.depth_file:transported_size",
    ),
    Format(
        "ply", "cloud", "PLY", (".ply",),
        "ascii, binary of either byte order; element `vertex` with scalar `x`, `y`, `z` of any "
        "type. Other properties, lists and elements are skipped",
        _PLY, "application/ply", "sceneprint.formats.points.ply:read_ply",
    ),
    Format(
        "pcd", "cloud", "PCD", (".pcd",),
        "`ascii`, `binary`, `binary_compressed`; versions .5 to .7; `x`, `y`, `z` (or `X`, `Y`, "
        "`Z`) of any type, organised clouds row by row; the translation of `VIEWPOINT`",
        _PCD, BYTES, "sceneprint.formats.points.pcd:read_pcd",
    ),
    Format(
        "las", "cloud", "LAS, LAZ", (".las", ".laz"),
        "1.0 to 1.4, point formats 0 to 10; LAZ in chunks of fixed or variable size (COPC), with "
        "the extra `las`. Noise points are read as points; classes, returns, time, colour and "
        "waveforms are ignored",
        "LASF", BYTES, "sceneprint.formats.points.las:read_las",
    ),
    Format(
        "npy", "cloud", "NPY", (".npy",),
        "(N, 3) or (N, 4) of float16, 32 or 64, either byte order, C or Fortran order; the fourth "
        "column is ignored. With a camera, an array is a depth image",
        _NUMPY_ROWS, "application/x-npy", "sceneprint.formats.points.cloud:read_npy",
    ),
    Format(
        "kitti", "cloud", "KITTI .bin", (".bin",),
        "x, y, z, intensity as float32, little-endian. The file does not show its format: pass "
        "`format=kitti`. Other row layouts are rejected unless `row` names their values",
        "", BYTES, "sceneprint.formats.points.cloud:read_kitti",
    ),
    Format(
        "pointcloud2", "cloud", "PointCloud2 in CDR", (".cdr",),
        "the message of ROS 2 as `rclpy.serialization.serialize_message` or a subscription with "
        "`raw=True` returns it; for ROS 1, read the bag. Either byte order; `x`, `y`, `z` of any "
        "type and offset, organised or not, padded rows; points at the sensor count as missing",
        _CDR, "application/x-ros-pointcloud2", "sceneprint.formats.points.cloud:read_pointcloud2",
    ),
    Format("pcd", "map", "PCD", (".pcd",), f"points. {_ESTIMATED} (usually z)", _PCD),
    Format(
        "ply", "map", "PLY", (".ply",),
        f"points; with an element `face`, a mesh (polygons become fans). {_ESTIMATED} (usually z)",
        _PLY,
    ),
    Format(
        "las", "map", "LAS, LAZ", (".las", ".laz"),
        "points. Units are those of the file's coordinate system, else estimated; z is up", "LASF",
    ),
    Format(
        "npy", "map", "NPY", (".npy",), f"points, (N, 3) or (N, 4). {_ESTIMATED} (usually z)",
        _NUMPY_ROWS,
    ),
    Format(
        "e57", "map", "E57", (".e57",),
        "the points of all scans, in one frame, in metres; up is estimated (usually z)", "ASTM-E57",
    ),
    Format(
        "stl", "map", "STL", (".stl",), f"a mesh, ascii or binary. {_ESTIMATED} (usually z)",
    ),
    Format(
        "obj", "map", "OBJ", (".obj",),
        "a mesh; points if there are no faces. Materials are ignored. "
        f"{_ESTIMATED} (usually y)",
    ),
    Format(
        "glb", "map", "glTF", (".glb",),
        "all triangles of the scene; points if there are none. Textures are ignored. Units are "
        "metres, y is up", "glTF",
    ),
    Format(
        "gltf", "map", "glTF", (".gltf",), "like `.glb`, with embedded buffers",
    ),
    Format(
        "zip", "archive", "zip", (".zip",), "folders of frames",
        r"PK(?:\x03\x04|\x05\x06)", "application/zip",
    ),
    Format(
        "tar", "archive", "tar", (".tar",), "folders of frames",
        r"[\s\S]{257}ustar", "application/x-tar",
    ),
    Format(
        "gzip", "archive", "tar.gz", (".gz", ".tgz"), "a tar", r"\x1f\x8b", "application/gzip",
    ),
    Format(
        "bzip2", "archive", "tar.bz2", (".bz2", ".tbz2"), "a tar", "BZh", "application/x-bzip2",
    ),
    Format(
        "xz", "archive", "tar.xz", (".xz", ".txz"), "a tar", r"\xfd7zXZ\x00", "application/x-xz",
    ),
    Format(
        "mcap", "recording", "MCAP", (".mcap",), "messages of ROS 2 and ROS 1",
        r"\x89MCAP0\r\n",
    ),
    Format(
        "rosbag2", "recording", "rosbag2", (".db3",),
        "the file, or the folder with its `metadata.yaml`", _SQLITE,
    ),
    Format(
        "rosbag1", "recording", "ROS 1", (".bag",), "version 2.0", "#ROSBAG V2",
    ),
    Format(
        "rtabmap", "capture", "RTAB-Map", (".db",), "depth, laser scans and poses of a database",
        _SQLITE,
    ),
    Format(
        "e57", "capture", "E57", (".e57",), "each scan with its pose", "ASTM-E57",
        reader="sceneprint.formats.exports.e57_scans:e57_sequence",
    ),
    Format(
        "record3d", "capture", "Record3D", (".r3d",), "depth and poses of a capture",
        r"PK\x03\x04", reader="sceneprint.formats.exports.record3d:record3d_sequence",
    ),
)  # fmt: skip


def formats_of(*kinds: Kind) -> tuple[Format, ...]:
    """Return the formats of the given kinds, in the order of the table."""
    return tuple(entry for entry in FORMATS if entry.kind in kinds)


def media_types_of(*kinds: Kind) -> tuple[str, ...]:
    """Return the media types of the given kinds; the last is `BYTES`, valid for any file."""
    media_types = dict.fromkeys(entry.media_type for entry in formats_of(*kinds))
    return (*(media_type for media_type in media_types if media_type != BYTES), BYTES)


def titles_of(*kinds: Kind, last: str = "and") -> str:
    """Return the titles of the given kinds as an enumeration, such as "PNG, NPY and PFM"."""
    *most, final = dict.fromkeys(entry.title for entry in formats_of(*kinds))
    return f"{', '.join(most)} {last} {final}"


def format_at(head: bytes, *kinds: Kind) -> Format | None:
    """Return the format that the first `HEAD` bytes of a file indicate, or None."""
    return next((entry for entry in formats_of(*kinds) if entry.begins(head)), None)


#: First bytes of other files that are sent as frames, and what to do.
_FOREIGN = (
    (b"version https://git-lfs", "This is a pointer of Git LFS. Run `git lfs pull`."),
    (b"\x1f\x8b", "This is compressed by gzip. Decompress it."),
    (b"PK\x03\x04", "This is a zip or NPZ archive. Extract it."),
    (b"<!DOCTYPE", "This is a web page. Download the file itself."),
    (b"<html", "This is a web page. Download the file itself."),
)


def foreign_file(head: bytes) -> str:
    """Return what to do with a file that contains no frame, with a trailing space, or ""."""
    return next((f"{text} " for start, text in _FOREIGN if head.startswith(start)), "")


def format_named(file: str, *kinds: Kind) -> Format | None:
    """Return the format that the suffix of a file name indicates, or None.

    If several kinds use the suffix, the first one in the table is returned.
    """
    suffix = PurePath(file).suffix.lower()
    return next((entry for entry in formats_of(*kinds) if suffix in entry.suffixes), None)


def format_of(head: bytes) -> CloudFormat | None:
    """Return the point cloud format of a file from its first `HEAD` bytes; None for KITTI files."""
    entry = format_at(head, "cloud")
    return None if entry is None else cast(CloudFormat, entry.name)


def is_cloud(file: str) -> bool:
    """Return whether files of this name always contain points; an .npy may be a depth image."""
    entry = format_named(file, "depth", "cloud")
    return entry is not None and entry.kind == "cloud"


@lru_cache(maxsize=64)
def function_at(place: str) -> Callable[..., Any]:
    """Import and return the function with the name MODULE:FUNCTION."""
    module, _, name = place.partition(":")
    function: Callable[..., Any] = getattr(import_module(module), name)
    return function
