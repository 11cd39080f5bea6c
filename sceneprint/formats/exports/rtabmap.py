"""Reading of RTAB-Map databases: depth images or laser scans of nodes, with optimised poses.

path  --rtabmap_sequences-->  FrameSequence, ...

The reader supports rtabmap 0.10 to 0.23 (tables Node, Data and Admin). The file is not trusted: it
is opened read-only, code in its schema is not run, and queries are limited.
"""

from __future__ import annotations

import math
import re
import sqlite3
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from sceneprint.errors import DatasetError, InvalidIntrinsics
from sceneprint.formats.dataset.frame_reference import (
    FrameReference,
    FrameSequence,
    Layout,
    count_lost,
)
from sceneprint.formats.depth_file import encode_npy, encode_png
from sceneprint.formats.exports.rtabmap_blobs import (
    DEPTH_HEAD,
    BrokenBlob,
    RtabmapCamera,
    Version,
    cameras,
    depth_samples,
    depth_size,
    is_solid,
    matrix,
    scan_placement,
    scan_points,
    transform,
)
from sceneprint.types import Floats, Intrinsics
from sceneprint_client.api.base import GivenBase
from sceneprint_client.errors import printable
from sceneprint_client.sidecars import Camera, CloudSource

_SIGNATURE = b"SQLite format 3\0"
#: Maximum size of a value, bytes; maximum number of SQLite instructions, in units of 100,000; and
#: maximum number of nodes.
_MAXIMUM_VALUE, _MOST_STEPS, _MOST_NODES = 256 << 20, 20_000, 1_000_000
_COLUMNS = {
    "Node": {"id", "map_id", "stamp", "pose"},
    "Data": {"id", "depth", "calibration"},
    "Admin": {"version"},
}
_OLDEST, _NEWEST = (0, 10, 0), (0, 23, 99)
_REPROCESS = "rtabmap-reprocess old.db new.db"
_EXPORT_CLOUD = "export its cloud with `rtabmap-export --cloud` and upload that with --as-map"


def is_rtabmap(path: Path) -> bool:
    """Return whether a path may be a database of RTAB-Map, by its suffix and first bytes."""
    if path.suffix.lower() != ".db":
        return False
    try:
        with path.open("rb") as file:
            return path.is_file() and file.read(len(_SIGNATURE)) == _SIGNATURE
    except OSError:  # the reader reports the error
        return False


#: Intrinsics of a camera's part of the depth image, and T_base_camera.
_NodeCamera = tuple[Intrinsics, Floats]


@dataclass(eq=False)
class _Node:
    """A node of the graph, without its images."""

    id: int
    session: int
    stamp: float
    pose: Floats | None
    cameras: tuple[_NodeCamera, ...] = ()  #: cameras with depth
    scan: tuple[int, Floats] | None = None  #: format and T_base_scan of the laser scan


@dataclass(frozen=True)
class RtabmapDepth:
    """The source of a frame's bytes: the depth image of a node's camera.

    Parameters
    ----------
    node : id of the node
    camera, cameras : index of the camera from the left, and number of cameras that share the image
    """

    path: Path
    node: int
    camera: int
    cameras: int

    def read_bytes(self) -> bytes:
        """Return a 16-bit PNG of millimetres, or an NPY file of float metres.

        Raise DatasetError if the database cannot be read. Raise UnreadableFrame if the image is
        damaged or missing.
        """
        blob = _read_value(self.path, "depth", self.node)
        kind = depth_size(blob[:DEPTH_HEAD])
        if self.cameras == 1 and kind is not None and kind[0] == "millimetres":
            return blob
        samples = depth_samples(blob)
        width = samples.shape[1] // self.cameras
        part = np.s_[:, self.camera * width : (self.camera + 1) * width]
        if samples.dtype == np.uint16:
            return encode_png(samples[part].astype(np.uint16))
        return encode_npy(samples[part].astype(np.float32))


@dataclass(frozen=True)
class RtabmapScan:
    """The source of a frame's bytes: the laser scan of a node.

    Parameters
    ----------
    node : id of the node
    form : rtabmap's format number of the points; 0 if not stored
    """

    path: Path
    node: int
    form: int

    def read_bytes(self) -> bytes:
        """Return an NPY file of points (N, 3), metres.

        Raise DatasetError if the database cannot be read. Raise UnreadableCloud if the scan is
        damaged or two-dimensional.
        """
        return encode_npy(scan_points(_read_value(self.path, "scan", self.node), self.form))


