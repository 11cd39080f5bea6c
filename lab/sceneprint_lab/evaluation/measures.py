"""Measure rankings, accuracy, acceptance, and what diversification brings."""

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

#: The k of recall@k.
FIRST = (1, 5, 10)
#: Overlap, by the definition of retrieval, from which a frame shows the query's place.
OVERLAP = 0.5


def metres_apart(queries: Sequence[SignedFrame], database: Sequence[SignedFrame]) -> Floats:
    """Return (Q, N) distance of the sensors by the true poses; infinite between scenes."""
    there = np.array([m.pose[:3, 3] for m in queries])
    here = np.array([m.pose[:3, 3] for m in database])
    same = np.array([m.scene for m in queries])[:, None] == np.array([m.scene for m in database])
    apart = np.linalg.norm(there[:, None] - here, axis=2)
    return np.where(same, apart, np.inf)


def recall(
    relevant: NDArray[np.bool_], allowed: NDArray[np.bool_], rankings: Sequence[Sequence[int]]
) -> dict[str, float | int | None]:
    """Return share of queries that have a relevant frame among the first k, of those that have one.

    Parameters
    ----------
    relevant : (Q, N), whether a database frame shows the query's place
    allowed : (Q, N), whether the query may find it
    rankings : of each query database indices, nearest first, all of them allowed

    Returns
    -------
    figures : `queries` that may find a relevant frame, and the share of each k of FIRST; null
        where there is no such query
    """
    able = np.flatnonzero((relevant & allowed).any(axis=1)).tolist()
    found: dict[str, float | int | None] = {"queries": len(able)}
    for k in FIRST:
        hits = [any(relevant[i, j] for j in rankings[i][:k]) for i in able]
        found[f"at_{k}"] = sum(hits) / len(hits) if hits else None
    return found


# How sure a counted rate is, and how well one number tells right from wrong.
#
# counts  --upper_bound-->  rate        scores, labels  --roc-->  Roc

#: Of the bound on a rate.
CONFIDENCE = 0.95
#: Points of a curve that are kept.
CURVE = 200


def upper_bound(seen: int, of: int, confidence: float = CONFIDENCE) -> float | None:
    """Return the rate above which so few would be seen with less than 1 - `confidence`.

    One-sided Clopper-Pearson. Of none seen it is 1 - (1 - confidence)^(1 / of), which for 95 % is
    about 3 / of: the rule of three. It holds for independent tries; pairs that share frames are
    not, and say less.

    Parameters
    ----------
    seen, of : 0 <= seen <= of
    confidence : between 0 and 1

    Returns
    -------
    rate : None where nothing was tried
    """
    if not 0 <= seen <= of or not 0 < confidence < 1:
        raise ValueError(f"{seen} of {of} at {confidence} is no rate")
    if of == 0:
        return None
    low, high = seen / of, 1.0
    while (middle := (low + high) / 2) not in (low, high):  # until no number lies between
        low, high = (middle, high) if _at_most(seen, of, middle) > 1 - confidence else (low, middle)
    return high


def _at_most(seen: int, of: int, rate: float) -> float:
    """Return chance of at most `seen` hits in `of` independent tries."""
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
    """Right and wrong ones that pass, as the least score that is asked for falls.

    Parameters
    ----------
    area : under the curve: the chance that a right one scores higher than a wrong one, ties half
    false, true : (n,) share of the wrong and of the right ones that pass, from 0 to 1
    thresholds : (n,) least score; infinite at first
    """

    area: float
    false: Floats
    true: Floats
    thresholds: Floats

    def true_at(self, false: float) -> float:
        """Return the most right ones that pass while at most this share of the wrong ones does."""
        return float(self.true[self.false <= false].max())

    def thinned(self, most: int = CURVE) -> list[list[float]]:
        """Return at most so many points (false, true, threshold), the ends among them."""
        n = len(self.true)
        kept = np.arange(n)
        if n > most:
            kept = self._kept(most)
        columns = zip(self.false[kept], self.true[kept], self.thresholds[kept], strict=True)
        return [[float(one) for one in row] for row in columns]

    def _kept(self, most: int) -> NDArray[np.intp]:
        n = len(self.true)
        # evenly along both shares, so that neither end of the curve is lost
        at = np.linspace(0, 2, most - 1)
        return np.unique(np.append(np.searchsorted(self.false + self.true, at).clip(0, n - 1), 0))


