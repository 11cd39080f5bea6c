"""Scenes of what a command found, which sceneprint-viewers writes where it is installed."""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, TypeAlias

from sceneprint.atomic_files import check_writable
from sceneprint.cli import whole_number
from sceneprint.cli.options import ended_by_signals
from sceneprint.cli.output import one_line, print_error
from sceneprint.errors import MissingDependency

if TYPE_CHECKING:
    from sceneprint_client import Client
    from sceneprint_client.api import Answer, Frame
    from sceneprint_client.api.base import CameraIntrinsics
    from sceneprint_client.api.sessions import Association
    from sceneprint_client.frame_files import FrameFile


class Scene(Protocol):
    """The scene that a command fills, of one service and one file."""

    @property
    def is_empty(self) -> bool:
        """Whether nothing was added."""

    def add_answer(
        self, answer: Answer, name: str, text: str, camera: CameraIntrinsics | None,
        place: tuple[int, int], stamp_ns: int | None,
    ) -> None:  # fmt: skip
        """Add an answer as the next moment.

        Parameters
        ----------
        answer : stored by the service
        name : of the frame that was looked up
        text : about the answer, for people
        camera : of that frame; None of a cloud
        place : of the frame among those that are looked up, from 0, and their number
        stamp_ns : when it was taken, nanoseconds since 1970; None where not known
        """

    def add_frame(self, frame: Frame) -> None:
        """Add one frame of a map."""

    def add_frames(self, frames: Sequence[Frame]) -> None:
        """Add posed frames of one map."""

    def add_association(self, association: Association, text: str) -> None:
        """Add what an association found; `text` describes it for people."""


#: Opens the scene of a file; also takes the client to fetch with, and how many frames of a map
#: are shown. The file is there only when the block ends without an error.
SceneOpener: TypeAlias = "Callable[[Path, Client, int], AbstractContextManager[Scene]]"


def add_scene_options(command: argparse.ArgumentParser) -> None:
    """Add `--mcap` and `--map-frames`."""
    group = command.add_argument_group(
        "scene", "what was found, in 3-D, for a viewer; see docs/viewers.md"
    )
    group.add_argument(
        "--mcap", type=Path, metavar="FILE",
        help="write an MCAP file for Foxglove or Rerun (needs sceneprint-viewers)",
    )  # fmt: skip
    group.add_argument(
        "--map-frames", type=whole_number, default=120, metavar="N",
        help="frames of the map whose points are shown, evenly taken (default: 120)",
    )  # fmt: skip


def check_scene(options: argparse.Namespace) -> None:
    """Check before any work that the scene can be written.

    Raises
    ------
    MissingDependency : no viewer is installed.
    OSError : the file cannot be written.
    """
    if options.mcap is not None:
        _opener()
        check_writable(options.mcap)


def _opener() -> SceneOpener:
    for one in entry_points(group="sceneprint.scenes"):
        found: SceneOpener = one.load()
        return found
    raise MissingDependency(
        "Scenes are written by sceneprint-viewers, which is not installed. "
        "Run: pip install sceneprint-viewers"
    )


@contextmanager
def open_scene(options: argparse.Namespace, client: Client) -> Iterator[Scene | None]:
    """Open the scene that `--mcap` names; None without that option."""
    if options.mcap is None:
        yield None
        return
    with ended_by_signals(), _opener()(options.mcap, client, options.map_frames) as scene:
        yield scene
    if not scene.is_empty:
        print_error(f"wrote {one_line(str(options.mcap))}")


def stamps_of(references: Sequence[FrameFile]) -> list[int | None]:
    """Nanoseconds since 1970 of frames; all None unless each is later than the one before."""
    stamps = [one.timestamp for one in references]
    known = [t for t in stamps if t is not None and 0 <= t < 2**63 * 1e-9]
    rising = all(a < b for a, b in itertools.pairwise(known))
    if len(known) < len(stamps) or not rising:
        return [None] * len(stamps)
    return [round(t * 1e9) for t in known]
