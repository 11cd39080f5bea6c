"""The rows of the table: how far off the answers are, and whether they are rightly believed.

Outcome, ...  --rows, validation, retrieval_of_chance-->  figures
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sceneprint.evaluation.records import Error, Outcome, Pair

Figures = dict[str, float | int | None]

#: Overlap from which a frame counts as showing the same place.
OVERLAPS = 0.3


def rows(outcomes: Sequence[Outcome]) -> dict[str, Figures]:
    """Each way to answer, over the queries whose scene is in the database.

    R: the first of the ranking, registered and refined, accepted or not. VR: the first that is
    accepted among the first of R, strong before weak. DR, VDR: the same of C. `pose_average`:
    of up to five accepted views of C; `pose_average_vr`: of R. `bound`: refinement started at the
    true pose, of the pair that VDR answers with (`first`) and of the views that are averaged.
    Without an accepted match a query is a failure, and of another scene a match is always one.
    """
    here = [o for o in outcomes if o.present]
    return {
        "R": accuracy([first_error(o, "R") for o in here]) | retrieval(here, "R"),
        "VR": accuracy([first_error(o, "VR") for o in here]),
        "DR": accuracy([first_error(o, "DR") for o in here]) | retrieval(here, "DR"),
        "VDR": accuracy([first_error(o, "VDR") for o in here]),
        "pose_average": accuracy([o.average for o in here]),
        "pose_average_vr": accuracy([o.average_of_ranking for o in here]),
    }


def bound(outcomes: Sequence[Outcome]) -> dict[str, Figures]:
    """What registration of the same pairs could reach: refinement started at the true pose.

    `VDR` for the first pair of VDR, `pose_average` for the views that are averaged. A query
    without such a pair is a failure here as it is there.
    """
    here = [o for o in outcomes if o.present]
    return {
        "VDR": accuracy([bound_of(o) for o in here]),
        "pose_average": accuracy([o.average_bound for o in here]),
    }


def bound_of(outcome: Outcome) -> Error:
    """Where refinement from the true pose ends for the pair VDR answers with."""
    first = outcome.views("VDR")[:1]
    return first[0].bound or Error() if first else Error()


def accuracy(errors: Sequence[Error]) -> Figures:
    """Shares of errors within the two thresholds, and medians; null where there is none.

    A failure is infinitely far off; a median that falls on one is null.
    """
    if not errors:
        names = ("within_5cm_5deg", "within_10cm_10deg")
        return dict.fromkeys((*names, "median_translation_m", "median_rotation_deg"))
    return {
        "within_5cm_5deg": _share([e.within(0.05, 5) for e in errors]),
        "within_10cm_10deg": _share([e.within(0.10, 10) for e in errors]),
        "median_translation_m": _median([e.metres for e in errors]),
        "median_rotation_deg": _median([math.degrees(e.radians) for e in errors]),
    }


def retrieval(outcomes: Sequence[Outcome], of: str) -> Figures:
    """How much the first match and the first five see of what the query sees.

    Overlap is that of retrieval. `right_scene`: share of queries whose first match is of their
    scene.
    """
    five = [[p.overlap_mean for p in o.views(of)[:5]] for o in outcomes]
    first = [overlap[0] for overlap in five]
    return {
        "top1_overlap_50": _share([f >= 0.5 for f in first]),
        "top5_overlap_50": _share([max(f) >= 0.5 for f in five]),
        "top1_overlap_30": _share([f >= OVERLAPS for f in first]),
        "mean_overlap": _mean(first),
        "right_scene": _share([o.views(of)[0].same_scene for o in outcomes]),
    }


def oracle_and_random(outcomes: Sequence[Outcome]) -> dict[str, Figures]:
    """What the best and a random frame of the database would score.

    `random` is an expectation, not a draw.
    """
    here = [o for o in outcomes if o.present]
    best = [float(o.overlap_mean.max()) for o in here]
    best_of = {
        "top1_overlap_50": _share([b >= 0.5 for b in best]),
        "top5_overlap_50": _share([b >= 0.5 for b in best]),
        "top1_overlap_30": _share([b >= OVERLAPS for b in best]),
        "mean_overlap": _mean(best),
    }
    of_any = {
        "top1_overlap_50": _mean([float((o.overlap_mean >= 0.5).mean()) for o in here]),
        "top5_overlap_50": _mean([_any_of_five(o) for o in here]),
        "top1_overlap_30": _mean([float((o.overlap_mean >= OVERLAPS).mean()) for o in here]),
        "mean_overlap": _mean([float(o.overlap_mean.mean()) for o in here]),
    }
    return {"oracle": best_of, "random": of_any}


def _any_of_five(outcome: Outcome) -> float:
    """Chance that five different frames hold one that overlaps by half."""
    n, good = len(outcome.overlap_mean), int((outcome.overlap_mean >= 0.5).sum())
    return 1.0 - math.comb(n - good, 5) / math.comb(n, 5) if n >= 5 else float(good > 0)


def validation(outcomes: Sequence[Outcome]) -> dict[str, float | int | None]:
    """Whether acceptance can be trusted, over all pairs that were validated.

    `precision`: accepted pairs whose transform is right to 10 cm and 10 degrees, over accepted.
    `recall`: the same over all pairs whose transform is right. `recall_overlap_30`: over those
    whose overlap (smaller direction) is 30 % or more. Counts: `pairs`, `accepted`,
    `accepted_strong`; of right transforms `right_but_rejected` and `right_but_ambiguous`; of
    other scenes `pairs_of_other_scenes`, `accepted_of_other_scenes`,
    `accepted_strong_of_other_scenes`.
    """
    return validation_of([p for o in outcomes for p in o.pairs.values()])


def validation_of(pairs: Sequence[Pair]) -> dict[str, float | int | None]:
    """The same of some pairs; precision is null where none of them was accepted."""
    accepted = [p for p in pairs if p.accepted]
    right = [p for p in pairs if p.right]
    clear = [p for p in right if p.overlap_least >= OVERLAPS]
    strange = [p for p in pairs if not p.same_scene]
    return {
        "precision": _share([p.right for p in accepted]),
        "recall": _share([p.accepted for p in right]),
        "recall_overlap_30": _share([p.accepted for p in clear]),
        "pairs": len(pairs),
        "accepted": len(accepted),
        "accepted_strong": _strong(pairs),
        "precision_strong": _share(
            [p.right for p in accepted if p.validation.strength == "strong"]
        ),
        "right_but_rejected": sum(p.validation.status == "rejected" for p in right),
        "right_but_ambiguous": sum(p.validation.status == "ambiguous" for p in right),
        "pairs_of_other_scenes": len(strange),
        "accepted_of_other_scenes": sum(p.accepted for p in strange),
        "accepted_strong_of_other_scenes": _strong(strange),
    }


def absent(outcomes: Sequence[Outcome]) -> dict[str, float | int | None]:
    """How often a query is believed to be found where its scene is not in the database.

    `accepted_strong` and `accepted_weak` are shares of these queries by the strength of VDR's
    answer; null where there is no such query.
    """
    away = [o for o in outcomes if not o.present]
    answers = [o.views("VDR")[0].validation.strength if o.views("VDR") else None for o in away]
    return {
        "queries": len(away),
        "accepted_strong": _share([a == "strong" for a in answers]),
        "accepted_weak": _share([a == "weak" for a in answers]),
        "pairs": sum(len(o.pairs) for o in away),
        "pairs_accepted": sum(p.accepted for o in away for p in o.pairs.values()),
    }


def first_error(outcome: Outcome, of: str) -> Error:
    """How far off a row's first answer is; infinite where it has none."""
    views = outcome.views(of)
    return views[0].error if views else Error()


def _strong(pairs: Sequence[Pair]) -> int:
    return sum(p.accepted and p.validation.strength == "strong" for p in pairs)


def _share(hits: Sequence[bool]) -> float | None:
    return sum(hits) / len(hits) if hits else None


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _median(values: Sequence[float]) -> float | None:
    middle = float(np.median(values))
    return middle if math.isfinite(middle) else None
