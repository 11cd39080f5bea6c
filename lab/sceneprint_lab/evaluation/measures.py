"""Measures of rankings, accuracy, acceptance, and the effect of diversification."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.rigid import transform_points
from sceneprint.types import AnyFrame, Cloud, Floats
from sceneprint_lab.evaluation.protocol import (
    VIEWS,
    Error,
    JudgedAnswer,
    QueryOutcome,
    SignedFrame,
    ValidatedPair,
    points_at,
)

#: Values of k for recall@k.
FIRST = (1, 5, 10)
#: Minimum overlap (`Overlaps.mean`) of a frame that shows the query's place.
OVERLAP = 0.5


def metres_apart(queries: Sequence[SignedFrame], database: Sequence[SignedFrame]) -> Floats:
    """Return the distances (Q, N) between the sensors, metres; infinite between scenes."""
    there = np.array([m.pose[:3, 3] for m in queries])
    here = np.array([m.pose[:3, 3] for m in database])
    same = np.array([m.scene for m in queries])[:, None] == np.array([m.scene for m in database])
    apart = np.linalg.norm(there[:, None] - here, axis=2)
    return np.where(same, apart, np.inf)


def recall(
    relevant: NDArray[np.bool_], allowed: NDArray[np.bool_], rankings: Sequence[Sequence[int]]
) -> dict[str, float | int | None]:
    """Return recall@k, the share of queries with a relevant frame among the first k.

    Parameters
    ----------
    relevant : (Q, N) mask of the database frames that show the query's place
    allowed : (Q, N) mask of the database frames that the query may find
    rankings : indices of allowed database frames for each query, nearest first

    Returns
    -------
    figures : number of `queries` that may find a relevant frame, and the recall of these queries
        for each k of FIRST; null if there are none
    """
    able = np.flatnonzero((relevant & allowed).any(axis=1)).tolist()
    figures: dict[str, float | int | None] = {"queries": len(able)}
    for k in FIRST:
        hits = [any(relevant[i, j] for j in rankings[i][:k]) for i in able]
        figures[f"at_{k}"] = sum(hits) / len(hits) if hits else None
    return figures


# Confidence bounds of rates, and receiver operating characteristics.
#
# counts  --upper_bound-->  rate        scores, labels  --roc-->  Roc

#: Confidence of the upper bound on a rate.
CONFIDENCE = 0.95
#: Maximum number of points in a curve.
CURVE = 200


def upper_bound(seen: int, of: int, confidence: float = CONFIDENCE) -> float | None:
    """Return the one-sided Clopper-Pearson upper bound on a rate.

    For 0 events, the bound is 1 - (1 - confidence)^(1 / of), which for 95 % is about 3 / of (the
    rule of three). It assumes independent trials; for pairs that share frames, the true bound is
    higher.

    Parameters
    ----------
    seen, of : number of events and of trials, 0 <= seen <= of
    confidence : confidence of the bound, between 0 and 1

    Returns
    -------
    rate : upper bound; None if there are no trials

    Raises
    ------
    ValueError : If an argument is out of range
    """
    if not 0 <= seen <= of or not 0 < confidence < 1:
        raise ValueError(
            f"{seen} events in {of} trials at confidence {confidence} have no bound. Pass "
            "0 <= seen <= of and 0 < confidence < 1."
        )
    if of == 0:
        return None
    low, high = seen / of, 1.0
    while (middle := (low + high) / 2) not in (low, high):  # stop when no number lies between them
        low, high = (middle, high) if _at_most(seen, of, middle) > 1 - confidence else (low, middle)
    return high


def _at_most(seen: int, of: int, rate: float) -> float:
    """Return the probability of at most `seen` events in `of` independent trials."""
    if rate in (0.0, 1.0):
        return float(rate == 0 or seen == of)
    hit, miss = math.log(rate), math.log1p(-rate)
    ways = math.lgamma(of + 1)
    return math.fsum(
        math.exp(ways - math.lgamma(k + 1) - math.lgamma(of - k + 1) + k * hit + (of - k) * miss)
        for k in range(seen + 1)
    )


@dataclass(frozen=True, eq=False)
class Roc:
    """The receiver operating characteristic of a score.

    Parameters
    ----------
    area : area under the curve, the probability that a right item has a higher score than a wrong
        item; ties count half
    false, true : (n,) shares of wrong items and of right items that reach each threshold, 0 to 1
    thresholds : (n,) descending thresholds of the score, starting with infinity
    """

    area: float
    false: Floats
    true: Floats
    thresholds: Floats

    def true_at(self, false: float) -> float:
        """Return the maximum true rate at a false rate of at most `false`."""
        return float(self.true[self.false <= false].max())

    def thinned(self, most: int = CURVE) -> list[list[float]]:
        """Return at most `most` points (false, true, threshold) of the curve, with both ends."""
        n = len(self.true)
        selected = np.arange(n)
        if n > most:
            selected = self._spaced_indices(most)
        columns = zip(
            self.false[selected], self.true[selected], self.thresholds[selected], strict=True
        )
        return [[float(value) for value in row] for row in columns]

    def _spaced_indices(self, most: int) -> NDArray[np.intp]:
        n = len(self.true)
        # Equal steps in the sum of both rates represent both ends of the curve.
        at = np.linspace(0, 2, most - 1)
        return np.unique(np.append(np.searchsorted(self.false + self.true, at).clip(0, n - 1), 0))


def roc(scores: Floats, right: NDArray[np.bool_]) -> Roc | None:
    """Return the receiver operating characteristic of a score.

    Parameters
    ----------
    scores : (n,) scores, higher for right items; -infinity without evidence
    right : (n,) mask of the right items

    Returns
    -------
    curve : None if all items are right or all items are wrong
    """
    n_right, n_wrong = int(right.sum()), int((~right).sum())
    if not n_right or not n_wrong:
        return None
    values, place = np.unique(-scores, return_inverse=True)  # scores are descending and distinct
    good = np.bincount(place[right], minlength=len(values)).cumsum()
    bad = np.bincount(place[~right], minlength=len(values)).cumsum()
    true = np.concatenate([[0], good]) / n_right
    false = np.concatenate([[0], bad]) / n_wrong
    area = float(((true[1:] + true[:-1]) / 2 * np.diff(false)).sum())
    return Roc(area, false, true, np.concatenate([[np.inf], -values]))


# The rows of the table: errors of answers, and correctness of acceptance.
#
# Outcome, ...  --rows, validation, oracle_and_random-->  figures

Figures = dict[str, float | int | None]

#: Minimum overlap of a frame that shows the same place.
OVERLAPS = 0.3


def rows(outcomes: Sequence[QueryOutcome]) -> dict[str, Figures]:
    """Return the figures of each method for the queries whose scene is in the database.

    R: the first member of the ranking after registration, accepted or not. VR: the first accepted
    match among the first members of R, strong before weak. DR, VDR: the same for C. `pose_average`:
    the average of up to five accepted views of C; `pose_average_vr`: the same for R. A query
    without an accepted match, or with a match of another scene, is a failure.
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


