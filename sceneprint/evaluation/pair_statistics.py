"""What is told of a transform, and how well each number would decide alone.

Pair, ...  --curves-->  figures
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from sceneprint.evaluation.rates import roc
from sceneprint.evaluation.records import Pair
from sceneprint.geometry.acceptance import AcceptanceParameters, Evidence
from sceneprint.geometry.validation import Validation

#: Shares of wrong pairs at which a curve is read off.
FALSE_RATES = (0.0, 0.01, 0.05)


def evidence(v: Validation, p: AcceptanceParameters) -> float:
    """For less against, as acceptance weighs it; without its stiffness, which is not told."""
    told = Evidence(
        v.residual_m, v.residual_rad, v.overlap, v.plane_overlap, v.violations, math.inf
    )
    return told.total(p)


def residual(v: Validation, p: AcceptanceParameters) -> float:
    """Of the two directions: the greater of metres and radians, each over its own limit."""
    return max(v.residual_m / p.residual_m, v.residual_rad / p.residual_rad)


#: What is told of a transform, each so that more speaks for it; None where it is not known.
STATISTICS: dict[str, Callable[[Validation, AcceptanceParameters], float | None]] = {
    "residual": lambda v, p: -residual(v, p),
    "overlap": lambda v, _: v.overlap,
    "plane_overlap": lambda v, _: v.plane_overlap,
    "violations": lambda v, _: None if v.violations is None else -v.violations,
    "evidence": evidence,
    "ambiguity": lambda v, _: -v.ambiguity,
    "inliers": lambda v, _: v.inliers,
}


def curves(pairs: Sequence[Pair], p: AcceptanceParameters) -> dict[str, Any]:
    """The receiver operating characteristic of each statistic, were it to decide alone.

    A pair is right where its transform is, whatever was decided. One without a transform, or of
    which a statistic is not known, has nothing to say for it. Of `ambiguity` only pairs are
    counted for which rivals were looked for. `curve` has (share of wrong ones, share of right
    ones, threshold); thresholds of statistics that should be small are negative.
    """
    found = {}
    for name, told in STATISTICS.items():
        own = [pair for pair in pairs if name != "ambiguity" or _rivals_looked_for(pair)]
        values = [
            told(one.validation, p) if one.validation.T_match_query is not None else None
            for one in own
        ]
        right = np.array([pair.right for pair in own], bool)
        curve = roc(np.array([-math.inf if v is None else v for v in values], float), right)
        found[name] = {
            "right": int(right.sum()),
            "wrong": int((~right).sum()),
            "area": None if curve is None else curve.area,
            "right_at": {
                f"{share:g}": None if curve is None else curve.true_at(share)
                for share in FALSE_RATES
            },
            "curve": [] if curve is None else curve.thinned(),
        }
    return found


def _rivals_looked_for(pair: Pair) -> bool:
    return pair.accepted or pair.validation.ambiguity > 0
