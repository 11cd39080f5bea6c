"""Sec. III-E, association: which validated candidates to believe first.

validations  --preferred-->  C_vld
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sceneprint.geometry.rigid import rotation_angle
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