def bound(outcomes: Sequence[QueryOutcome]) -> dict[str, Figures]:
    """Return the bounds of registration: errors after refinement from the reference poses.

    `VDR` is the bound for the first pair of VDR, `pose_average` for the averaged views. A query
    without an accepted pair is a failure.
    """
    here = [o for o in outcomes if o.present]
    return {
        "VDR": accuracy([bound_of(o) for o in here]),
        "pose_average": accuracy([o.average_bound for o in here]),
    }


def bound_of(outcome: QueryOutcome) -> Error:
    """Return the error of VDR's first pair after refinement from the reference pose."""
    first = outcome.views("VDR")[:1]
    return first[0].bound or Error() if first else Error()


def accuracy(errors: Sequence[Error]) -> Figures:
    """Return the shares of errors within each of two limits, and medians; null if there are none.

    The error of a failure is infinite; an infinite median is null.
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


def overlap_figures(five: Sequence[Sequence[float]]) -> Figures:
    """Return figures on the overlap of the first match, and of the first five, with the query.

    `five`: overlaps (`Overlaps.mean`) of the first five matches of each query.
    """
    first = [overlaps[0] for overlaps in five]
    return {
        "top1_overlap_50": _share([f >= 0.5 for f in first]),
        "top5_overlap_50": _share([max(f) >= 0.5 for f in five]),
        "top1_overlap_30": _share([f >= OVERLAPS for f in first]),
        "mean_overlap": _mean(first),
    }


def retrieval(outcomes: Sequence[QueryOutcome], of: str) -> Figures:
    """Return `overlap_figures` of a row, and the share `right_scene` of its first matches."""
    figures = overlap_figures([[p.overlap_mean for p in o.views(of)[:5]] for o in outcomes])
    return figures | {"right_scene": _share([o.views(of)[0].same_scene for o in outcomes])}


def oracle_and_random(outcomes: Sequence[QueryOutcome]) -> dict[str, Figures]:
    """Return the overlap figures of the best frame (`oracle`) and expected of a `random` frame."""
    here = [o for o in outcomes if o.present]
    of_any: Figures = {
        "top1_overlap_50": _mean([float((o.overlap_mean >= 0.5).mean()) for o in here]),
        "top5_overlap_50": _mean([_any_of_five(o) for o in here]),
        "top1_overlap_30": _mean([float((o.overlap_mean >= OVERLAPS).mean()) for o in here]),
        "mean_overlap": _mean([float(o.overlap_mean.mean()) for o in here]),
    }
    best = overlap_figures([[float(o.overlap_mean.max())] for o in here])
    return {"oracle": best, "random": of_any}


def _any_of_five(outcome: QueryOutcome) -> float:
    """Return the probability that one of five random frames overlaps by at least a half."""
    n, good = len(outcome.overlap_mean), int((outcome.overlap_mean >= 0.5).sum())
    return 1.0 - math.comb(n - good, 5) / math.comb(n, 5) if n >= 5 else float(good > 0)


def validation(outcomes: Sequence[QueryOutcome]) -> dict[str, float | int | None]:
    """Return the precision and recall of acceptance over all validated pairs.

    `precision`: share of accepted pairs whose transform is right within 10 cm and 10 degrees.
    `recall`: share of right transforms that are accepted. `recall_overlap_30`: the same for pairs
    with an overlap (smaller direction) of at least 30 %. `precision_strong`: precision of strong
    pairs. The other figures are counts; `right_but_...` are counts of right transforms.
    """
    return validation_of([p for o in outcomes for p in o.pairs.values()])


def validation_of(pairs: Sequence[ValidatedPair]) -> dict[str, float | int | None]:
    """Return counts, precision and recall of the verdicts on pairs; without accepted pairs,
    precision is null.

    Strong matches and pairs of different scenes are also counted separately.
    """
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


def absent(outcomes: Sequence[QueryOutcome]) -> dict[str, float | int | None]:
    """Return the shares of queries that are accepted although their scene is not in the database.

    `accepted_strong` and `accepted_weak` refer to VDR's first match; null if there are none.
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


