"""The figures of pairs of frames, ready for JSON.

PairEvaluation  --pair_figures-->  dict
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from sceneprint.evaluation.measures import Figures, accuracy, validation_of
from sceneprint.evaluation.pair_drawing import BINS
from sceneprint.evaluation.pair_run import PairEvaluation
from sceneprint.evaluation.pair_statistics import curves, evidence
from sceneprint.evaluation.pair_trying import Tried
from sceneprint.evaluation.planarity import PLANAR
from sceneprint.evaluation.rates import CONFIDENCE, upper_bound
from sceneprint.evaluation.records import Error, Pair
from sceneprint.evaluation.registration_baselines import METHODS
from sceneprint.evaluation.report import without_infinities
from sceneprint.geometry.acceptance import AcceptanceParameters

#: Of JSON: raised when a key changes its meaning.
SCHEMA_VERSION = 1


def pair_figures(evaluation: PairEvaluation, settings: dict[str, Any]) -> dict[str, Any]:
    """Every figure of an evaluation of pairs.

    Parameters
    ----------
    evaluation : see PairEvaluation
    settings : all that is needed to repeat it
    """
    members, tried = evaluation.members, evaluation.tried
    scenes = list(dict.fromkeys(member.scene for member in members))
    scene_of = [member.scene for member in members]
    found: dict[str, Any] = {"schema_version": SCHEMA_VERSION, "settings": settings}
    found["counts"] = {
        "frames": {scene: scene_of.count(scene) for scene in scenes},
        "planar": {
            scene: sum(
                own == scene and bool(share >= PLANAR)
                for own, share in zip(scene_of, evaluation.planes, strict=True)
            )
            for scene in scenes
        },
        "left_out": len(evaluation.left_out),
        "pairs": len(tried),
    }
    found["left_out"] = [{"name": n, "reason": why} for n, why in evaluation.left_out]
    limits = evaluation.limits
    found["bins"] = bins(tried, limits)
    found["negatives"] = negatives(evaluation)
    found["validation"] = validation_of([one.pair for one in tried])
    if len(scenes) > 1:
        found["scenes"] = {
            scene: _of_scene([one for one in tried if _within(one, scene, scene_of)], limits)
            for scene in scenes
        }
    found["roc"] = curves([one.pair for one in tried], evaluation.acceptance)
    found["milliseconds"] = {
        "prepare": evaluation.prepare_ms,
        "validate": _median([one.pair.milliseconds for one in tried]),
    }
    if any(one.others is not None for one in tried):
        found["baselines"] = baselines(tried, limits)
    found["failures"] = failures(evaluation)
    cleaned: dict[str, Any] = without_infinities(found)
    return cleaned


def _within(one: Tried, scene: str, scene_of: Sequence[str]) -> bool:
    return scene_of[one.drawn.query] == scene_of[one.drawn.match] == scene


def _of_scene(tried: Sequence[Tried], limits: tuple[float, float]) -> dict[str, Any]:
    """Figures of the pairs of one scene, its negatives among them."""
    return {
        "bins": bins(tried, limits),
        "same_scene": rate([one for one in tried if one.drawn.kind == "same_scene"]),
        "validation": validation_of([one.pair for one in tried]),
    }


def bins(tried: Sequence[Tried], limits: tuple[float, float]) -> dict[str, dict[str, Any]]:
    """By true overlap: how often the transform is right, accepted or not, and whether believed.

    `success`: of the transform that validation found; `right`: to the limits of the evaluation.
    `bound`: of refinement started at the true pose. Without a transform a pair is a failure.
    `validation`: see `measures.validation`.
    """
    found = {}
    for name in BINS:
        own = [one.pair for one in tried if one.drawn.bin == name]
        found[name] = {
            "pairs": len(own),
            "success": _shares([pair.error for pair in own], limits),
            "bound": _shares([pair.bound or Error() for pair in own], limits),
            "validation": validation_of(own),
        }
    return found


def _shares(errors: Sequence[Error], limits: tuple[float, float]) -> Figures:
    figures = accuracy(errors)
    right = sum(e.within(*limits) for e in errors) / len(errors) if errors else None
    return {
        "within_5cm_5deg": figures["within_5cm_5deg"],
        "within_10cm_10deg": figures["within_10cm_10deg"],
        "right": right,
    }


def negatives(evaluation: PairEvaluation) -> dict[str, Any]:
    """How many pairs that see nothing of each other were accepted, and how many may be.

    `planar`: the pairs of two scenes of which a frame is planar. `by_scenes`: of every two.
    """
    tried, members = evaluation.tried, evaluation.members
    same = [one for one in tried if one.drawn.kind == "same_scene"]
    cross = [one for one in tried if one.drawn.kind == "cross_scene"]
    couples: dict[str, list[Tried]] = {}
    for one in cross:
        a, b = members[one.drawn.query].scene, members[one.drawn.match].scene
        couples.setdefault(f"{a} | {b}", []).append(one)
    return {
        "same_scene": rate(same),
        "cross_scene": rate(cross),
        "cross_scene_planar": rate([one for one in cross if one.drawn.planar]),
        "by_scenes": {name: rate(own) for name, own in couples.items()},
        "confidence": CONFIDENCE,
    }


def rate(tried: Sequence[Tried]) -> dict[str, float | int | None]:
    """Of pairs that ought not to be accepted: how many are; `upper`: see `upper_bound`."""
    accepted = [one.pair for one in tried if one.pair.accepted]
    return {
        "pairs": len(tried),
        "planar": sum(one.drawn.planar for one in tried),
        "accepted": len(accepted),
        "accepted_strong": sum(pair.validation.strength == "strong" for pair in accepted),
        "upper": upper_bound(len(accepted), len(tried)),
    }


def baselines(tried: Sequence[Tried], limits: tuple[float, float]) -> dict[str, Any]:
    """Success of others by bin on the same pairs, and what ours costs beside them.

    `start`: before refinement; `icp`: after their own; `ours`: after our refinement in its place.
    `time_ratio`: median over pairs of our time over theirs, features of both frames counted.
    """
    beside = [one for one in tried if one.others is not None]
    found: dict[str, Any] = {"pairs": len(beside), "methods": {}}
    found["milliseconds"] = _median([one.milliseconds for one in beside if one.milliseconds])
    for method in METHODS:
        by_bin = {}
        for name in BINS:
            own = [(one.others or {}).get(method) for one in beside if one.drawn.bin == name]
            by_bin[name] = {
                "start": _shares([one.start if one else Error() for one in own], limits),
                "icp": _shares([one.icp if one else Error() for one in own], limits),
                "ours": _shares([one.ours if one else Error() for one in own], limits),
            }
        both = [
            (one.milliseconds, one.others[method].milliseconds)
            for one in beside
            if one.milliseconds and one.others and method in one.others
        ]
        found["methods"][method] = {
            "bins": by_bin,
            "milliseconds": _median([theirs for _, theirs in both]),
            "time_ratio": _median([ours / theirs for ours, theirs in both]),
        }
    return found


def why(one: Tried) -> str | None:
    """What went wrong with a pair, None where nothing did.

    `wrongly_accepted`; `not_believed`: a right transform that was not accepted; `near`: off by
    up to twice the limits, and not accepted; `not_found`: farther off or without a transform,
    though the two overlap.
    """
    pair = one.pair
    if pair.accepted:
        return None if pair.right else "wrongly_accepted"
    if pair.right:
        return "not_believed"
    if one.drawn.kind != "overlapping":
        return None
    metres, degrees = pair.limits
    return "near" if pair.error.within(2 * metres, 2 * degrees) else "not_found"


def failures(evaluation: PairEvaluation) -> list[dict[str, Any]]:
    """Every pair that went wrong, the worst kind first, and all that was told of it."""
    order = ("wrongly_accepted", "not_believed", "near", "not_found")
    listed = [(why(one), number, one) for number, one in enumerate(evaluation.tried)]
    wrong = [(kind, number, one) for kind, number, one in listed if kind is not None]
    wrong.sort(key=lambda entry: (order.index(entry[0]), entry[1]))
    return [
        {
            "number": number,
            "what": kind,
            "query": evaluation.members[one.drawn.query].name,
            "match": evaluation.members[one.drawn.match].name,
            "kind": one.drawn.kind,
            "planar": one.drawn.planar,
            "true_overlap": one.drawn.overlap_least,
            **_told(one.pair, evaluation.acceptance),
            "bound": None if one.pair.bound is None else _off(one.pair.bound),
        }
        for kind, number, one in wrong
    ]


def _told(pair: Pair, p: AcceptanceParameters) -> dict[str, Any]:
    v = pair.validation
    return {
        **_off(pair.error),
        "status": v.status,
        "strength": v.strength,
        "reason": v.reason,
        "residual_m": v.residual_m,
        "residual_deg": math.degrees(v.residual_rad),
        "overlap": v.overlap,
        "plane_overlap": v.plane_overlap,
        "violations": v.violations,
        "evidence": evidence(v, p),
        "ambiguity": v.ambiguity,
        "inliers": v.inliers,
    }


def _off(error: Error) -> dict[str, float]:
    return {"translation_m": error.metres, "rotation_deg": math.degrees(error.radians)}


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if len(values) else None