def rtabmap_sequences(path: Path, name: str | None = None) -> tuple[FrameSequence, ...]:
    """Return the frames of a database: a sequence of depth images per parent frame and camera, or,
    if no node has depth, a sequence of laser scans per parent frame.

    The poses are the optimised poses that rtabmap stores when it closes a database. If they are
    missing, odometry provides the poses, and each session has a separate parent frame.

    Parameters
    ----------
    name : name of the sequences; default: name of the file

    Returns
    -------
    sequences : at least one sequence; the `note` of each lists the omitted nodes

    Raises
    ------
    DatasetError : If the file is not an RTAB-Map database, has an unsupported version, is in use or
        damaged, or no node has depth or a three-dimensional laser scan.
    """
    name = name or path.stem
    with _open_database(path) as database:
        version = _read_version(path, database)
        optimised = _read_optimised_poses(database)
        left_out: Counter[str] = Counter()
        nodes = [
            node for node in _read_nodes(path, database, version, optimised, left_out)
            if node.cameras or node.scan is not None
        ]  # fmt: skip
    if any(node.cameras for node in nodes):
        left_out["laser scans without depth"] += sum(not node.cameras for node in nodes)
        nodes = [node for node in nodes if node.cameras]
    if not nodes:
        raise DatasetError(
            f"{path}: No node has a depth image or a three-dimensional laser scan"
            f"{_list_counts(left_out, ' (', ')')}. Record with a depth camera or a 3D LiDAR and "
            f"with `Mem/BinDataKept` set to true, or {_EXPORT_CLOUD}."
        )
    sequences: list[FrameSequence] = []
    for world, of_world in _group_by_parent(name, nodes, optimised is not None):
        sequences += _make_sequences(path, name, world, of_world)
    note = _describe(sequences, optimised is not None, left_out)
    sequences[0] = replace(sequences[0], lost=count_lost(left_out))
    return tuple(replace(sequence, note=note) for sequence in sequences)


@contextmanager
def _open_database(path: Path) -> Iterator[sqlite3.Connection]:
    """Yield an untrusted database, opened with restrictions.

    Raise DatasetError if the database has an unfinished journal, or SQLite raises an error.
    """
    for suffix in ("-wal", "-journal"):
        beside = path.with_name(path.name + suffix)
        if beside.is_file() and beside.stat().st_size:
            raise DatasetError(
                f"{path}: The database has an unfinished journal {beside.name}. Close RTAB-Map. If "
                "it crashed, open the database in RTAB-Map once."
            )
    try:
        # with immutable=1, SQLite creates no locks and no other files
        uri = f"file:{quote(str(path.absolute()))}?mode=ro&immutable=1"
        with closing(sqlite3.connect(uri, uri=True)) as database:
            database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _MAXIMUM_VALUE)
            database.setlimit(sqlite3.SQLITE_LIMIT_ATTACHED, 0)
            for pragma in ("trusted_schema=OFF", "cell_size_check=ON", "query_only=ON"):
                database.execute(f"PRAGMA {pragma}")
            database.text_factory = lambda text: text.decode("utf-8", "replace")
            steps = iter(range(_MOST_STEPS))
            database.set_progress_handler(lambda: next(steps, None) is None, 100_000)
            yield database
    # messages of SQLite may quote invalid UTF-8 from the file
    except (sqlite3.Error, UnicodeDecodeError, OverflowError, MemoryError) as cause:
        reason = printable(f"{cause!s:.120}")
        raise DatasetError(
            f"{path}: The database cannot be read ({reason}). Copy it again, or repair it with "
            "`rtabmap-recovery`."
        ) from cause


def _read_version(path: Path, database: sqlite3.Connection) -> Version:
    """Return the RTAB-Map version of a database.

    Raise DatasetError if tables or columns are missing, or the version is not supported.
    """
    tables = database.execute("SELECT name FROM sqlite_schema WHERE type = 'table'").fetchmany(500)
    names = {str(row[0]) for row in tables}
    if "Node" not in names or "Link" not in names:
        raise DatasetError(
            f"{path}: This SQLite database has no tables Node and Link, so RTAB-Map did not write "
            "it. Specify an RTAB-Map database."
        )
    text = ""
    if "Admin" in names:
        row = database.execute("SELECT version FROM Admin LIMIT 1").fetchone()
        text = str(row[0]) if row else ""
    match = re.fullmatch(r"(\d{1,4})\.(\d{1,4})\.(\d{1,4})", text)
    version = (int(match[1]), int(match[2]), int(match[3])) if match else (0, 0, 0)
    if version < _OLDEST:
        raise DatasetError(
            f"{path}: The database is from RTAB-Map {printable(text[:20]) or 'before 0.5'}; "
            f"versions before 0.10 are not supported. Convert it with `{_REPROCESS}` of a newer "
            "version."
        )
    for table, columns in _COLUMNS.items():
        rows = database.execute(f"PRAGMA table_info({table})").fetchmany(500)
        missing = columns - {str(row[1]) for row in rows} if table in names else columns
        if missing:
            newer = "newer than 0.23, the last known version" if version > _NEWEST else "incomplete"
            raise DatasetError(
                f"{path}: The table {table} of the database (RTAB-Map {text}, {newer}) lacks "
                f"{', '.join(sorted(missing))}. Convert it with `{_REPROCESS}`, or {_EXPORT_CLOUD}."
            )
    return version


