"""Tails: frames newer than a generation, held in memory and always compared exactly."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sceneprint.index.generations import Generation
from sceneprint.index.keys import Keys, Places, check_block
from sceneprint.types import Bytes


@dataclass(frozen=True, eq=False)
class Tail:
    """Frames newer than a generation.

    A frame that is in both counts once, with the signature it has here.

    Parameters
    ----------
    keys : (n,) int64, none twice
    signatures : (n, D) uint8

    Raises
    ------
    ValueError : other arrays, or a key that is there twice.
    """

    keys: Keys
    signatures: Bytes

    def __post_init__(self) -> None:
        check_block(self.keys, self.signatures, self.signatures.shape[-1])
        _ = self.places

    def __len__(self) -> int:
        return len(self.keys)

    @classmethod
    def empty(cls, dimension: int) -> Tail:
        """No frames, of signatures of that many bytes."""
        return cls(np.empty(0, np.int64), np.empty((0, dimension), np.uint8))

    @cached_property
    def places(self) -> Places:
        """Rows of the frames by their keys."""
        return Places(self.keys)


def signatures_of(keys: Keys, generation: Generation | None, tail: Tail) -> Bytes:
    """Signatures of some frames: of the hits of a search, to compare them among each other.

    Parameters
    ----------
    keys : (r,) int64
    generation : or None where there is none
    tail : frames newer than that

    Returns
    -------
    (r, D) uint8, in the order of `keys`; the tail's where a frame is in both

    Raises
    ------
    ValueError : a frame is in neither, or the lengths of signatures differ.
    """
    check_lengths(tail.signatures.shape[1], generation, tail)
    in_tail = tail.places.of(keys)
    result = np.empty((len(keys), tail.signatures.shape[1]), np.uint8)
    result[in_tail >= 0] = tail.signatures[in_tail[in_tail >= 0]]
    others = keys[in_tail < 0]
    if len(others) and generation is None:
        raise ValueError(f"no frames {others[:5].tolist()} in this index")
    if len(others) and generation is not None:
        result[in_tail < 0] = generation.vectors_of(others)
    return result


def check_lengths(dimension: int, generation: Generation | None, tail: Tail) -> None:
    """See that signatures of generation and tail have that many bytes.

    Raises
    ------
    ValueError : they have not.
    """
    found = {tail.signatures.shape[1]}
    if generation is not None:
        found.add(generation.dimension)
    if found != {dimension}:
        raise ValueError(f"signatures of {sorted(found)} bytes where {dimension} were expected")