def answers(judged: Sequence[JudgedAnswer]) -> dict[str, Any]:
    """Return the outcomes of answers as shares of all queries; the first four add up to 1.

    `found_right`: found with an error within the limits of the answer. `found_wrong`: found with a
    larger error, or in an absent scene. `grossly_wrong`: found with an error beyond GROSS;
    `grossly_wrong_at_most` is the upper bound of this rate (95 %, one-sided). `found_strong_wrong`:
    strong, but wrong. `wrong_of_found`: share of found answers that are wrong.
    `calibration_error`: mean difference between the confidence of the most likely pose and the
    share of such poses that are right. `reliability`: see Calibration.bins. Figures are null
    without queries.
    """
    figures = _calibration(judged)
    wrong = [answer.status == "found" and not answer.right for answer in judged]
    gross = [answer.grossly_wrong for answer in judged]
    return {
        "queries": len(judged),
        "found_right": _share([answer.right for answer in judged]),
        "found_wrong": _share(wrong),
        "ambiguous": _share([answer.status == "ambiguous" for answer in judged]),
        "not_found": _share([answer.status == "not_found" for answer in judged]),
        "grossly_wrong": _share(gross),
        "grossly_wrong_at_most": upper_bound(sum(gross), len(judged)),
        "found_strong_wrong": _share(
            [answer.strength == "strong" and w for answer, w in zip(judged, wrong, strict=True)]
        ),
        "wrong_of_found": _share(
            [w for answer, w in zip(judged, wrong, strict=True) if answer.status == "found"]
        ),
        "calibration_error": None if figures is None else figures.error,
        "reliability": None if figures is None else figures.bins,
    }


def _calibration(judged: Sequence[JudgedAnswer]) -> Calibration | None:
    """Return the calibration of the most likely pose of each query; None if there are no poses."""
    best = [answer.places[0] for answer in judged if answer.places]
    if not best:
        return None
    return calibration([place.confidence for place in best], [place.right for place in best])


@dataclass(frozen=True)
class Calibration:
    """The calibration of confidences.

    Parameters
    ----------
    error : expected calibration error over ten bins of equal width
    brier : mean squared difference between confidence and outcome
    bins : (number of poses, mean confidence, share of right poses) for each non-empty bin
    """

    error: float
    brier: float
    bins: tuple[tuple[int, float, float], ...]


