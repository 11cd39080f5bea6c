"""`sceneprint make`: products that a worker computes from a map, such as a mesh."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sceneprint.atomic_files import check_writable, write_whole
from sceneprint.cli import positive
from sceneprint.cli.options import (
    add_filter_options,
    add_seed_option,
    add_service_options,
    filter_of,
    open_client,
)
from sceneprint.cli.output import one_line, print_error, progress_bar
from sceneprint.cli.scenes import add_scene_options, check_scene, open_scene
from sceneprint.errors import DatasetError, InvalidRequest
from sceneprint_client.api import JobState

if TYPE_CHECKING:
    from sceneprint_client import Client
    from sceneprint_client.api import Answer
    from sceneprint_client.api.sessions import Association, GraphFormat, Join
    from sceneprint_client.api.surface import Coverage

#: Formats of a pose graph by file suffix.
_FORMATS: dict[str, GraphFormat] = {".g2o": "g2o", ".txt": "tum", ".tum": "tum", ".json": "json"}
#: Time limit for a mesh, seconds.
_TIMEOUT_S = 600.0


def add_make(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint make`."""
    kinds = command.add_subparsers(dest="kind", required=True, metavar="KIND")
    for name, add, run, text in (
        ("association", _add_association, _associate,
         "join two sessions of a map, or find the loop closures of one"),
        ("mesh", _add_mesh, _reconstruct, "fuse the matches of a frame into a mesh"),
    ):  # fmt: skip
        doc = " ".join((run.__doc__ or "").split())
        kind = kinds.add_parser(name, help=text, description=doc)
        add(kind)
        add_service_options(kind)
        kind.set_defaults(make=run)
    command.set_defaults(run=run_make)


def run_make(options: argparse.Namespace) -> int:
    """Let a worker compute a result from a map, and wait for it: an association of sessions, or a
    mesh of a place.
    """
    return int(options.make(options))


def _add_association(command: argparse.ArgumentParser) -> None:
    command.add_argument("map", metavar="MAP")
    which = command.add_mutually_exclusive_group(required=True)
    which.add_argument(
        "--session", action="append", metavar="NAME",
        help="once for loop closures; twice to join two sessions, the first to the second",
    )  # fmt: skip
    which.add_argument(
        "--undo", metavar="ID",
        help="undo the join of this association; the poses return to those of the uploads",
    )  # fmt: skip
    command.add_argument(
        "--robot", action="append", metavar="NAME",
        help="robot of each session, in the same order; required if several robots use the same "
        "session name",
    )  # fmt: skip
    command.add_argument(
        "--after", metavar="TIME", help="only frames captured at or after this time"
    )
    command.add_argument(
        "--before", metavar="TIME", help="only frames captured at or before this time"
    )
    command.add_argument(
        "--apart", type=positive, metavar="N",
        help="loop closure: minimum number of frames between two matched frames (default: 100)",
    )  # fmt: skip
    command.add_argument(
        "--not-within", type=float, metavar="SECONDS",
        help="loop closure: minimum time between two matched frames",
    )  # fmt: skip
    command.add_argument(
        "--k", type=positive, default=3, metavar="K", help="number of edges per frame (default: 3)"
    )
    command.add_argument(
        "--candidates", type=positive, default=10, metavar="N",
        help="number of candidates to try per frame, until the frame has K edges (default: 10)",
    )  # fmt: skip
    add_seed_option(command)
    command.add_argument(
        "--min-overlap", type=float, default=0.0, metavar="SHARE",
        help="minimum overlap of an edge, 0 to 1",
    )  # fmt: skip
    command.add_argument(
        "--join", action=argparse.BooleanOptionalAction, default=True,
        help="move the poses of both sessions into one parent frame, if the join is strong "
        "(default)",
    )  # fmt: skip
    command.add_argument(
        "--out", type=Path, metavar="FILE",
        help="file of the pose graph: .g2o, .txt (the vertices as a TUM trajectory) or .json",
    )  # fmt: skip
    command.add_argument(
        "--odometry", action="store_true", help="include edges between consecutive frames"
    )
    command.add_argument("--json", action="store_true", help="print JSON")
    add_scene_options(command)


def _associate(options: argparse.Namespace) -> int:
    """Find where two sessions of a map see the same places and how they align, or find the loop
    closures of a single session. The command can write the pose graph for an optimiser. The exit
    code is 2 if the job fails.
    """
    from sceneprint_client.api.sessions import Association

    if options.undo is not None:
        with open_client(options) as client:
            _print_association(client.undo_join(options.map, options.undo), options)
        return 0
    if len(options.session) > 2:
        raise InvalidRequest(
            "An association requires one or two sessions. Specify --session once or twice."
        )
    kind = None if options.out is None else _FORMATS.get(options.out.suffix.lower())
    if options.out is not None:  # check before the job, which may take an hour
        if kind is None:
            raise InvalidRequest(
                f"{options.out.name!a:.80} has an unknown file type. Use a name for --out that "
                f"ends in {', '.join(_FORMATS)}."
            )
        check_writable(options.out)
    check_scene(options)
    times = {"captured_after": options.after, "captured_before": options.before}
    time_filter = {name: value for name, value in times.items() if value is not None}
    fields: dict[str, Any] = {
        "sessions": options.session, "robots": options.robot, "filter": time_filter or None,
        "apart": options.apart, "not_within_s": options.not_within, "k": options.k,
        "candidates": options.candidates, "seed": options.seed,
        "min_overlap": options.min_overlap, "join": options.join,
    }  # fmt: skip
    with open_client(options) as client, open_scene(options, client) as scene:
        with progress_bar("associate") as progress:
            association = client.compute(Association, options.map, progress=progress, **fields)
        succeeded = association.state is JobState.SUCCEEDED
        if kind is not None and succeeded:
            graph = client.graph(options.map, association.job_id, kind, odometry=options.odometry)
            write_whole(options.out, graph.encode())
        if scene is not None and succeeded:
            scene.add_association(association, "\n".join(_association_lines(association)))
    _print_association(association, options)
    if succeeded and options.out is not None and not options.json:
        print(f"wrote {options.out}")
    return 0 if succeeded else 2


