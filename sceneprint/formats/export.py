"""Export of points and surfaces as PLY or as bytes for web pages, and of pose graphs as g2o.

points, normals, colours, faces, edges  --write_ply-->  bytes of a PLY file
points, normals, patches, residuals  --encode_points-->  bytes for web pages, 12 per point
poses, PoseEdge, ...  --g2o-->  VERTEX_SE3:QUAT, EDGE_SE3:QUAT

The bytes for web pages are little-endian. The header has 48 bytes:

    0  4 x u8   "SPPT"
    4  u16      version, 1
    6  u16      flags of the present columns: 1 normals, 2 patches, 4 residuals
    8  u32      number of points
    12 u32      bytes per point, 12
    16 3 x f32  origin, metres
    28 3 x f32  extent, metres
    40 u32      number of points before thinning
    44 f32      distance of a residual of 250 at short range, metres (the tolerance of
                the model's validation, which grows with distance); 0 if there are none

12 bytes per point follow:

    0  3 x u16  position: origin + value / 65535 * extent
    6  u16      index of the validation patch; 65535 for none
    8  3 x i8   normal, times 127
    11 u8       residual, the distance from the surface of another frame: 1 to 250; 253 if the point
                is outside that frame's view, or beside or behind its surface; 254 if that frame
                observed free space at the point; 255 if the point was not compared

`PoseEdge` has the information matrix of the right perturbation T exp(xi), xi = (shift in metres,
turn in radians) in the axes of the edge's second vertex. The error in g2o is the shift and the
*vector part of the quaternion* of Z^-1 X_i^-1 X_j: half of a small turn. Therefore, the information
in g2o is four times as large for turns, and twice as large between shift and turn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.types import Bytes, Floats, Floats32, Ints32, Surface
from sceneprint_client.api.results import MOST_DRAWN
from sceneprint_client.poses import quaternion_of
from sceneprint_client.surface_encoding import (
    HEADER,
    MAGIC,
    NO_PATCH,
    NORMALS,
    PATCHES,
    POINT,
    RESIDUALS,
    VERSION,
)

Ints = NDArray[np.int32] | NDArray[np.int64]

#: PLY names of numpy types.
_WORDS = {"<f4": "float", "u1": "uchar"}


def write_ply(
    points: Floats | Floats32,
    normals: Floats | Floats32 | None = None,
    colours: Bytes | None = None,
    faces: Ints | None = None,
    edges: Ints | None = None,
    comments: Sequence[str] = (),
) -> bytes:
    """Encode points as a binary little-endian PLY file; equal arrays give equal bytes.

    Parameters
    ----------
    points : (N, 3) metres
    normals : (N, 3) unit vectors
    colours : (N, 3) red, green, blue
    faces : (F, 3) triangles, as indices of points
    edges : (E, 2) lines, as indices of points
    comments : header lines, such as the coordinate frame; escaped to printable ASCII

    Raises
    ------
    ValueError : If an array has another shape, or an index is out of range.
    """
    n = len(points)
    kinds = [(name, "<f4") for name in "xyz"]
    columns = [_require_shape(points, n, 3)]
    if normals is not None:
        kinds += [(name, "<f4") for name in ("nx", "ny", "nz")]
        columns.append(_require_shape(normals, n, 3))
    if colours is not None:
        kinds += [(name, "u1") for name in ("red", "green", "blue")]
        columns.append(_require_shape(colours, n, 3))
    rows = np.empty(n, np.dtype(kinds))
    for i, (name, _) in enumerate(kinds):
        rows[name] = columns[i // 3][:, i % 3]
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment {_escape(comment)}" for comment in comments]
    lines += [f"element vertex {n}"]
    lines += [f"property {_WORDS[kind]} {name}" for name, kind in kinds]
    parts = [rows.tobytes()]
    if faces is not None:
        table = np.empty(len(faces), np.dtype([("count", "u1"), ("points", "<i4", 3)]))
        table["count"], table["points"] = 3, _require_indices(faces, 3, n)
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        parts.append(table.tobytes())
    if edges is not None:
        lines += [f"element edge {len(edges)}", "property int vertex1", "property int vertex2"]
        parts.append(_require_indices(edges, 2, n).astype("<i4").tobytes())
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii") + b"".join(parts)


def points_of(surface: Surface) -> tuple[Floats32, Floats32]:
    """Return points (N, 3) and normals (N, 3) of the valid pixels in the sensor's frame."""
    return surface.points[surface.valid], surface.normals[surface.valid]


def _require_shape(
    values: Floats | Floats32 | Bytes, n: int, width: int
) -> Floats | Floats32 | Bytes:
    if values.shape != (n, width):
        raise ValueError(f"an array has the shape {values.shape}, not ({n}, {width})")
    return values


def _require_indices(values: Ints, width: int, n: int) -> Ints:
    if values.ndim != 2 or values.shape[1] != width:
        raise ValueError(f"indices have the shape {values.shape}, not (any, {width})")
    if values.size and (values.min() < 0 or values.max() >= n):
        raise ValueError(f"indices range from {values.min()} to {values.max()} for {n} points")
    return values


