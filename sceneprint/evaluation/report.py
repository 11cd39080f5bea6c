"""The figures of an evaluation, as JSON and as a table to read.

Evaluation  --figures-->  dict  --to_json-->  bytes        dict  --table-->  lines
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from sceneprint.evaluation.beside import baseline_rows, recalls
from sceneprint.evaluation.diversity import diversity
from sceneprint.evaluation.lost import lost, place_of
from sceneprint.evaluation.measures import absent, bound, oracle_and_random, rows, validation
from sceneprint.evaluation.records import Error, Outcome, Pair
from sceneprint.evaluation.run import Evaluation
from sceneprint.types import AnyFrame, Floats

#: Of JSON: raised when a key changes its meaning.
SCHEMA_VERSION = 1

ROWS = ("R", "VR", "DR", "VDR", "pose_average", "pose_average_vr")


def figures(
    evaluation: Evaluation,
    database: Callable[[int], AnyFrame],
    settings: dict[str, Any],
) -> dict[str, Any]:
    """Every figure of an evaluation, ready for JSON.

    At the top, all queries against the whole database (of several scenes, the paper's
    `Combine`). `by_scene` has the same for the queries of each scene, where there are several;
    `scenes` has each scene with a database of its own and `average` the mean of their rows,
    for a 7-Scenes table. `recall` and `baselines`: see there.

    Parameters
    ----------
    evaluation : see Evaluation
    database : gives the frame of a database index, with its pose
    settings : all that is needed to repeat it
    """
    prepared = evaluation.prepared
    poses = [member.pose for member in prepared.database]
    found: dict[str, Any] = {"schema_version": SCHEMA_VERSION, "settings": settings}
    found["counts"] = {
        "queries": len(prepared.queries),
        "database": len(prepared.database),
        "left_out": len(prepared.left_out),
    }
    found["left_out"] = [{"name": n, "reason": why} for n, why in prepared.left_out]
    found |= measured(evaluation.outcomes, poses, database)
    found["recall"] = recalls(evaluation)
    if evaluation.compared:
        found["baselines"] = baseline_rows(evaluation)
    scenes = list(dict.fromkeys(o.scene for o in evaluation.outcomes))
    if len(scenes) > 1:
        found["by_scene"] = {
            scene: measured([o for o in evaluation.outcomes if o.scene == scene], poses, database)
            for scene in scenes
        }
    if evaluation.alone:
        found["scenes"] = {
            scene: measured(outcomes, poses, database)
            for scene, outcomes in evaluation.alone.items()
        }
        found["average"] = average([found["scenes"][scene] for scene in found["scenes"]])
    found["milliseconds"] = {
        "prepare": prepared.milliseconds,
        **milliseconds(evaluation.outcomes),
    }
    names = [member.name for member in prepared.database]
    found["per_query"] = [per_query(outcome, names) for outcome in evaluation.outcomes]
    found["mistakes"] = mistakes(evaluation.outcomes, names)
    cleaned: dict[str, Any] = without_infinities(found)
    return cleaned


def measured(
    outcomes: Sequence[Outcome], poses: Sequence[Floats], database: Callable[[int], AnyFrame]
) -> dict[str, Any]:
    """All figures of some queries."""
    return {
        **rows(outcomes),
        "bound": bound(outcomes),
        **oracle_and_random(outcomes),
        "validation": validation(outcomes),
        "diversity": diversity(outcomes, poses, database),
        "lost": lost(outcomes),
        "absent": absent(outcomes),
    }


def average(scenes: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The mean of each figure of each row over scenes; null where a scene has none."""
    result: dict[str, Any] = {}
    for row in ROWS:
        columns = {key: [scene[row][key] for scene in scenes] for key in scenes[0][row]}
        result[row] = {
            key: None if None in values else float(np.mean(values))
            for key, values in columns.items()
        }
    return result


def milliseconds(outcomes: Sequence[Outcome]) -> dict[str, float | None]:
    """Median time of each stage: of a query, or under `validate` of one pair."""
    stages: dict[str, list[float]] = {
        stage: [o.milliseconds[stage] for o in outcomes if stage in o.milliseconds]
        for stage in ("rank", "compare_ranking", "diversify", "average")
    }
    stages["validate"] = [pair.milliseconds for o in outcomes for pair in o.pairs.values()]
    return {stage: float(np.median(ms)) if ms else None for stage, ms in stages.items()}


def per_query(outcome: Outcome, names: Sequence[str]) -> dict[str, Any]:
    """What one query came to: to look into what was lost, and to hold other answers to it.

    `ranking` has the first of R, `selection` all of C, `matches` all pairs of C in the order in
    which `associate` gives them.
    """
    answers = outcome.views("VDR")
    best = int(np.argmax(outcome.overlap_mean)) if len(outcome.overlap_mean) else None
    return {
        "name": outcome.name,
        "lost": place_of(outcome),
        "best_overlap": None if best is None else float(outcome.overlap_mean[best]),
        "R": _answer(outcome, outcome.ranking[:1], names),
        "VDR": _answer(outcome, [pair.match for pair in answers[:1]], names),
        "accepted": len(answers),
        "pose_average": _error(outcome.average),
        "ranking": [names[match] for match in outcome.ranking[: outcome.candidates]],
        "selection": [names[match] for match in outcome.selection],
        "matches": _matches(outcome, names),
    }


def _matches(outcome: Outcome, names: Sequence[str]) -> list[dict[str, Any]]:
    distance = dict(zip(outcome.ranking, outcome.distances.tolist(), strict=True))
    return [
        {
            "match": names[pair.match],
            "distance": distance[pair.match],
            "status": pair.validation.status,
            "strength": pair.validation.strength,
            "T_match_query": None if (T := pair.validation.T_match_query) is None else T.tolist(),
        }
        for pair in outcome.tried()
    ]


def mistakes(outcomes: Sequence[Outcome], names: Sequence[str]) -> list[dict[str, Any]]:
    """Pairs that were accepted with a wrong transform, or not accepted with a right one."""
    return [
        {
            "query": outcome.name,
            "same_scene": pair.same_scene,
            "overlap_least": pair.overlap_least,
            "residual_m": pair.validation.residual_m,
            "residual_rad": pair.validation.residual_rad,
            "agreement": pair.validation.overlap,
            "plane_agreement": pair.validation.plane_overlap,
            "violations": pair.validation.violations,
            **_described(pair, names),
        }
        for outcome in outcomes
        for pair in outcome.pairs.values()
        if pair.accepted != pair.right
    ]


def _answer(outcome: Outcome, first: list[int], names: Sequence[str]) -> dict[str, Any] | None:
    if not first:
        return None
    return _described(outcome.pairs[first[0]], names)


def _described(pair: Pair, names: Sequence[str]) -> dict[str, Any]:
    v = pair.validation
    return {
        "match": names[pair.match],
        "overlap": pair.overlap_mean,
        "status": v.status,
        "strength": v.strength,
        "reason": v.reason,
        "ambiguity": v.ambiguity,
        **_error(pair.error),
    }


def _error(error: Error) -> dict[str, float]:
    return {"translation_m": error.metres, "rotation_deg": math.degrees(error.radians)}


def without_infinities(value: Any) -> Any:
    """The same with null for what JSON has no number for."""
    if isinstance(value, dict):
        return {key: without_infinities(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [without_infinities(one) for one in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def to_json(found: dict[str, Any]) -> bytes:
    """Bytes of a JSON file."""
    return (json.dumps(found, indent=1, allow_nan=False) + "\n").encode()
