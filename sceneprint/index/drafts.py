"""Drafts: which signatures the next generation will have, and in which segments they lie.

New signatures go to a segment of their own. A signature that is deleted or replaced stays in its
segment, out of use, until more rows are out of use than in use; then all are rewritten. Or until
somebody asks that no byte of them is left: then the segments are rewritten that have such rows.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sceneprint.index.generations import Generation, keys_of
from sceneprint.index.keys import Keys, Places
from sceneprint.index.segments import (
    BLOCK_BYTES,
    Block,
    Segment,
    blocks_of,
    gather,
    open_segment,
    write_segment,
)

#: Segments are rewritten as one when fewer than one in this many rows is of a living frame, or
#: when there are so many of them: each holds a file descriptor as long as it is mapped.
SPARSE, MANY = 2, 64


@dataclass(frozen=True, eq=False)
class Draft:
    """Segments of a generation to be, rows and keys of its frames, and which are of the old one.

    `kept` (k,) are positions in the generation before; its frames come first, in that order.
    """

    segments: tuple[Segment, ...]
    rows: NDArray[np.int64]
    keys: Keys
    kept: NDArray[np.int64]


def remaining(
    folder: Path, previous: Generation | None, drop: frozenset[int], *, clean: bool = False
) -> Draft:
    """What stays of the generation before, in its segments or in rewritten ones.

    Parameters
    ----------
    folder : where a rewritten segment goes
    previous : the generation before, if any
    drop : keys of frames that do not stay
    clean : leave no segment that has rows out of use
    """
    none = np.empty(0, np.int64)
    if previous is None:
        return Draft((), none, none, none)
    kept = np.flatnonzero(~np.isin(previous.keys, list(drop)))
    segments, rows = previous.segments, previous.rows[kept]
    stored = sum(map(len, segments))
    if stored > SPARSE * len(kept) or len(segments) >= MANY:
        segments = _rewritten(folder, previous, rows)
        rows = np.arange(len(kept))
    elif clean:
        segments = _cleaned(folder, previous, rows)
        rows = np.arange(len(kept))  # no row is out of use any more, and their order stays
    return Draft(segments, rows, previous.keys[kept], kept)


def _cleaned(folder: Path, previous: Generation, rows: NDArray[np.int64]) -> tuple[Segment, ...]:
    """Segments that hold those rows alone, each as it was or rewritten."""
    found, start = list[Segment](), 0
    for segment in previous.segments:
        own = rows[(rows >= start) & (rows < start + len(segment))]
        start += len(segment)
        if len(own) == len(segment):
            found.append(segment)
        else:
            found += _rewritten(folder, previous, own)
    return tuple(found)


def _rewritten(folder: Path, previous: Generation, rows: NDArray[np.int64]) -> tuple[Segment, ...]:
    if len(rows) == 0:
        return ()
    keys = keys_of(list(previous.segments))
    name = write_segment(
        folder,
        (
            (keys[some], gather(previous.segments, some))
            for some in blocks_of(rows, previous.dimension, BLOCK_BYTES)
        ),
    )
    return (open_segment(folder / name, verify=False),)


def append(folder: Path, draft: Draft, blocks: Iterable[Block], drop: frozenset[int]) -> Draft:
    """Put new frames behind those that remain.

    Parameters
    ----------
    folder : where their segment goes
    draft : what remains
    blocks : of the new frames; their keys replace those that remain
    drop : keys of frames that are not taken

    Raises
    ------
    ValueError : blocks that are none, a key twice, or signatures of another length.
    OSError : the segment cannot be written.
    """
    filled: Iterator[Block] = (block for block in blocks if len(block[0]))
    first = next(filled, None)
    if first is None:
        return draft
    name = write_segment(folder, itertools.chain([first], filled))
    segment = open_segment(folder / name, verify=False)
    lengths = {each.signatures.shape[1] for each in (*draft.segments, segment)}
    if len(lengths) > 1:
        raise ValueError(f"signatures of {sorted(lengths)} bytes in one map")
    Places(segment.keys)  # raises where a key is there twice
    stays = ~np.isin(draft.keys, segment.keys)
    new = np.flatnonzero(~np.isin(segment.keys, list(drop)))
    stored = sum(map(len, draft.segments))
    return Draft(
        segments=(*draft.segments, segment),
        rows=np.concatenate([draft.rows[stays], stored + new]),
        keys=np.concatenate([draft.keys[stays], segment.keys[new]]),
        kept=draft.kept[stays],
    )
