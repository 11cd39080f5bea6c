"""Pairs of overlapping frames with their true transforms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sceneprint.formats.dataset import find_sequences
from sceneprint.geometry.rigid import inverse
from sceneprint.types import DepthFrame, Floats
from sceneprint_lab.evaluation.protocol import overlap, view_of
from sceneprint_lab.synth import synthesise_room

#: Minimum overlap of a pair, in the direction with less overlap.
LEAST_OVERLAP = 0.3


@dataclass(frozen=True, eq=False)
class FramePair:
    """Two frames of one parent frame, and their relative pose.

    Parameters
    ----------
    query, match : frames with poses
    overlap : overlap in the direction with less overlap, [0, 1]
    T_match_query : (4, 4) true transform from the poses
    """

    query: DepthFrame
    match: DepthFrame
    overlap: float
    T_match_query: Floats


def pairs_among(frames: Sequence[DepthFrame], apart: int = 1) -> list[FramePair]:
    """Return all pairs with LEAST_OVERLAP that are at least `apart` frames apart."""
    views, pairs = [view_of(frame) for frame in frames], []
    for i, query in enumerate(frames):
        for j, match in enumerate(frames[: max(i + 1 - apart, 0)]):
            _, least = overlap(views[i], views[j])
            if least >= LEAST_OVERLAP:
                assert query.pose is not None
                assert match.pose is not None
                truth = inverse(match.pose) @ query.pose
                pairs.append(FramePair(query, match, least, truth))
    return pairs


def real_pairs(recordings: Path, n: int, step: int = 25) -> list[FramePair]:
    """Return `n` pairs of the first 7-Scenes sequence, at least 2 `step` frames apart, or []."""
    scenes = recordings / "7scenes"
    if not scenes.is_dir():
        return []
    frames = [reference.read_depth() for reference in find_sequences(scenes)[0].frames[::step]]
    return _spread(pairs_among(frames, apart=2), n)


def synthetic_pairs(n: int) -> list[FramePair]:
    """Return `n` pairs of views of synthetic rooms, at most three per room."""
    pairs: list[FramePair] = []
    number = 0
    while len(pairs) < n:
        pairs += pairs_among(synthesise_room(3, number, 5).frames)[:3]
        number += 1
    return pairs[:n]


def _spread(pairs: list[FramePair], n: int) -> list[FramePair]:
    chosen = np.linspace(0, len(pairs) - 1, min(n, len(pairs)))
    return [pairs[int(i)] for i in chosen]
