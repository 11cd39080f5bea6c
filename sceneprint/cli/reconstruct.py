"""`sceneprint reconstruct`: fuse the frames that show the place of a query."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from sceneprint.atomic_files import check_writable, write_whole
from sceneprint.cli import positive
from sceneprint.cli.options import (
    add_filter_options,
    add_seed_option,
    add_service_options,
    filter_of,
    one_line,
    open_client,
)
from sceneprint.errors import DatasetError
from sceneprint.formats.dataset import find_sequences

if TYPE_CHECKING:
    from sceneprint_client import Client
    from sceneprint_client.api import Answer
    from sceneprint_client.api.surface import Coverage

#: Longest wait for a worker, seconds.
_TIMEOUT_S = 600.0


def add_reconstruct(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint reconstruct`."""
    command.add_argument("map", metavar="MAP")
    command.add_argument(
        "frame", metavar="FRAME", help="a depth image, or the id of a frame of the map"
    )
    command.add_argument(
        "--out", type=Path, default=Path("mesh.ply"), metavar="FILE",
        help="PLY to write (default: mesh.ply)",
    )  # fmt: skip
    command.add_argument(
        "--k",
        type=positive,
        default=10,
        metavar="K",
        help="number of accepted matches to fuse (default: 10)",
    )
    add_seed_option(command)
    command.add_argument(
        "--voxel",
        type=float,
        metavar="METRES",
        help="size of a voxel (default: the finest that fits)",
    )
    command.add_argument(
        "--strong", action="store_true", help="fuse only strongly accepted matches"
    )
    command.add_argument("--cloud", action="store_true", help="write points without triangles")
    command.add_argument(
        "--without-query", action="store_true", help="fuse only the matches, not the frame itself"
    )
    add_filter_options(command)
    add_service_options(command)
    command.set_defaults(run=run_reconstruct)


def run_reconstruct(options: argparse.Namespace) -> int:
    """Query a map with a depth frame, and let a worker fuse the accepted matches to a surface in
    the camera frame of the query. Exit code 1 if no match is accepted.
    """
    check_writable(options.out)
    with open_client(options) as client:
        answer = _query(client, options)
        name = one_line(options.frame)
        if answer.status != "found":
            print(f"{name}: {answer.status.replace('_', ' ')}, so there is nothing to fuse")
            return 1
        job = client.reconstruct(
            answer,
            strength="strong" if options.strong else "any",
            include_query=not options.without_query,
            voxel_m=options.voxel,
            output="cloud" if options.cloud else "mesh",
        )
        job = client.wait_for_product(job, timeout_s=_TIMEOUT_S)
        if job.result is None:
            why = one_line(job.error or "no worker has finished it yet; see `sceneprint jobs`")
            print(f"sceneprint reconstruct: job {job.job_id} is {job.state}: {why}",
                  file=sys.stderr)  # fmt: skip
            return 2
        print("\n".join([f"{name}:", *coverage_lines(job.result)]))
        write_whole(options.out, client.reconstruction_mesh(job.job_id))
        print(f"wrote {one_line(str(options.out))}")
    return 0


def coverage_lines(coverage: Coverage) -> list[str]:
    """Return the lines that describe what the views show together."""
    lines = [
        f"  {len(coverage.views)} views show {coverage.area_m2:.2f} m2 of surface and "
        f"{coverage.observed_volume_m3:.2f} m3 of space; {coverage.query_explained:.0%} of the "
        "frame is covered by the others"
    ]
    total = 0.0
    for view in coverage.views:
        total += view.added_m2
        who = "the frame itself" if view.frame_id is None else view.frame_id
        rank = "" if view.rank is None else f"rank {view.rank}, {view.strength}"
        lines.append(f"  {who:34} {rank:18} +{view.added_m2:6.2f} m2  {total:7.2f}".rstrip())
    lines += [f"  skipped: {one.frame_id}: {one_line(one.reason)}" for one in coverage.left_out]
    kind = f"{coverage.triangles} triangles" if coverage.triangles else "a cloud"
    lines.append(f"  {coverage.points} points, {kind}, voxels of {1000 * coverage.voxel_m:.0f} mm")
    return lines


def _query(client: Client, options: argparse.Namespace) -> Answer:
    wanted, path = filter_of(options), Path(options.frame)
    if not path.exists():
        return client.query(
            options.map, frame_id=options.frame, k=options.k, seed=options.seed, filter=wanted
        )
    frames = [frame for sequence in find_sequences(path) for frame in sequence.frames]
    if len(frames) != 1:
        raise DatasetError(f"{path}: {len(frames)} frames found. Name a single frame file.")
    return client.query(options.map, frames[0], k=options.k, seed=options.seed, filter=wanted)
