"""Which frames of a data set the demo keeps as its map, and which it looks up.

path  --choose_frames-->  Choice
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sceneprint.datasets import FrameReference, find_sequences
from sceneprint.errors import DatasetError

#: Without split files: shares of each sequence that are the map, and that separate it.
DATABASE_SHARE, GAP_SHARE = 0.60, 0.05
#: Most frames of either, evenly spread, so that the demo takes minutes.
MOST_DATABASE, MOST_QUERIES = 300, 180


@dataclass(frozen=True, eq=False)
class Chosen:
    """A frame that takes part, the frame its pose leads to, and the run it is of."""

    parent: str
    session: str
    reference: FrameReference


@dataclass(frozen=True, eq=False)
class Choice:
    """The frames of the demo."""

    database: list[Chosen]
    queries: list[Chosen]


def choose_frames(path: Path) -> Choice:
    """Database and queries, by split files where the scene has them.

    Parameters
    ----------
    path : of one or several sequences

    Raises
    ------
    DatasetError : no sequence there, or too few frames for both.
    """
    database: list[Chosen] = []
    queries: list[Chosen] = []
    found = find_sequences(path)
    split = any(sequence.split for sequence in found)
    for sequence in found:
        frames = [
            Chosen(sequence.parent_frame, sequence.name, reference) for reference in sequence.frames
        ]
        if split:
            database += frames if sequence.split == "train" else []
            queries += frames if sequence.split == "test" else []
        else:
            n = len(frames)
            database += frames[: round(DATABASE_SHARE * n)]
            queries += frames[round((DATABASE_SHARE + GAP_SHARE) * n) :]
    if not database or not queries:
        raise DatasetError(
            f"{path}: has {len(database)} frames for the map and {len(queries)} to look up, and "
            "the demo needs both. Give a longer sequence."
        )
    return Choice(_thinned(database, MOST_DATABASE), _thinned(queries, MOST_QUERIES))


def _thinned(frames: Sequence[Chosen], most: int) -> list[Chosen]:
    return list(frames[:: max(-(-len(frames) // most), 1)])