def _read_optimised_poses(database: sqlite3.Connection) -> dict[int, Floats] | None:
    """Return the optimised poses (4, 4) by node; None if the database has none."""
    columns = {str(row[1]) for row in database.execute("PRAGMA table_info(Admin)").fetchmany(500)}
    if not {"opt_ids", "opt_poses"} <= columns:
        return None
    row = database.execute("SELECT opt_ids, opt_poses FROM Admin LIMIT 1").fetchone()
    if row is None or not isinstance(row[0], bytes) or not isinstance(row[1], bytes):
        return None
    try:
        ids, poses = matrix(row[0]).reshape(-1), matrix(row[1])
    except BrokenBlob:
        return None
    if ids.dtype != np.int32 or poses.dtype != np.float32 or poses.size != 12 * ids.size:
        return None
    by_node = {}
    for node, numbers in zip(ids.tolist(), poses.reshape(-1, 12), strict=True):
        try:
            pose = transform(numbers.tobytes())
        except BrokenBlob:
            continue
        if node > 0 and pose is not None:  # landmarks have negative ids
            by_node[node] = pose
    return by_node or None


def _read_nodes(
    path: Path, database: sqlite3.Connection, version: Version,
    optimised: dict[int, Floats] | None, left_out: Counter[str],
) -> Iterator[_Node]:  # fmt: skip
    """Yield the nodes with a pose, in order; count other nodes by reason in `left_out`."""
    columns = {str(row[1]) for row in database.execute("PRAGMA table_info(Data)").fetchmany(500)}
    scan = "substr(d.scan, -12)" if "scan" in columns else "NULL"
    scan += ", d.scan_info" if "scan_info" in columns else ", NULL"
    rows = database.execute(
        f"SELECT n.id, n.map_id, n.stamp, n.pose, substr(d.depth, 1, {DEPTH_HEAD}), d.calibration, "
        f"{scan} FROM Node n JOIN Data d ON d.id = n.id ORDER BY n.id"
    )
    for count, row in enumerate(rows):
        if count == _MOST_NODES:
            raise DatasetError(
                f"{path}: The database has more than {_MOST_NODES} nodes. Split it by sessions."
            )
        try:
            node = _parse_node(row, version, left_out)
        except (BrokenBlob, TypeError, ValueError, OverflowError) as cause:
            left_out[f"damaged nodes ({printable(str(cause))})"] += 1
            continue
        if optimised is not None:
            node.pose = optimised.get(node.id)
        if node.pose is None:
            left_out[f"nodes without {'a' if optimised is None else 'an optimised'} pose"] += 1
            continue
        yield node