def roc(scores: Floats, right: NDArray[np.bool_]) -> Roc | None:
    """Return the curve of one number that should be high for right ones.

    Parameters
    ----------
    scores : (n,), -infinity where there is nothing to be said for it
    right : (n,)

    Returns
    -------
    curve : None where all are right, or none
    """
    n_right, n_wrong = int(right.sum()), int((~right).sum())
    if not n_right or not n_wrong:
        return None
    values, place = np.unique(-scores, return_inverse=True)  # highest first, equal ones together
    good = np.bincount(place[right], minlength=len(values)).cumsum()
    bad = np.bincount(place[~right], minlength=len(values)).cumsum()
    true = np.concatenate([[0], good]) / n_right
    false = np.concatenate([[0], bad]) / n_wrong
    area = float(((true[1:] + true[:-1]) / 2 * np.diff(false)).sum())
    return Roc(area, false, true, np.concatenate([[np.inf], -values]))


# The rows of the table: how far off the answers are, and whether they are rightly believed.
#
# Outcome, ...  --rows, validation, oracle_and_random-->  figures

Figures = dict[str, float | int | None]

#: Overlap from which a frame counts as showing the same place.
OVERLAPS = 0.3


def rows(outcomes: Sequence[QueryOutcome]) -> dict[str, Figures]:
    """Return each way to answer, over the queries whose scene is in the database.

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


def bound(outcomes: Sequence[QueryOutcome]) -> dict[str, Figures]:
    """Return what registration of the same pairs could reach: refinement started at the true pose.

    `VDR` for the first pair of VDR, `pose_average` for the views that are averaged. A query
    without such a pair is a failure here as it is there.
    """
    here = [o for o in outcomes if o.present]
    return {
        "VDR": accuracy([bound_of(o) for o in here]),
        "pose_average": accuracy([o.average_bound for o in here]),
    }


def bound_of(outcome: QueryOutcome) -> Error:
    """Return where refinement from the true pose ends for the pair VDR answers with."""
    first = outcome.views("VDR")[:1]
    return first[0].bound or Error() if first else Error()


def accuracy(errors: Sequence[Error]) -> Figures:
    """Return shares of errors within the two thresholds, and medians; null where there is none.

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


def overlap_figures(five: Sequence[Sequence[float]]) -> Figures:
    """Return how much the first match and the first five see of what the query sees.

    Parameters
    ----------
    five : of each query, the overlap of retrieval of its first five matches
    """
    first = [overlaps[0] for overlaps in five]
    return {
        "top1_overlap_50": _share([f >= 0.5 for f in first]),
        "top5_overlap_50": _share([max(f) >= 0.5 for f in five]),
        "top1_overlap_30": _share([f >= OVERLAPS for f in first]),
        "mean_overlap": _mean(first),
    }


def retrieval(outcomes: Sequence[QueryOutcome], of: str) -> Figures:
    """Return `overlap_figures` of a row, and the share of first matches of the query's scene."""
    figures = overlap_figures([[p.overlap_mean for p in o.views(of)[:5]] for o in outcomes])
    return figures | {"right_scene": _share([o.views(of)[0].same_scene for o in outcomes])}


def oracle_and_random(outcomes: Sequence[QueryOutcome]) -> dict[str, Figures]:
    """Return the figures of the best frame of the database, and the expected ones of a random."""
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
    """Return chance that five different frames hold one that overlaps by half."""
    n, good = len(outcome.overlap_mean), int((outcome.overlap_mean >= 0.5).sum())
    return 1.0 - math.comb(n - good, 5) / math.comb(n, 5) if n >= 5 else float(good > 0)


