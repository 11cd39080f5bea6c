"""Sec. III-E, association: which validated candidates to believe first.

validations  --preferred-->  C_vld
"""

from __future__ import annotations

from collections.abc import Sequence

from sceneprint.geometry.validation import Validation


def preferred(validations: Sequence[Validation]) -> list[int]:
    """Positions of the accepted: the strong in their order, then the weak in theirs.

    The paper keeps the order of R. A weak match has a rival that explains the frames nearly as
    well, so a later strong one goes before it.

    Parameters
    ----------
    validations : in the order of R
    """
    accepted = [i for i, v in enumerate(validations) if v.status == "accepted"]
    return sorted(accepted, key=lambda i: validations[i].strength != "strong")
