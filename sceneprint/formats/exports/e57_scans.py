"""Reading of the scans of an E57 file as frames: clouds with the poses of their scanner.

path  --e57_sequence-->  FrameSequence
"""

from __future__ import annotations

import io
import mmap
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sceneprint.errors import DatasetError, UnreadableCloud
from sceneprint.formats.dataset.frame_reference import (
    FrameReference,
    FrameSequence,
    Layout,
    count_lost,
)
from sceneprint.formats.depth_file import encode_npy
from sceneprint.formats.points.cloud import FEWEST_POINTS, MOST_POINTS, thinned
from sceneprint.formats.points.e57 import E57Scan, read_e57, with_viewpoint
from sceneprint_client.files import naming
from sceneprint_client.sidecars import CloudSource

#: Maximum distance of a point from its scanner, metres. Scanners store larger values for sky.
_FARTHEST_M = 5_000.0


@dataclass(frozen=True)
class E57Source:
    """The source of a frame's bytes: a scan in an E57 file.

    `place`: index of the scan in the file.
    """

    path: Path
    place: int

    def read_bytes(self) -> bytes:
        """Return an NPY file of points (N, 3), float32 metres in the axes of the scan.

        A scan with more than 5 million points is thinned like an upload.

        Raise UnreadableCloud if the file is damaged or cannot be read.
        """
        with naming(f"{self.path}, scan {self.place + 1}"), _open_scans(self.path) as scans:
            if self.place >= len(scans):
                raise UnreadableCloud("The scan no longer exists in the file. Read the file again.")
            scan = scans[self.place]
            points, n = np.empty((scan.count, 3), np.float32), 0
            with np.errstate(all="ignore"):  # points with NaN are missing
                for block in scan.points().blocks:
                    near = block[(np.abs(block) <= _FARTHEST_M).all(axis=1)]
                    points[n : n + len(near)] = near
                    n += len(near)
        points = points[:n]
        if n > MOST_POINTS:
            points, _ = thinned(points, MOST_POINTS)
        return encode_npy(points)


@contextmanager
def _open_scans(path: Path) -> Iterator[tuple[E57Scan, ...]]:
    try:
        with path.open("rb") as file:
            if file.seek(0, io.SEEK_END) == 0:
                raise UnreadableCloud("The file is empty. Copy it again.")
            data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
            yield read_e57(data)  # the memory is unmapped when the last scan is freed
    except OSError as cause:
        raise UnreadableCloud(
            f"The file cannot be read ({cause.strerror}). Copy it again."
        ) from cause


def e57_sequence(path: Path, name: str) -> FrameSequence:
    """Return the scans of an E57 file that have a viewpoint, as a sequence.

    Returns
    -------
    sequence : sequence whose `note` lists the omitted scans

    Raises
    ------
    DatasetError : If the file is damaged, or has only merged clouds.
    """
    try:
        with _open_scans(path) as scans:
            have_viewpoint = with_viewpoint(scans)
            left_out = Counter[str]()
            frames = list[FrameReference]()
            for place, (scan, has_viewpoint) in enumerate(zip(scans, have_viewpoint, strict=True)):
                if scan.count < FEWEST_POINTS:
                    left_out["scans without points"] += 1
                elif not has_viewpoint:
                    left_out["clouds without a viewpoint"] += 1
                else:
                    frames.append(_make_frame(path, name, place, scan))
            dense = sum(scan.count > MOST_POINTS for scan in scans)
    except UnreadableCloud as cause:
        raise DatasetError(f"{path}: {cause}") from cause
    reasons = ", ".join(f"{count} {reason}" for reason, count in left_out.items())
    if not frames:
        raise DatasetError(
            f"{path}: No scan of the file has a single viewpoint ({reasons}). Upload the file as a "
            "whole with --as-map, or export structured scans with their poses."
        )
    note = f"{len(frames)} of {len(scans)} scans used"
    note += f"; skipped: {reasons}" if reasons else ""
    note += f"; {dense} scans with more than {MOST_POINTS} points are thinned" if dense else ""
    lost = count_lost(left_out)
    return FrameSequence(name, path, Layout.E57, name, None, tuple(frames), note, lost=lost)


def _make_frame(path: Path, name: str, place: int, scan: E57Scan) -> FrameReference:
    label = f"scan-{place + 1:04d}"
    return FrameReference(
        f"{name}/{label}",
        path / label,
        None,
        None,
        scan.T_world_scan if scan.has_pose else None,
        CloudSource(),
        source=E57Source(path, place),
        original=scan.name or label,
        sequence=place,
    )