def calibration(confidences: Sequence[float], right: Sequence[bool]) -> Calibration:
    """Return the calibration of confidences.

    `confidences`, `right`: confidence and correctness of each pose; at least one pose. Raise
    ValueError if the lengths differ or are 0.
    """
    if len(confidences) != len(right) or not len(right):
        raise ValueError(
            f"There are {len(confidences)} confidences for {len(right)} poses. Pass one confidence "
            "per pose, and at least one pose."
        )
    c, y = np.array(confidences, float), np.array(right, float)
    which = np.minimum((c * 10).astype(int), 9)
    bins = tuple(
        (int((which == k).sum()), float(c[which == k].mean()), float(y[which == k].mean()))
        for k in range(10)
        if (which == k).any()
    )
    error = sum(n * abs(mean - share) for n, mean, share in bins) / len(y)
    return Calibration(float(error), float(np.mean((c - y) ** 2)), bins)


def first_error(outcome: QueryOutcome, of: str) -> Error:
    """Return the error of a row's first answer; infinite if there is none."""
    views = outcome.views(of)
    return views[0].error if views else Error()


def _strong(pairs: Sequence[ValidatedPair]) -> int:
    return sum(p.accepted and p.validation.strength == "strong" for p in pairs)


def _share(hits: Sequence[bool]) -> float | None:
    return sum(hits) / len(hits) if hits else None


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _median(values: Sequence[float]) -> float | None:
    middle = float(np.median(values))
    return middle if math.isfinite(middle) else None


# Stages at which queries fail.
#
# Outcome, ...  --lost-->  counts

#: Outcomes of queries; see `place_of`.
PLACES = (
    "found", "near", "wrongly_accepted", "nothing_overlaps", "not_in_r", "not_in_c", "ambiguous",
    "rejected",
)  # fmt: skip


def lost(outcomes: Sequence[QueryOutcome]) -> dict[str, int]:
    """Return the number of queries with each outcome of PLACES; see `place_of`."""
    counts = Counter(place_of(outcome) for outcome in outcomes)
    return {place: counts[place] for place in PLACES}


def place_of(outcome: QueryOutcome) -> str:
    """Return the outcome of a query, one of PLACES.

    If a match is accepted: `found` if the error of VDR is within 10 cm and 10 degrees, `near`
    within 20 cm and 20 degrees, else `wrongly_accepted`. Otherwise, the first that applies:
    `nothing_overlaps` if no database frame overlaps the query by 30 % (smaller direction, within 10
    cm), as in absent scenes; `not_in_r` or `not_in_c` if no such frame is in R or in C; `ambiguous`
    if such a frame in C is ambiguous; `rejected`.
    """
    answers = outcome.views("VDR")
    if answers:
        error = answers[0].error
        if error.within(0.10, 10):
            return "found"
        return "near" if error.within(0.20, 20) else "wrongly_accepted"
    good = set(outcome.allowed[outcome.overlap_least >= OVERLAPS].tolist())
    if not good:
        return "nothing_overlaps"
    if not good & set(outcome.ranking):
        return "not_in_r"
    selected = good & set(outcome.selection)
    if not selected:
        return "not_in_c"
    states = {outcome.pairs[match].validation.status for match in selected}
    return "ambiguous" if "ambiguous" in states else "rejected"


# The effect of diversification: the paper's two figures.

#: Edge length of a voxel, metres; maximum depth of a surface that counts, metres; stride of pixels.
VOXEL, FARTHEST, PIXELS = 0.02, 4.0, 2

Voxels = NDArray[np.int64]