def validation(outcomes: Sequence[QueryOutcome]) -> dict[str, float | int | None]:
    """Return whether acceptance can be trusted, over all pairs that were validated.

    `precision`: accepted pairs whose transform is right to 10 cm and 10 degrees, over accepted.
    `recall`: the same over all pairs whose transform is right. `recall_overlap_30`: over those
    whose overlap (smaller direction) is 30 % or more. Counts: `pairs`, `accepted`,
    `accepted_strong`; of right transforms `right_but_rejected` and `right_but_ambiguous`; of
    other scenes `pairs_of_other_scenes`, `accepted_of_other_scenes`,
    `accepted_strong_of_other_scenes`.
    """
    return validation_of([p for o in outcomes for p in o.pairs.values()])


def validation_of(pairs: Sequence[ValidatedPair]) -> dict[str, float | int | None]:
    """Return the same of some pairs; precision is null where none of them was accepted."""
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
    """Return how often a query is believed to be found where its scene is not in the database.

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


def answers(told: Sequence[JudgedAnswer]) -> dict[str, Any]:
    """Return what robots are told, as shares of all queries; the first four add up to 1.

    `found_right`: within 10 cm and 10 degrees, or the limits of the answers. `found_wrong`: found
    and not right, of absent scenes always; `grossly_wrong` of them are beyond 50 cm or 15 degrees,
    and the rate of those is below `grossly_wrong_at_most` (95 %, one-sided). `found_strong_wrong`:
    wrong ones that were called strong. `wrong_of_found`: wrong ones as a share of those that are
    found. `calibration_error`: how far the confidence of the likeliest pose is from the share of
    these that are right; `reliability`: in each tenth of confidences the number of these poses,
    their mean confidence, and the share that is right. Null where nothing was asked.
    """
    found = _calibration(told)
    wrong = [one.status == "found" and not one.right for one in told]
    gross = [one.grossly_wrong for one in told]
    return {
        "queries": len(told),
        "found_right": _share([one.right for one in told]),
        "found_wrong": _share(wrong),
        "ambiguous": _share([one.status == "ambiguous" for one in told]),
        "not_found": _share([one.status == "not_found" for one in told]),
        "grossly_wrong": _share(gross),
        "grossly_wrong_at_most": upper_bound(sum(gross), len(told)),
        "found_strong_wrong": _share(
            [one.strength == "strong" and w for one, w in zip(told, wrong, strict=True)]
        ),
        "wrong_of_found": _share(
            [w for one, w in zip(told, wrong, strict=True) if one.status == "found"]
        ),
        "calibration_error": None if found is None else found.error,
        "reliability": None if found is None else found.bins,
    }


def _calibration(told: Sequence[JudgedAnswer]) -> Calibration | None:
    """Return how well confidences predict which likeliest poses are right; None without any."""
    best = [one.places[0] for one in told if one.places]
    if not best:
        return None
    return calibration([one.confidence for one in best], [one.right for one in best])


@dataclass(frozen=True)
class Calibration:
    """How confidences compare with what was right.

    Parameters
    ----------
    error : expected calibration error over ten bins of equal width
    brier : mean square of confidence less outcome
    bins : of each bin that has poses: their number, mean confidence, and share that is right
    """

    error: float
    brier: float
    bins: tuple[tuple[int, float, float], ...]


def calibration(confidences: Sequence[float], right: Sequence[bool]) -> Calibration:
    """Return how well confidences predict what is right.

    Parameters
    ----------
    confidences, right : one for one; at least one

    Raises
    ------
    ValueError : not one for one, or none.
    """
    if len(confidences) != len(right) or not len(right):
        raise ValueError(f"{len(confidences)} confidences of {len(right)} poses")
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
    """Return how far off a row's first answer is; infinite where it has none."""
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


# Where queries are lost on their way from the database to an accepted match.
#
# Outcome, ...  --lost-->  counts

#: Every query ends in exactly one of these.
PLACES = (
    "found", "near", "wrongly_accepted", "nothing_overlaps", "not_in_r", "not_in_c", "ambiguous",
    "rejected",
)  # fmt: skip


def lost(outcomes: Sequence[QueryOutcome]) -> dict[str, int]:
    """Count the queries by where VDR lost them; the counts add up to the queries.

    See `place_of` for what each word means.
    """
    counts = Counter(place_of(outcome) for outcome in outcomes)
    return {place: counts[place] for place in PLACES}


