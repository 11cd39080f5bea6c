"""Scenes with the results of commands, written by the package sceneprint-viewers."""

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
    """A scene file, to which a command adds results of a service."""

    @property
    def is_empty(self) -> bool:
        """Return whether the scene has no content."""

    def add_answer(
        self, answer: Answer, name: str, text: str, camera: CameraIntrinsics | None,
        place: tuple[int, int], stamp_ns: int | None,
    ) -> None:  # fmt: skip
        """Add an answer as the next point in time.

        Parameters
        ----------
        answer : answer, which the service must store
        name : name of the queried frame
        text : description of the answer
        camera : camera of the frame; None for a cloud
        place : index of the frame among the queried frames, from 0, and number of these frames
        stamp_ns : capture time, nanoseconds since 1970; None if unknown
        """

    def add_frame(self, frame: Frame) -> None:
        """Add a frame of a map."""

    def add_frames(self, frames: Sequence[Frame]) -> None:
        """Add frames of a map that have poses."""

    def add_association(self, association: Association, text: str) -> None:
        """Add an association with a description."""


#: Function that opens a scene file; its arguments are the path, the client, and the maximum number
#: of frames of the map to include. The file appears only if the context ends without an error.
SceneOpener: TypeAlias = "Callable[[Path, Client, int], AbstractContextManager[Scene]]"


def add_scene_options(command: argparse.ArgumentParser) -> None:
    """Add `--mcap` and `--map-frames`."""
    group = command.add_argument_group(
        "scene", "a 3-D scene of the results for a viewer; see docs/viewers.md"
    )
    group.add_argument(
        "--mcap", type=Path, metavar="FILE",
        help="write an MCAP file for Foxglove or Rerun (requires sceneprint-viewers)",
    )  # fmt: skip
    group.add_argument(
        "--map-frames", type=whole_number, default=120, metavar="N",
        help="number of evenly spaced frames of the map whose points are shown (default: 120)",
    )  # fmt: skip


def check_scene(options: argparse.Namespace) -> None:
    """Check, before any work, that the scene can be written.

    Raises
    ------
    MissingDependency : If no viewer is installed.
    OSError : If the file cannot be written.
    """
    if options.mcap is not None:
        _opener()
        check_writable(options.mcap)


def _opener() -> SceneOpener:
    for entry in entry_points(group="sceneprint.scenes"):
        opener: SceneOpener = entry.load()
        return opener
    raise MissingDependency(
        "Scenes are written by sceneprint-viewers, which is not installed. "
        "In a clone, run: pip install ./viewers"
    )


@contextmanager
def open_scene(options: argparse.Namespace, client: Client) -> Iterator[Scene | None]:
    """Open the scene file of `--mcap`; yield None if the option is absent."""
    if options.mcap is None:
        yield None
        return
    with ended_by_signals(), _opener()(options.mcap, client, options.map_frames) as scene:
        yield scene
    if not scene.is_empty:
        print_error(f"wrote {one_line(str(options.mcap))}")


def stamps_of(references: Sequence[FrameFile]) -> list[int | None]:
    """Return the capture times of frames, nanoseconds since 1970.

    All are None if a time is unknown, or the times do not increase.
    """
    stamps = [reference.timestamp for reference in references]
    times = [t for t in stamps if t is not None and 0 <= t < 2**63 * 1e-9]
    rising = all(a < b for a, b in itertools.pairwise(times))
    if len(times) < len(stamps) or not rising:
        return [None] * len(stamps)
    return [round(t * 1e9) for t in times]
