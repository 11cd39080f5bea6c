"""A scene as entities over time, in the terms of no viewer.

Moment  --SceneStream.write-->  SceneWriter (Rerun, MCAP)

Entities form a tree by their paths. The first part of a path is the space: the name of the frame
of coordinates that all of it lies in, such as the parent frame of a map's poses. Below an entity
with a `Placement` all coordinates are those of its child frame.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Protocol

from sceneprint.types import Bytes, Floats

#: Red, green, blue, 0 to 255.
Colour = tuple[int, int, int]
#: From the space down.
EntityPath = tuple[str, ...]


@dataclass(frozen=True, eq=False)
class PointSet:
    """Points.

    Parameters
    ----------
    points : (N, 3) metres
    colours : (N, 3)
    size_m : diameter that a point is drawn with
    """

    points: Floats
    colours: Bytes
    size_m: float


@dataclass(frozen=True, eq=False)
class Placement:
    """Where a frame of coordinates lies.

    Parameters
    ----------
    T_parent_child : (4, 4)
    child : name of the frame; no other placement of the scene has it
    """

    T_parent_child: Floats
    child: str


@dataclass(frozen=True, eq=False)
class LineSet:
    """Strips of lines.

    Parameters
    ----------
    strips : each (M, 3) metres
    colours : of each strip
    width_px : on the screen
    """

    strips: Sequence[Floats]
    colours: Sequence[Colour]
    width_px: float = 2.0


@dataclass(frozen=True, eq=False)
class TextLabel:
    """A short text in space.

    Parameters
    ----------
    position : (3,) metres
    text, colour : of it
    """

    position: Floats
    text: str
    colour: Colour


@dataclass(frozen=True, eq=False)
class UpAxis:
    """Which way is up in a space.

    Parameters
    ----------
    up : (3,) unit vector
    """

    up: Floats


@dataclass(frozen=True, eq=False)
class TextPage:
    """What is said of the scene, for people, in lines."""

    text: str


Content = PointSet | Placement | LineSet | TextLabel | UpAxis | TextPage


@dataclass(frozen=True, eq=False)
class SceneEntity:
    """Something in a scene.

    Parameters
    ----------
    path : from its space down; one content each
    content : what is drawn there
    """

    path: EntityPath
    content: Content


@dataclass(frozen=True, eq=False)
class Moment:
    """What a scene holds at one time.

    Parameters
    ----------
    entities : those that are there until the next moment
    index : of the frame that was asked, from 0; None for what is there at all times
    stamp_ns : when it was taken, nanoseconds since 1970; None where not known
    """

    entities: Sequence[SceneEntity]
    index: int | None = None
    stamp_ns: int | None = None


class SceneWriter(Protocol):
    """A file or viewer that takes a scene."""

    def write(self, moment: Moment, gone: Collection[SceneEntity]) -> None:
        """Add a moment; `gone` are entities of the one before that it does not have."""


class SceneStream:
    """A scene while it is written, to several files and viewers at once.

    Parameters
    ----------
    writers : of each; nothing is opened before the first moment
    """

    def __init__(self, writers: Sequence[SceneWriter]) -> None:
        self._writers = writers
        self.is_empty = True
        self._there: dict[EntityPath, SceneEntity] = {}

    def write(self, moment: Moment) -> None:
        """Add a moment; it takes the place of the one before, and not of what is there at all
        times.
        """
        self.is_empty = False
        gone: list[SceneEntity] = []
        if moment.index is not None:
            there = {one.path: one for one in moment.entities}
            gone = [one for path, one in self._there.items() if path not in there]
            self._there = there
        for writer in self._writers:
            writer.write(moment, gone)


def space_of(path: EntityPath) -> str:
    """The space that an entity lies in."""
    return path[0]
