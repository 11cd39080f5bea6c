"""The rows of the table from the answers of a service, by the true poses.

Answers of VR and of VDR, poses  --judge_answers-->  Judgement, ...  --answer_rows-->  figures
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sceneprint.evaluation.measures import Figures, accuracy
from sceneprint.evaluation.records import VIEWS, Error, pose_error
from sceneprint.geometry.rigid import inverse
from sceneprint.schemas import Answer, Match
from sceneprint.types import Floats


@dataclass(frozen=True, eq=False)
class Place:
    """Where a frame was taken: T_parent_sensor (4, 4), in a parent frame."""

    parent: str
    pose: Floats


@dataclass(frozen=True, eq=False)
class Judgement:
    """How far off the answers to one query are.

    Parameters
    ----------
    first : of each row, error of its first answer; infinite where it has none
    spread : of each row, mean and standard deviation of the distance between the query and the
        first five frames, metres; None with fewer than two of its parent frame
    """

    first: Mapping[str, Error]
    spread: Mapping[str, tuple[float, float] | None]


def judge_answers(
    truth: Place, ranked: Answer, diverse: Answer, known: Mapping[str, Place]
) -> Judgement:
    """Judge two answers to one query.

    Parameters
    ----------
    truth : of the query
    ranked : asked without diversification, for as many matches as are validated
    diverse : asked with all stages, likewise
    known : places of the database frames by their id
    """
    first = {
        "R": _first(_by_rank(ranked), truth, known),
        "VR": _first(_accepted(ranked), truth, known),
        "DR": _first(_by_rank(diverse), truth, known),
        "VDR": _first(_accepted(diverse), truth, known),
        "pose_average": _located(diverse, truth),
    }
    spread = {
        "R": _spread(_by_rank(ranked), truth, known),
        "VR": _spread(_accepted(ranked), truth, known),
        "DR": _spread(_by_rank(diverse), truth, known),
        "VDR": _spread(_accepted(diverse), truth, known),
    }
    return Judgement(first, spread)


def answer_rows(judged: Sequence[Judgement]) -> dict[str, Figures]:
    """The figures of each row over queries, as `measures.rows` defines them.

    `spread_mean_m` and `spread_std_m`: as in Judgement, averaged over the queries that have them.
    """
    rows: dict[str, Figures] = {}
    for row in ("R", "VR", "DR", "VDR", "pose_average"):
        spreads = [found for one in judged if (found := one.spread.get(row)) is not None]
        mean = np.mean(spreads, axis=0).tolist() if spreads else (None, None)
        rows[row] = accuracy([one.first[row] for one in judged]) | {
            "spread_mean_m": mean[0],
            "spread_std_m": mean[1],
        }
    return rows


def _by_rank(answer: Answer) -> list[Match]:
    return sorted(answer.matches, key=lambda match: match.rank)


def _accepted(answer: Answer) -> list[Match]:
    return [match for match in answer.matches if match.validation.status == "accepted"]


def _first(matches: Sequence[Match], truth: Place, known: Mapping[str, Place]) -> Error:
    if not matches:
        return Error()
    match = matches[0]
    place = known[match.frame_id]
    if match.transform is None or place.parent != truth.parent:
        return Error()
    return pose_error(np.array(match.transform.matrix), inverse(place.pose) @ truth.pose)


def _located(answer: Answer, truth: Place) -> Error:
    if answer.location is None or answer.location.pose.parent_frame != truth.parent:
        return Error()
    return pose_error(np.array(answer.location.pose.matrix), truth.pose)


def _spread(
    matches: Sequence[Match], truth: Place, known: Mapping[str, Place]
) -> tuple[float, float] | None:
    places = [known[match.frame_id] for match in matches[:VIEWS]]
    metres = [
        float(np.linalg.norm(place.pose[:3, 3] - truth.pose[:3, 3]))
        for place in places
        if place.parent == truth.parent
    ]
    return (float(np.mean(metres)), float(np.std(metres))) if len(metres) >= 2 else None
