"""Votes: what associations of two runs say of how the runs lie to each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.types import Floats


@dataclass(frozen=True, eq=False)
class Votes:
    """What associations say of two parent frames.

    Parameters
    ----------
    transforms : (n, 4, 4) T_a_b
    places : (n, 3) metres, where the frame of each was, in b
    source, target : (n,) its frames in b and in a
    weights : (n,) positive
    """

    transforms: Floats
    places: Floats
    source: NDArray[np.int64]
    target: NDArray[np.int64]
    weights: Floats


def votes_of(
    transforms: Floats, source_poses: Floats, target_poses: Floats,
    source: NDArray[np.int64], target: NDArray[np.int64], weights: Floats,
) -> Votes:  # fmt: skip
    """Associations as votes.

    Parameters
    ----------
    transforms : (n, 4, 4) T_target_source
    source_poses, target_poses : (n, 4, 4) T_b_source, T_a_target
    source, target, weights : as in Votes
    """
    R = source_poses[:, :3, :3].transpose(0, 2, 1)
    whole = np.zeros_like(transforms)
    there = target_poses @ transforms
    whole[:, :3, :3] = there[:, :3, :3] @ R
    places = source_poses[:, :3, 3]
    whole[:, :3, 3] = there[:, :3, 3] - np.einsum("nij,nj->ni", whole[:, :3, :3], places)
    whole[:, 3, 3] = 1.0
    return Votes(whole, places, source, target, weights)
