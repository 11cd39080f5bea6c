"""Sec. III-E, association: which validated candidates to believe first, and which vote together.

validations  --preferred-->  C_vld        parent frames of C_vld  --voters-->  some of them
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sceneprint.geometry.pose.rigid import rotation_angle
from sceneprint.geometry.validation.validation import PairValidation

#: Error of a depth camera's transform for each radian between the two views, metres: distortion
#: and reference poses that drift, of which the covariance of a refinement knows nothing.
_ERROR_PER_RADIAN = 0.04


def preferred(validations: Sequence[PairValidation]) -> list[int]:
    """Positions of the accepted: strong before weak, and of either the most precise first.

    The paper keeps the order of R. A weak match has a rival that explains the frames nearly as
    well, so a later strong one goes before it. Of cameras, that with the least expected error
    comes first. Where all frames see all around, the nearest sensor does.

    Parameters
    ----------
    validations : in the order of R
    """
    accepted = [i for i, v in enumerate(validations) if v.status == "accepted"]
    around = all(validations[i].around for i in accepted)

    def rank(i: int) -> tuple[bool, float]:
        validation = validations[i]
        off = _away(validation) if around else expected_error(validation)
        return validation.strength != "strong", off

    return sorted(accepted, key=rank)


def expected_error(validation: PairValidation) -> float:
    """Metres by which a transform of cameras is likely off.

    The deviation of its translation and an error that grows with the angle between the views,
    added in quadrature; infinite where the covariance is not known.
    """
    T, covariance = validation.T_match_query, validation.covariance
    if T is None or covariance is None:
        return math.inf
    variance = max(float(np.trace(covariance[:3, :3])), 0.0)
    return math.hypot(math.sqrt(variance), _ERROR_PER_RADIAN * rotation_angle(T[:3, :3]))


def _away(validation: PairValidation) -> float:
    """Metres between the two sensors."""
    T = validation.T_match_query
    return 0.0 if T is None else float(np.linalg.norm(T[:3, 3]))


def voters(parents: Sequence[str], strong: Sequence[bool], most: int = 5) -> list[int]:
    """Positions of the matches whose poses may be averaged: those of one parent frame.

    The parent frame with most strong matches votes, and of equals the one with most matches; of
    these, the one whose match comes first.

    Parameters
    ----------
    parents : parent frames of accepted matches, in the order of `preferred`
    strong : which of them are strong
    most : votes that are taken, the first ones

    Raises
    ------
    ValueError : not one for one.
    """
    votes: dict[str, tuple[int, int]] = {}
    for parent, sure in zip(parents, strong, strict=True):
        known = votes.get(parent, (0, 0))
        votes[parent] = (known[0] + sure, known[1] + 1)
    # the first of equals: dicts keep the order in which parents came
    winner = max(votes, key=votes.__getitem__, default=None)
    return [i for i, parent in enumerate(parents) if parent == winner][:most]