def _print_association(association: Association, options: argparse.Namespace) -> None:
    print(
        association.model_dump_json()
        if options.json
        else "\n".join(_association_lines(association))
    )


def _association_lines(association: Association) -> list[str]:
    """Return lines that describe an association, its edges and its joins."""
    name = f"association {association.job_id}"
    if association.result is None:
        why = "" if association.error is None else f": {one_line(association.error)}"
        return [f"{name} is {association.state}{why}"]
    r = association.result
    lines = [
        f"{name}: {r.edges} edges from {r.frames} frames ({r.validated} pairs validated)",
        f"edges: {r.consistent} supported by others, {r.inconsistent} outvoted, {r.unchecked} "
        "unsupported",
    ]
    lines += [line for join in r.joins for line in _join_lines(join)]
    if len(association.request.sessions) == 2 and not r.joins:
        lines.append("not joined: no edge connects frames with poses")
    return lines


def _join_lines(join: Join) -> list[str]:
    names = f"{one_line(join.from_parent)} onto {one_line(join.to_parent)}"
    if join.transform is None:
        return [f"not joined, {names}: {one_line(join.reason)}"]
    sure = "strongly" if join.strength == "strong" else "weakly (check it before you rely on it)"
    t, r = join.transform.translation, join.transform.rotation
    moved = [] if join.root is None else [f"  all their poses are now in {one_line(join.root)}"]
    moved += ["  undone: it no longer moves poses"] if join.undone else []
    return [
        f"joined {sure}, {names}: {one_line(join.reason)}, spread "
        f"{100 * (join.spread_m or 0.0):.1f} cm, {join.spread_deg or 0.0:.1f} deg",
        f"  translation {t.x:.4f} {t.y:.4f} {t.z:.4f} m, rotation {r.x:.6f} {r.y:.6f} {r.z:.6f} "
        f"{r.w:.6f} (x y z w)",
        *moved,
    ]


# Meshes.


def _add_mesh(command: argparse.ArgumentParser) -> None:
    command.add_argument("map", metavar="MAP")
    command.add_argument(
        "frame", metavar="FRAME", help="a depth image, or the id of a frame of the map"
    )
    command.add_argument(
        "--out", type=Path, default=Path("mesh.ply"), metavar="FILE",
        help="PLY file (default: mesh.ply)",
    )  # fmt: skip
    command.add_argument(
        "--k", type=positive, default=10, metavar="K",
        help="number of accepted matches to fuse (default: 10)",
    )  # fmt: skip
    add_seed_option(command)
    command.add_argument(
        "--voxel", type=float, metavar="METRES",
        help="size of a voxel (default: the finest that fits into memory)",
    )  # fmt: skip
    command.add_argument("--strong", action="store_true", help="fuse only strong matches")
    command.add_argument("--cloud", action="store_true", help="write points without triangles")
    command.add_argument(
        "--without-query", action="store_true", help="fuse only the matches, not the frame itself"
    )
    add_filter_options(command)


def _reconstruct(options: argparse.Namespace) -> int:
    """Query a map with a depth frame, and let a worker fuse the accepted matches into a surface in
    the camera frame of the query. The exit code is 1 if no match is accepted.
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
            wait_s=_TIMEOUT_S,
            strength="strong" if options.strong else "any",
            include_query=not options.without_query,
            voxel_m=options.voxel,
            output="cloud" if options.cloud else "mesh",
        )
        if job.result is None:
            why = one_line(job.error or "no worker has finished it yet; see `sceneprint jobs`")
            print_error(f"sceneprint make mesh: job {job.job_id} is {job.state}: {why}")
            return 2
        print("\n".join([f"{name}:", *_coverage_lines(job.result)]))
        write_whole(options.out, client.reconstruction_mesh(job.job_id))
        print(f"wrote {one_line(str(options.out))}")
    return 0


def _coverage_lines(coverage: Coverage) -> list[str]:
    """Return lines that describe the coverage of the fused views."""
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
    lines += [f"  skipped: {view.frame_id}: {one_line(view.reason)}" for view in coverage.left_out]
    kind = f"{coverage.triangles} triangles" if coverage.triangles else "a cloud"
    lines.append(f"  {coverage.points} points, {kind}, voxels of {1000 * coverage.voxel_m:.0f} mm")
    return lines


def _query(client: Client, options: argparse.Namespace) -> Answer:
    fields: dict[str, Any] = {"k": options.k, "seed": options.seed, "filter": filter_of(options)}
    path = Path(options.frame)
    if not path.exists():
        return client.query(options.map, frame_id=options.frame, **fields)
    from sceneprint.formats.dataset import find_sequences

    frames = [frame for sequence in find_sequences(path) for frame in sequence.frames]
    if len(frames) != 1:
        raise DatasetError(f"{path}: {len(frames)} frames found. Specify a single frame file.")
    return client.query(options.map, frames[0], **fields)
