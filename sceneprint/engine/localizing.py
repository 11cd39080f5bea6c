"""An answer to the one thing a robot wants: where it is.

Answer  --localization_of-->  Localization
"""

from __future__ import annotations

from sceneprint.errors import InvalidRequest
from sceneprint.schemas import Answer, Localization, Match, Query
from sceneprint.schemas.localization import LocalizationStatus


def check_localizes(query: Query) -> None:
    """See that a query comes to a pose; InvalidRequest where it does not."""
    if "validate" not in query.stages:
        raise InvalidRequest(
            "A pose rests on validated matches. Leave `stages` out, or name `validate` in it.",
            (("stages", "without validate"),),
        )


def localization_of(answer: Answer) -> Localization:
    """Where the query was taken, and how sure that is.

    Parameters
    ----------
    answer : of a query to one map, validated
    """
    accepted = [one for one in answer.matches if one.validation.status == "accepted"]
    status: LocalizationStatus = "not_found"
    if answer.status in ("found", "ambiguous"):
        status = answer.status
    strong = any(one.validation.strength == "strong" for one in accepted)
    there = answer.location
    return Localization(
        status=status,
        reason=_reason(answer, accepted),
        map=answer.maps[0],
        pose=None if there is None else there.pose,
        support=0 if there is None else there.support,
        votes=0 if there is None else there.votes,
        spread_m=None if there is None else there.spread_m,
        spread_deg=None if there is None else there.spread_deg,
        uncertainty=None if there is None else there.uncertainty,
        base=None if there is None else there.base,
        strength=None if not accepted else "strong" if strong else "weak",
        best=accepted[0] if accepted else None,
        matches=[one.frame_id for one in accepted],
        query_id=answer.query_id,
        seed=answer.seed,
        model=answer.model,
        deadline_reached=answer.deadline_reached,
        milliseconds=answer.milliseconds,
    )


def _reason(answer: Answer, accepted: list[Match]) -> str:
    there, counts = answer.location, answer.counts
    if there is not None:
        return (
            f"{there.support} of {there.votes} matches agree on the pose, within "
            f"{there.spread_m:.2g} m and {there.spread_deg:.2g} deg"
        )
    if accepted:
        return (
            f"matches are accepted ({len(accepted)}), and the map knows no pose of them: `best` "
            "has the transform to the first"
        )
    unsure = [one for one in answer.matches if one.validation.status == "ambiguous"]
    if unsure:
        return (
            f"the nearest fit is not the only one: {unsure[0].validation.reason} (frame "
            f"{unsure[0].frame_id})"
        )
    if not counts.passed:
        return "no frame of the map can be compared" + (
            ": none passes the filter" if counts.map else ""
        )
    if answer.deadline_reached:
        return (
            f"the deadline came before a match was accepted: {counts.validated} of "
            f"{len(answer.matches)} candidates were tried"
        )
    first = next((one for one in answer.matches if one.validation.status == "rejected"), None)
    why = "" if first is None else f"; of the nearest, {first.validation.reason}"
    return f"none of {counts.validated} candidates is accepted{why}"