def _parse_node(row: tuple[Any, ...], version: Version, left_out: Counter[str]) -> _Node:
    """Convert a row to a node with its odometry pose; count missing data in `left_out`.

    Raise BrokenBlob, TypeError, ValueError or OverflowError if a column has an invalid value.
    """
    number, session, stamp, odometry, head, calibration, scan_tail, scan_info = row
    node = _Node(int(number), int(session), float(stamp or 0.0), None)
    node.pose = transform(odometry) if isinstance(odometry, bytes) else None
    depth = depth_size(head) if isinstance(head, bytes) else None
    if depth is not None and isinstance(calibration, bytes):
        lenses = cameras(calibration, version)
        node.cameras = tuple(
            _scale_camera(lens, depth[1] // len(lenses), depth[2]) for lens in lenses
        )
    elif depth is not None:
        left_out["depth images without a calibration"] += 1
    elif isinstance(head, bytes) and len(head) > 4:
        left_out["stereo images without depth"] += 1
    if isinstance(scan_tail, bytes) and len(scan_tail) == 12:
        form, T_base_scan = scan_placement(scan_info, version)
        if is_solid(scan_tail, form):
            node.scan = form, T_base_scan
        elif not node.cameras:
            left_out["two-dimensional laser scans"] += 1
    return node


def _scale_camera(lens: RtabmapCamera, width: int, height: int) -> _NodeCamera:
    """Return the camera of a depth image of `width` x `height` pixels, from a colour camera.

    Raise BrokenBlob if the images have different aspect ratios, or the camera is invalid.
    """
    across = width / lens.width if lens.width else 1.0
    down = height / lens.height if lens.height else 1.0
    if not math.isclose(across, down, rel_tol=0.02):
        raise BrokenBlob(
            f"depth has {width} x {height} pixels, but the camera has {lens.width} x {lens.height}"
        )
    try:
        # rtabmap scales about (0, 0), and its pixel centres have integer coordinates
        intrinsics = Intrinsics(
            width=width, height=height, fx=lens.fx * across, fy=lens.fy * down,
            cx=lens.cx * across, cy=lens.cy * down,
        )  # fmt: skip
    except InvalidIntrinsics as cause:
        raise BrokenBlob(str(cause)) from cause
    return intrinsics, lens.T_base_camera


def _read_value(path: Path, column: str, node: int) -> bytes:
    """Return a binary value of a node; raise DatasetError if it is missing."""
    with _open_database(path) as database:
        row = database.execute(f"SELECT {column} FROM Data WHERE id = ?", (node,)).fetchone()
    if row is None or not isinstance(row[0], bytes):
        raise DatasetError(
            f"{path}: The column {column} of node {node} no longer has a value. Read the database "
            "again."
        )
    return row[0]


def _group_by_parent(
    name: str, nodes: list[_Node], is_optimised: bool
) -> Iterator[tuple[str, list[_Node]]]:
    """Group nodes by parent frame; yield each parent frame with its nodes."""
    sessions = sorted({node.session for node in nodes})
    if is_optimised or len(sessions) == 1:
        yield name, nodes
        return
    for session in sessions:
        yield f"{name}/map-{session}", [node for node in nodes if node.session == session]


def _make_sequences(
    path: Path, name: str, world: str, nodes: list[_Node]
) -> Iterator[FrameSequence]:
    count = max(len(node.cameras) for node in nodes)
    if not count:
        frames = tuple(_scan_frame(path, name, node) for node in nodes)
        yield FrameSequence(world, path, Layout.RTABMAP, world, None, frames)
    for place in range(count):
        sequence = world if count == 1 else f"{world}/camera-{place}"
        frames = tuple(
            _camera_frame(path, name, node, place) for node in nodes if place < len(node.cameras)
        )
        yield FrameSequence(sequence, path, Layout.RTABMAP, world, None, frames)


def _camera_frame(path: Path, name: str, node: _Node, place: int) -> FrameReference:
    assert node.pose is not None
    count, (intrinsics, T_base_camera) = len(node.cameras), node.cameras[place]
    label = f"{node.id:06d}" if count == 1 else f"{node.id:06d}-{place}"
    return FrameReference(
        f"{name}/{label}",
        path / label,
        Camera(intrinsics),
        node.stamp,
        node.pose @ T_base_camera,
        source=RtabmapDepth(path, node.id, place, count),
        base=GivenBase(matrix=T_base_camera.tolist()),
        original=f"node {label}",
        sequence=node.id,
    )


def _scan_frame(path: Path, name: str, node: _Node) -> FrameReference:
    assert node.scan is not None
    assert node.pose is not None
    form, T_base_scan = node.scan
    return FrameReference(
        f"{name}/{node.id:06d}",
        path / f"{node.id:06d}",
        None,
        node.stamp,
        node.pose @ T_base_scan,
        CloudSource(),
        source=RtabmapScan(path, node.id, form),
        base=GivenBase(matrix=T_base_scan.tolist()),
        original=f"node {node.id:06d}",
        sequence=node.id,
    )


def _describe(sequences: list[FrameSequence], is_optimised: bool, left_out: Counter[str]) -> str:
    """Return a note for users on frames, the source of their poses, and omitted nodes."""
    frames = sum(len(sequence.frames) for sequence in sequences)
    poses = "optimised poses"
    if not is_optimised:
        poses = (
            "odometry poses, because the database has no optimised poses: "
            "open and close it in RTAB-Map to store them"
        )
    return f"{frames} frames used, {poses}{_list_counts(left_out, '; skipped: ', '')}"


def _list_counts(counts: Counter[str], before: str, after: str) -> str:
    parts = [f"{count} {reason}" for reason, count in counts.most_common(6) if count]
    return f"{before}{', '.join(parts)}{after}" if parts else ""