def _escape(comment: str) -> str:
    """Escape a comment to one line of ASCII, since names of frames are arbitrary."""
    return comment.encode("unicode_escape").decode("ascii")


MEDIA_TYPE = "application/vnd.sceneprint.points"
NOT_COMPARED = 255
#: Default and maximum number of points.
LIMIT, MOST = MOST_DRAWN, 100_000

Indices = NDArray[np.intp]


def encode_points(
    points: Floats | Floats32,
    normals: Floats | Floats32 | None = None,
    patches: Ints32 | None = None,
    residuals: Bytes | None = None,
    *,
    total: int | None = None,
    scale: float = 0.0,
) -> bytes:
    """Encode points in the format of the module's docstring; equal arrays give equal bytes.

    Parameters
    ----------
    points : (N, 3) metres
    normals : (N, 3) unit vectors
    patches : (N,) indices of patches; -1 or at least NO_PATCH for none
    residuals : (N,) residuals as in the module's docstring
    total : number of points before thinning; None means N
    scale : distance of a residual of 250, metres
    """
    n = len(points)
    at = np.asarray(points, np.float64)
    low, high = (at.min(axis=0), at.max(axis=0)) if n else (np.zeros(3), np.zeros(3))
    origin = low.astype(np.float32)
    extent = (high - origin).clip(0).astype(np.float32)
    unit = np.where(extent > 0, extent, 1.0).astype(np.float64)
    rows = np.empty(n, POINT)
    rows["position"] = np.rint((at - origin) / unit * 65535.0).clip(0, 65535)
    rows["patch"] = NO_PATCH
    if patches is not None:
        rows["patch"] = np.where((patches >= 0) & (patches < NO_PATCH), patches, NO_PATCH)
    rows["normal"] = 0 if normals is None else np.rint(normals * 127.0).clip(-127, 127)
    rows["residual"] = NOT_COMPARED if residuals is None else residuals
    columns = ((NORMALS, normals), (PATCHES, patches), (RESIDUALS, residuals))
    flags = sum(flag for flag, values in columns if values is not None)
    head = HEADER.pack(
        MAGIC, VERSION, flags, n, POINT.itemsize, *origin.tolist(), *extent.tolist(),
        n if total is None else total, scale,
    )  # fmt: skip
    return head + rows.tobytes()


def thinned(count: int, limit: int) -> Indices:
    """Return sorted indices of a fixed pseudorandom subset of at most `limit` of `count` points."""
    if count <= limit:
        return np.arange(count)
    keys = np.arange(1, count + 1, dtype=np.uint64)  # hash by SplitMix64
    keys *= np.uint64(0x9E3779B97F4A7C15)
    keys = (keys ^ (keys >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    keys = (keys ^ (keys >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.sort(np.argsort(keys, kind="stable")[:limit])


#: Factors from (shift, vector part of the quaternion) to xi.
_PER_QUATERNION = np.array([1.0, 1.0, 1.0, 2.0, 2.0, 2.0])


@dataclass(frozen=True, eq=False)
class PoseEdge:
    """An edge of a pose graph: the relative pose of two vertices.

    Parameters
    ----------
    first, second : indices of the vertices
    T : (4, 4) T_first_second
    information : (6, 6) information matrix of xi in T exp(xi): shift (metres) before turn
        (radians), in the axes of `second`
    """

    first: int
    second: int
    T: Floats
    information: Floats


def g2o(poses: Sequence[Floats], edges: Sequence[PoseEdge]) -> str:
    """Format a pose graph as g2o: vertices numbered from 0, then edges.

    The text has no other lines: some readers reject comments and fixed vertices.

    `poses`: (4, 4) T_parent_vertex of each vertex.
    """
    lines = [f"VERTEX_SE3:QUAT {i} {_format_pose(pose)}" for i, pose in enumerate(poses)]
    upper = np.triu_indices(6)
    for edge in edges:
        information = edge.information * np.outer(_PER_QUATERNION, _PER_QUATERNION)
        numbers = " ".join(f"{value:.9g}" for value in information[upper].tolist())
        lines.append(f"EDGE_SE3:QUAT {edge.first} {edge.second} {_format_pose(edge.T)} {numbers}")
    return "\n".join([*lines, ""])


def information_of(covariance: Floats, T: Floats) -> Floats:
    """Convert a covariance to the information matrix (6, 6) of a `PoseEdge`.

    Parameters
    ----------
    covariance : (6, 6) covariance of T in the axes of the edge's first vertex, as in
        `geometry.covariance`: errors are added to the translation, and multiply the rotation from
        the left
    T : (4, 4) T_first_second
    """
    # [exp(r) R, t + x] = T exp(xi) with x = R shift and r = R turn
    axes = np.kron(np.eye(2), T[:3, :3])
    information: Floats = axes.T @ np.linalg.inv(covariance) @ axes
    return (information + information.T) / 2.0


def _format_pose(T: Floats) -> str:
    numbers = [*T[:3, 3].tolist(), *quaternion_of(T[:3, :3]).tolist()]
    return " ".join(f"{value:.9f}" for value in numbers)