def diversity(
    outcomes: Sequence[QueryOutcome], poses: Sequence[Floats], database: Callable[[int], AnyFrame]
) -> dict[str, Any]:
    """Return figures on the distances of the first five matches, and on the voxels that they cover.

    `translation` contains, for R, DR, VR and VDR, the mean and the standard deviation of the
    distances between the query and its five matches, metres, averaged over queries. `coverage`
    contains, for VR and VDR, the number of 2 cm voxels that the validated views observe up to a
    depth of 4 m, averaged over queries. Positions are those of the reference poses. VR and VDR are
    compared with equal numbers of views, on queries with at least two views of each; null without
    such queries.

    Parameters
    ----------
    poses : (4, 4) pose of each database frame
    database : function that returns the frame of a database index, with its pose
    """
    compared = [(o, *equal_views(o)) for o in outcomes]
    compared = [row for row in compared if len(row[1]) >= 2]
    ranked = [(o, _of_scene(o, "R"), _of_scene(o, "DR")) for o in outcomes]
    ranked = [row for row in ranked if min(len(row[1]), len(row[2])) >= 2]
    translation = {
        "R": _translation([(o, r) for o, r, _ in ranked], poses),
        "DR": _translation([(o, d) for o, _, d in ranked], poses),
        "VR": _translation([(o, r) for o, r, _ in compared], poses),
        "VDR": _translation([(o, d) for o, _, d in compared], poses),
    }
    covered = coverage(outcomes, database)
    # Omit queries whose views do not show any surface within FARTHEST.
    both = [pair for pair in covered if pair is not None and pair[0] > 0]
    ranked_mean, diverse_mean = np.mean(both, axis=0).tolist() if both else (0.0, 0.0)
    return {
        "queries": len(ranked),
        "queries_validated": len(compared),
        "translation": translation,
        "coverage": {
            "VR": ranked_mean if both else None,
            "VDR": diverse_mean if both else None,
            "ratio_of_means": diverse_mean / ranked_mean if both else None,
            "mean_ratio": float(np.mean([d / r for r, d in both])) if both else None,
        },
    }


def equal_views(outcome: QueryOutcome) -> tuple[list[ValidatedPair], list[ValidatedPair]]:
    """Return equally many of the first validated views of VR and of VDR in the query's scene."""
    ranked, diverse = (_of_scene(outcome, of) for of in ("VR", "VDR"))
    n = min(len(ranked), len(diverse))
    return ranked[:n], diverse[:n]


def coverage(
    outcomes: Sequence[QueryOutcome], database: Callable[[int], AnyFrame]
) -> list[tuple[int, int] | None]:
    """Return, for each query, the numbers of voxels that the views of VR and of VDR cover.

    The result for a query with fewer than two views is None.
    """

    @lru_cache(256)
    def seen(match: int) -> Voxels:
        return voxels(database(match))

    def count(views: list[ValidatedPair]) -> int:
        return len(np.unique(np.concatenate([seen(pair.match) for pair in views])))

    result: list[tuple[int, int] | None] = []
    for outcome in outcomes:
        ranked, diverse = equal_views(outcome)
        result.append((count(ranked), count(diverse)) if len(ranked) >= 2 else None)
    return result


def voxels(frame: AnyFrame) -> Voxels:
    """Return the keys of the voxels that a frame observes, in the grid of its parent frame."""
    points = points_of(frame, PIXELS, FARTHEST)
    if frame.pose is None:
        raise ValueError(f"{frame.name} has no pose. Pass frames with poses.")
    cells = np.floor(transform_points(frame.pose, points) / VOXEL).astype(np.int64)
    half = 1 << 20  # 21 bits per axis: 20 km in each direction
    x, y, z = (cells + half).T
    return np.unique((x << 42) | (y << 21) | z)


def points_of(frame: AnyFrame, step: int, farthest: float) -> Floats:
    """Return the points (N, 3) of every `step`-th row and column, or all points of a cloud.

    Points at `farthest` metres or more are omitted.
    """
    if isinstance(frame, Cloud):
        every: Floats = frame.points.astype(float)
        near: Floats = every[np.linalg.norm(every, axis=1) < farthest]
        return near
    k = frame.intrinsics
    points = points_at(frame, *np.mgrid[0 : k.height : step, 0 : k.width : step])
    return points[(points[..., 2] > 0) & (points[..., 2] < farthest)]


def _of_scene(outcome: QueryOutcome, of: str) -> list[ValidatedPair]:
    """Return the pairs in the query's scene among the first five."""
    return [pair for pair in outcome.views(of)[:VIEWS] if pair.same_scene]


def _translation(
    rows: Sequence[tuple[QueryOutcome, list[ValidatedPair]]], poses: Sequence[Floats]
) -> dict[str, float | None]:
    """Return `mean_m` and `std_m` of the distances between queries and views; see `diversity`."""
    if not rows:
        return {"mean_m": None, "std_m": None}
    distances = [
        np.array([np.linalg.norm(poses[p.match][:3, 3] - o.pose[:3, 3]) for p in views])
        for o, views in rows
    ]
    return {
        "mean_m": float(np.mean([d.mean() for d in distances])),
        "std_m": float(np.mean([d.std() for d in distances])),
    }
