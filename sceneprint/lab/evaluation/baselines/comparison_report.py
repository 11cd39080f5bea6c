"""The rows of the baselines, as the table has them for R.

Evaluation  --recalls, baseline_rows-->  figures
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneprint.lab.evaluation.baselines.comparison import Compared
from sceneprint.lab.evaluation.measures import FIRST, accuracy, recall
from sceneprint.lab.evaluation.protocol import Error, QueryOutcome
from sceneprint.lab.evaluation.run import Evaluation


def recalls(evaluation: Evaluation) -> dict[str, Any]:
    """Recall of R, of C, and of a random frame; see `recall`.

    `within_m`: a frame is the query's place where it was taken within so many metres; null: where
    the two overlap by half.
    """
    relevant, allowed = evaluation.relevant, evaluation.allowed
    outcomes = evaluation.outcomes
    return {
        "within_m": evaluation.within_m,
        "R": recall(relevant, allowed, [o.ranking for o in outcomes]),
        "DR": recall(relevant, allowed, [o.selection for o in outcomes]),
        "random": _by_chance(relevant, allowed),
    }


def _by_chance(
    relevant: NDArray[np.bool_], allowed: NDArray[np.bool_]
) -> dict[str, float | int | None]:
    """Expected share of queries that a random frame would answer rightly."""
    good, n = (relevant & allowed).sum(axis=1), allowed.sum(axis=1)
    able = good > 0
    shares = good[able] / n[able]
    return {"queries": int(able.sum()), "at_1": float(shares.mean()) if able.any() else None}


def baseline_rows(evaluation: Evaluation) -> dict[str, dict[str, Any]]:
    """Each baseline's figures by its name: those of R, by its ranking.

    `milliseconds`: see Compared. `ratio`: to describe a query and to rank the database for it,
    over the same by the signature.
    `reason`: why the baseline could not be asked; then it has no figures.
    """
    ours = float(np.median([o.milliseconds["rank"] for o in evaluation.outcomes]))
    return {
        one.name: {"reason": one.reason} if one.reason else _row(one, evaluation, ours)
        for one in evaluation.compared
    }


def _row(one: Compared, evaluation: Evaluation, ranking_ms: float) -> dict[str, Any]:
    outcomes = evaluation.outcomes
    here = [i for i, o in enumerate(outcomes) if o.present]
    firsts = [one.first[i] for i in here]
    ms = one.milliseconds
    return {
        **accuracy([Error() if pair is None else pair.error for pair in firsts]),
        **_overlaps([outcomes[i] for i in here], [one.rankings[i] for i in here]),
        "recall": recall(evaluation.relevant, evaluation.allowed, one.rankings),
        "milliseconds": ms,
        "ratio": (ms["describe"] + ms["rank"]) / (ms["sign"] + ranking_ms),
    }


def _overlaps(
    outcomes: Sequence[QueryOutcome], rankings: Sequence[Sequence[int]]
) -> dict[str, float | None]:
    """As `measures.retrieval`, of any ranking."""
    if not outcomes:
        names = ("top1_overlap_50", "top5_overlap_50", "top1_overlap_30", "mean_overlap")
        return dict.fromkeys(names)
    first = [
        [o.overlap_of(match) for match in ranking[: FIRST[1]]]
        for o, ranking in zip(outcomes, rankings, strict=True)
    ]
    nearest = np.array([five[0] for five in first])
    return {
        "top1_overlap_50": float((nearest >= 0.5).mean()),
        "top5_overlap_50": float(np.mean([max(five) >= 0.5 for five in first])),
        "top1_overlap_30": float((nearest >= 0.3).mean()),
        "mean_overlap": float(nearest.mean()),
    }
