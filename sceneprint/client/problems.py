"""Answers that are no success, back to the errors of our tree.

response  --refusal-->  SceneprintError
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from sceneprint import errors
from sceneprint.schemas import Problem

if TYPE_CHECKING:
    import httpx

#: What is no kind of problem of a service, but a way of hearing of one.
_OURS = (errors.ServiceError,)


def refusal(response: httpx.Response) -> errors.SceneprintError:
    """The error that an answer tells of: of the class its `type` names, or else Refused."""
    try:
        problem = Problem.model_validate_json(response.content)
    except ValidationError:
        return errors.Refused(
            f"{response.request.url} answered {response.status_code} {response.reason_phrase} "
            "without saying why, so it is hardly sceneprint. Check the address.",
            response.status_code,
            {},
        )
    kind = _kinds().get(problem.type.rstrip("/").rpartition("/")[2])
    if kind is None:
        return errors.Refused(problem.detail, response.status_code, problem.model_dump())
    if issubclass(kind, errors.InvalidRequest):
        return kind(problem.detail, _fields(problem))
    return kind(problem.detail)


def not_ours(response: httpx.Response) -> errors.Refused:
    """The error of a success whose body is not what was asked for."""
    return errors.Refused(
        f"{response.request.url} answered with something else than this version of sceneprint "
        "understands. Check the address, and the service's version with `sceneprint doctor`.",
        response.status_code,
        {},
    )


def _kinds() -> dict[str, type[errors.SceneprintError]]:
    """The classes of the tree by the last part of a problem's `type`."""
    return {
        errors.kebab_case(name): kind
        for name, kind in vars(errors).items()
        if isinstance(kind, type)
        and issubclass(kind, errors.SceneprintError)
        and not issubclass(kind, _OURS)
    }


def _fields(problem: Problem) -> tuple[tuple[str, str], ...]:
    """(place, reason) of each field at fault, as far as they are told."""
    told: Any = (problem.model_extra or {}).get("errors")
    if not isinstance(told, list):
        return ()
    return tuple(
        (str(one["field"]), str(one["reason"]))
        for one in told
        if isinstance(one, dict) and {"field", "reason"} <= one.keys()
    )