def place_of(outcome: QueryOutcome) -> str:
    """Return the first of these that is true of a query.

    With an accepted match: `found`, VDR's answer is right to 10 cm and 10 degrees; `near`, to
    20 cm and 20 degrees; else `wrongly_accepted`. Without one: `nothing_overlaps`, no database
    frame overlaps the query by 30 % (smaller direction, within 10 cm), which holds for every
    query of an absent scene; `not_in_r`, such frames are not in R; `not_in_c`, those in R are
    not in C; `ambiguous`, one of those in C was ambiguous; else `rejected`.
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


# What diversification brings: the paper's two figures.

#: Edge of a voxel, metres; depth from which surface is not counted; every so manieth pixel.
VOXEL, FARTHEST, PIXELS = 0.02, 4.0, 2

Voxels = NDArray[np.int64]


def diversity(
    outcomes: Sequence[QueryOutcome], poses: Sequence[Floats], database: Callable[[int], AnyFrame]
) -> dict[str, Any]:
    """Return how far the first five lie from the query and from each other, and what they cover.

    `translation` has, for each of R, DR, VR and VDR, the mean and the standard deviation (within
    the five) of the distance between the query and the match, metres, by true poses, averaged
    over queries. `coverage` has the 2 cm voxels that the first validated views see (true
    poses, depth below 4 m), for VR and VDR, in the mean over queries. VR and VDR are compared
    at equal numbers of views, on queries for which both have two or more; without any, null.

    Parameters
    ----------
    outcomes : see Outcome
    poses : (4, 4) of each database frame
    database : gives the frame of a database index, with its pose
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
    # where all that a query's views see lies beyond FARTHEST there is nothing to compare
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
    """Return the first validated views of VR and VDR in the query's scene, as many of either."""
    ranked, diverse = (_of_scene(outcome, of) for of in ("VR", "VDR"))
    n = min(len(ranked), len(diverse))
    return ranked[:n], diverse[:n]


def coverage(
    outcomes: Sequence[QueryOutcome], database: Callable[[int], AnyFrame]
) -> list[tuple[int, int] | None]:
    """Return the voxels that VR's and VDR's views of each query cover; None with fewer than two."""

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
    """Return the voxels that a frame sees, as numbers that are the same for all frames."""
    points = points_of(frame, PIXELS, FARTHEST)
    if frame.pose is None:
        raise ValueError(f"{frame.name} has no pose")
    cells = np.floor(transform_points(frame.pose, points) / VOXEL).astype(np.int64)
    # 21 bits for each axis: 20 km either way
    half = 1 << 20
    x, y, z = (cells + half).T
    return np.unique((x << 42) | (y << 21) | z)


def points_of(frame: AnyFrame, step: int, farthest: float) -> Floats:
    """Return the points (N, 3) of every `step`-th pixel both ways, or of a cloud all.

    Points that are as far as `farthest` metres are left out.
    """
    if isinstance(frame, Cloud):
        every: Floats = frame.points.astype(float)
        near: Floats = every[np.linalg.norm(every, axis=1) < farthest]
        return near
    k = frame.intrinsics
    points = points_at(frame, *np.mgrid[0 : k.height : step, 0 : k.width : step])
    return points[(points[..., 2] > 0) & (points[..., 2] < farthest)]


def _of_scene(outcome: QueryOutcome, of: str) -> list[ValidatedPair]:
    """Return the first five, less those of other scenes: they lie nowhere in this one."""
    return [pair for pair in outcome.views(of)[:VIEWS] if pair.same_scene]


def _translation(
    rows: Sequence[tuple[QueryOutcome, list[ValidatedPair]]], poses: Sequence[Floats]
) -> dict[str, float | None]:
    if not rows:
        return {"mean_m": None, "std_m": None}
    each = [
        np.array([np.linalg.norm(poses[p.match][:3, 3] - o.pose[:3, 3]) for p in views])
        for o, views in rows
    ]
    return {
        "mean_m": float(np.mean([d.mean() for d in each])),
        "std_m": float(np.mean([d.std() for d in each])),
    }
