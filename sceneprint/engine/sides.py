"""Which frames an association goes through, and which each of them may be found to be near."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sceneprint.errors import InvalidRequest
from sceneprint.index.keys import Keys
from sceneprint.schemas.associations import APART, NewAssociation
from sceneprint.store import Store
from sceneprint.store.associations import Stop, numbers_of_session, stops_of
from sceneprint.store.filters import Taken, passing
from sceneprint.store.records import MapRow

#: Most frames of both sessions together: more are hours, and edges past what a page holds.
MOST_FRAMES = 5000


@dataclass(frozen=True, eq=False)
class Plan:
    """What a job goes through, fixed when it begins.

    Parameters
    ----------
    source, target : numbers of the frames, in the order of time; the same for loop closures
    taken : when each of `source` was taken, seconds since 1970; None where that is not known
    """

    source: list[int]
    target: list[int]
    taken: list[float | None]


def sessions_of(asked: NewAssociation) -> list[tuple[str, str | None]]:
    """Session and robot of both sides; one for loop closures."""
    robots: list[str | None] = [*(asked.robots or [])] or [None] * len(asked.sessions)
    return list(zip(asked.sessions, robots, strict=True))


def runs_of(store: Store, row: MapRow, asked: NewAssociation) -> list[list[Stop]]:
    """Frames of each of the sessions that pass the filter, in the order of time.

    Raises
    ------
    InvalidRequest : a session has no indexed frame, or frames of several robots; or there are too
        many frames.
    """
    sides, found = sessions_of(asked), []
    with store.database.read() as connection:
        numbers = [numbers_of_session(connection, row.number, *side) for side in sides]
        if asked.filter is not None:
            passed = passing(connection, row.number, asked.filter, Taken(None, None, None))
            kept = set(passed.tolist())
            numbers = [[number for number in own if number in kept] for own in numbers]
        if sum(map(len, numbers)) > MOST_FRAMES:
            raise InvalidRequest(
                f"The sessions have {sum(map(len, numbers))} frames, and an association takes at "
                f"most {MOST_FRAMES}. Narrow them with `filter`, such as by captured_after and "
                "captured_before.",
                (("sessions", "too many frames"),),
            )
        for own in numbers:
            stops = stops_of(connection, own)
            found.append([stops[number] for number in own if number in stops])
    for stops_found, (session, robot) in zip(found, sides, strict=True):
        robots = sorted({stop.robot or "" for stop in stops_found})
        if not robots:
            whose = "" if robot is None else f" of robot {robot!r:.80}"
            raise InvalidRequest(
                f"Session {session!r:.80}{whose} has no indexed frame that passes in map "
                f"{row.name!r}. See GET /v1/maps/{row.name}/sessions.",
                (("sessions", "no indexed frame"),),
            )
        if len(robots) > 1:
            raise InvalidRequest(
                f"Session {session!r:.80} is of several robots: {', '.join(robots)!r:.200}. "
                "Name one in `robots`.",
                (("robots", "needed"),),
            )
    return found


def eligible(asked: NewAssociation, plan: Plan, place: int) -> Keys:
    """Frames that one may be found to be near, rising: of the other session, or before it."""
    if len(asked.sessions) == 2:
        return np.sort(np.array(plan.target, np.int64))
    apart = asked.apart or (1 if asked.not_within_s is not None else APART)
    before = np.array(plan.target[: max(place - apart + 1, 0)], np.int64)
    if asked.not_within_s is not None:
        taken = np.array(plan.taken, float)  # NaN where not known, which is before nothing
        before = before[taken[: len(before)] < taken[place] - asked.not_within_s]
    return np.sort(before)
