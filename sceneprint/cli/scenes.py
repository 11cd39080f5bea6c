"""The options of every command that shows what it found in a viewer: Rerun, Foxglove."""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from sceneprint.atomic_files import check_writable
from sceneprint.cli import whole_number
from sceneprint.cli.options import ended_by_signals, one_line
from sceneprint.errors import InvalidRequest
from sceneprint_client.frame_files import FrameFile

if TYPE_CHECKING:
    from sceneprint.scenes.scene import SceneStream, SceneWriter


def add_scene_options(command: argparse.ArgumentParser) -> None:
    """`--rrd` and its like."""
    group = command.add_argument_group(
        "scene", "what was found, in 3-D, for a viewer; see docs/viewers.md"
    )
    group.add_argument(
        "--rrd", type=Path, metavar="FILE", help="write a recording for Rerun (sceneprint[rerun])"
    )
    group.add_argument(
        "--mcap", type=Path, metavar="FILE",
        help="write an MCAP file for Foxglove (sceneprint[foxglove])",
    )  # fmt: skip
    group.add_argument(
        "--rerun",
        action="store_true",
        help="show it in the Rerun viewer of this machine, which is started if none listens",
    )
    group.add_argument(
        "--rerun-url",
        metavar="URL",
        help="show it in the Rerun viewer at this address, such as "
        "rerun+http://192.168.1.20:9876/proxy",
    )
    group.add_argument(
        "--map-frames",
        type=whole_number,
        default=120,
        metavar="N",
        help="frames of the map whose points are shown, evenly taken (default: 120)",
    )


def wants_scene(options: argparse.Namespace) -> bool:
    """Whether any of the options asks for a scene."""
    return bool(options.rrd or options.mcap or options.rerun or options.rerun_url)


def check_scene(options: argparse.Namespace) -> None:
    """See before any work that the scene can be written and shown.

    Raises
    ------
    MissingDependency : a package that it needs is not installed.
    InvalidRequest : two files are one, or the address is none of a viewer.
    Unreachable : no viewer listens at the address.
    OSError : a file cannot be written.
    """
    if not wants_scene(options):
        return
    if options.rrd or options.rerun or options.rerun_url:
        from sceneprint.scenes.rerun_writer import check_viewer, require_rerun

        require_rerun()
        if options.rerun_url:
            check_viewer(options.rerun_url)
    if options.mcap:
        from sceneprint.scenes.mcap_writer import require_foxglove

        require_foxglove()
    files = [path for path in (options.rrd, options.mcap) if path is not None]
    if len(files) > 1 and files[0].absolute() == files[1].absolute():
        raise InvalidRequest(f"--rrd and --mcap both name {files[0]}. Give each a file of its own.")
    for path in files:
        check_writable(path)


def check_kept(options: argparse.Namespace) -> None:
    """See that answers are stored, as a scene is made of what the service keeps of them.

    Raises
    ------
    InvalidRequest : they are not.
    """
    if wants_scene(options) and options.no_keep:
        raise InvalidRequest("A scene is made of stored answers. Leave --no-keep out.")


@contextmanager
def open_scene(options: argparse.Namespace, title: str) -> Iterator[SceneStream | None]:
    """Where the scene goes that the options ask for; None where they ask for none.

    Files are there when the block ends well, and else none of them.
    """
    if not wants_scene(options):
        yield None
        return
    from sceneprint.scenes.scene import SceneStream

    with ExitStack() as stack:
        stack.enter_context(ended_by_signals())
        writers: list[SceneWriter] = []
        if options.rrd:
            from sceneprint.scenes.rerun_writer import rerun_file

            writers.append(stack.enter_context(rerun_file(options.rrd, title)))
        if options.rerun or options.rerun_url:
            from sceneprint.scenes.rerun_writer import rerun_viewer

            writers.append(stack.enter_context(rerun_viewer(options.rerun_url, title)))
        if options.mcap:
            from sceneprint.scenes.mcap_writer import mcap_file

            writers.append(stack.enter_context(mcap_file(options.mcap)))
        stream = SceneStream(writers)
        yield stream
    for path in (options.rrd, options.mcap):
        if path is not None and not stream.is_empty:
            print(f"wrote {one_line(str(path))}", file=sys.stderr)


def stamps_of(references: Sequence[FrameFile]) -> list[int | None]:
    """When frames were taken, nanoseconds since 1970; all None unless each is later than the one
    before.
    """
    stamps = [one.timestamp for one in references]
    known = [t for t in stamps if t is not None and 0 <= t < 2**63 * 1e-9]
    rising = all(a < b for a, b in itertools.pairwise(known))
    if len(known) < len(stamps) or not rising:
        return [None] * len(stamps)
    return [round(t * 1e9) for t in known]
