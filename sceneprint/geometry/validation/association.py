"""Sec. III-E, association: which validated candidates to believe first, and which vote together.

validations  --preferred-->  C_vld        parent frames of C_vld  --voters-->  some of them
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sceneprint.geometry.validation.validation import PairValidation


def preferred(validations: Sequence[PairValidation]) -> list[int]:
    """Positions of the accepted: strong before weak, and of either what shares most first.

    The paper keeps the order of R. A weak match has a rival that explains the frames nearly as
    well, so a later strong one goes before it. The more two camera frames share, the better their
    transform. Where all frames see all around, they share much from far away too, and the nearest
    sensor comes first.

    Parameters
    ----------
    validations : in the order of R
    """
    accepted = [i for i, v in enumerate(validations) if v.status == "accepted"]
    around = all(validations[i].around for i in accepted)

    def rank(i: int) -> tuple[bool, float]:
        validation = validations[i]
        return validation.strength != "strong", _away(validation) if around else -validation.overlap

    return sorted(accepted, key=rank)


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
