"""`sceneprint reconstruct`: what a place looks like, fused from the frames found there."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from sceneprint.cli.connection import add_service_options, one_line, open_client
from sceneprint.cli.filters import add_filter_options, filter_of
from sceneprint.cli.numbers import positive, whole
from sceneprint.datasets import FrameReference, find_sequences
from sceneprint.errors import DatasetError
from sceneprint.writing import check_writable, write_whole

if TYPE_CHECKING:
    from sceneprint.client import Client
    from sceneprint.schemas import Answer
    from sceneprint.schemas.reconstructions import Coverage, Reconstruction

#: Longest wait for a worker, seconds.
_PATIENCE_S = 600.0


def add_to(commands: Any) -> None:
    """Describe the command to the parser."""
    command = commands.add_parser(
        "reconstruct",
        help="fuse what was seen at a frame's place to a mesh and a picture",
        description="Look a depth frame up in a map, and let a worker fuse its accepted matches, "
        "moved into its camera frame, to a surface. Exit code 1 where no match is accepted.",
    )
    command.add_argument("map", metavar="MAP")
    command.add_argument(
        "frame", metavar="FRAME", help="a depth image, or the id of a frame of the map"
    )
    command.add_argument("--out", type=Path, metavar="FILE", help="PLY to write (mesh.ply)")
    command.add_argument("--picture", type=Path, metavar="FILE", help="PNG to write")
    command.add_argument(
        "--k", type=positive, default=10, metavar="K", help="accepted matches wanted (default: 10)"
    )
    command.add_argument(
        "--seed", type=whole, default=0, metavar="S", help="of the random choices (default: 0)"
    )
    command.add_argument(
        "--voxel", type=float, metavar="METRES", help="edge of a voxel (default: as fine as fits)"
    )
    command.add_argument("--strong", action="store_true", help="only strongly accepted matches")
    command.add_argument("--cloud", action="store_true", help="points without triangles")
    command.add_argument(
        "--without-query", action="store_true", help="fuse the matches alone, not the frame itself"
    )
    add_filter_options(command)
    add_service_options(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Query, reconstruct, and write the files; returns 1 where nothing could be fused."""
    out = options.out
    if out is None and options.picture is None:
        out = Path("mesh.ply")
    for path in (out, options.picture):
        if path is not None:
            check_writable(path)
    with open_client(options) as client:
        answer = _asked(client, options)
        name = one_line(options.frame)
        if answer.status != "found":
            print(f"{name}: {answer.status.replace('_', ' ')}, so there is nothing to fuse")
            return 1
        made = client.reconstruct(
            answer,
            strength="strong" if options.strong else "any",
            include_query=not options.without_query,
            voxel_m=options.voxel,
            output="cloud" if options.cloud else "mesh",
        )
        made = _waited(client, made, answer.counts.accepted)
        if made.coverage is None:
            why = one_line(made.error or "no worker has done it yet; see `sceneprint jobs`")
            print(f"sceneprint reconstruct: job {made.job_id} is {made.state}: {why}",
                  file=sys.stderr)  # fmt: skip
            return 2
        print("\n".join([f"{name}:", *lines_of(made.coverage)]))
        for path, fetch in (
            (out, client.reconstruction_mesh),
            (options.picture, client.reconstruction_picture),
        ):
            if path is not None:
                write_whole(path, fetch(made.job_id))
                print(f"wrote {one_line(str(path))}")
    return 0


def lines_of(coverage: Coverage) -> list[str]:
    """What the views show together, for people."""
    lines = [
        f"  {len(coverage.views)} views show {coverage.area_m2:.2f} m2 of surface and "
        f"{coverage.observed_volume_m3:.2f} m3 of space; "
        f"{coverage.query_explained:.0%} of the frame is explained by the others"
    ]
    total = 0.0
    for view in coverage.views:
        total += view.added_m2
        who = "the frame itself" if view.frame_id is None else view.frame_id
        rank = "" if view.rank is None else f"rank {view.rank}, {view.strength}"
        lines.append(f"  {who:34} {rank:18} +{view.added_m2:6.2f} m2  {total:7.2f}".rstrip())
    lines += [f"  left out: {one.frame_id}: {one_line(one.reason)}" for one in coverage.left_out]
    kind = f"{coverage.triangles} triangles" if coverage.triangles else "a cloud"
    lines.append(f"  {coverage.points} points, {kind}, voxels of {1000 * coverage.voxel_m:.0f} mm")
    return lines


def _asked(client: Client, options: argparse.Namespace) -> Answer:
    wanted, path = filter_of(options), Path(options.frame)
    if not path.exists():
        return client.query(
            options.map, frame_id=options.frame, k=options.k, seed=options.seed, filter=wanted
        )
    return client.query(options.map, _only(path), k=options.k, seed=options.seed, filter=wanted)


def _only(path: Path) -> FrameReference:
    """The one frame at a path.

    Raises
    ------
    DatasetError : none, or several.
    """
    found = [frame for sequence in find_sequences(path) for frame in sequence.frames]
    if len(found) != 1:
        raise DatasetError(f"{path}: {len(found)} frames are there. Name the file of one.")
    return found[0]


def _waited(client: Client, made: Reconstruction, views: int) -> Reconstruction:
    """The reconstruction when its job is over, or patience is; a bar shows that it goes on."""
    with tqdm(total=1, desc=f"fuse {views} views", unit="job", disable=None) as bar:

        def progress(done: int, _: int) -> None:
            bar.update(done - bar.n)

        client.wait([made.job_id], timeout_s=_PATIENCE_S, progress=progress)
    return client.reconstruction(made.job_id)
