"""Coverage of a map: each frame is localised with the help of the other frames.

    frames  --step-->  items  --coverage_plans-->  plans, counts

Each query excludes the frame itself and, depending on the request, frames of the same time or
session. Otherwise, it is the same as the query of a robot. The answer is not stored.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from sqlalchemy import Connection

from sceneprint.engine.context import Context
from sceneprint.engine.jobs.tasks import LongJob, SliceResult
from sceneprint.engine.maps.map_plans import QueriedPosition, coverage_plans, plan_changes
from sceneprint.engine.products.product import StepwiseProducts, spread_evenly
from sceneprint.engine.search.query import Queries, steadily
from sceneprint.engine.search.retrieval import Deadline, prepare_stored
from sceneprint.engine.search.up_vectors import parent_axes
from sceneprint.engine.serializers import model_label, vector
from sceneprint.errors import (
    DamagedBlob,
    DamagedSignature,
    InvalidRequest,
    UnknownFrame,
    UnreadableGeometry,
)
from sceneprint.geometry.rigid import pose_difference
from sceneprint.store.frame_queries import (
    PathFrame,
    QueryOrigin,
    numbers_of_runs,
    path_frames,
    positions_of_map,
)
from sceneprint.store.frames import count_states
from sceneprint.store.maps import current_map, living_frame, model_names
from sceneprint.store.queue import items_of
from sceneprint.store.tables import JobRow, MapRow
from sceneprint.types import Floats
from sceneprint_client.api import Answer, Filter, Page, Query, Transform
from sceneprint_client.api.coverage import (
    CELL_TRENDS,
    COVERAGE_OUTCOMES,
    CoverageChanges,
    CoverageFrame,
    CoverageOutcome,
    CoveragePlan,
    CoverageResult,
    MapCoverage,
    NewMapCoverage,
)


@dataclass(frozen=True, eq=False)
class _Measurement:
    """A succeeded coverage job, with its request and its result."""

    request: NewMapCoverage
    result: CoverageResult
    plans: list[CoveragePlan]


#: Maximum number of plans; the parent frames with the most queried frames get one.
MOST_PLANS = 20
#: A duration, in seconds, that exceeds any session.
_FOREVER_S = 1e12
#: Errors of a deleted, edited or damaged frame, which is skipped.
_SKIPPED = (UnknownFrame, InvalidRequest, DamagedBlob, DamagedSignature, UnreadableGeometry)


def frames_to_query(connection: Connection, row: MapRow, request: NewMapCoverage) -> list[int]:
    """Return the frame numbers that a coverage job queries, in query order.

    Raise InvalidRequest if no frame passes the filter.
    """
    numbers = numbers_of_runs(connection, row.number, request.session, request.robot)[
        :: request.every
    ]
    if not numbers:
        whose = "".join(
            f" of {what} {name!r:.80}"
            for what, name in (("session", request.session), ("robot", request.robot))
            if name is not None
        )
        raise InvalidRequest(
            f"Map {row.name!r} has no indexed frame{whose}. See GET /v1/maps/{row.name}/sessions.",
            (("session", "no indexed frame"),) if whose else (),
        )
    return spread_evenly(numbers, request.most)


class Coverages(StepwiseProducts[NewMapCoverage, MapCoverage]):
    """Coverages of maps."""

    kind = "coverage"
    record = MapCoverage
    item_count = "frames"

    def __init__(self, context: Context, queries: Queries) -> None:
        super().__init__(context)
        self._queries = queries

    def start(self, connection: Connection, row: MapRow, request: NewMapCoverage) -> dict[str, Any]:
        """Return the initial progress with the frames to query; see `frames_to_query`."""
        numbers = frames_to_query(connection, row, request)
        return {
            "done": 0, "total": len(numbers), "skipped": 0, "frames": numbers,
            "revision": row.revision,
        }  # fmt: skip

    def step(
        self, task: LongJob, request: NewMapCoverage, progress: dict[str, Any]
    ) -> list[dict[str, Any]]:
        """Query the next frame, and return its item; skip a deleted or damaged frame."""
        row, number = task.of_map, progress["frames"][progress["done"]]
        with self._store.database.read() as connection:
            stop = path_frames(connection, [number]).get(number)
        try:
            if stop is None:
                raise UnknownFrame(f"Frame number {number} was deleted.")
            answer = self._answer(row, stop, request)
        except _SKIPPED:
            progress["skipped"] += 1
            return []
        item = outcome_of(answer, stop, request)
        with self._store.database.read() as connection:
            look_alikes = [living_frame(connection, row.number, n) for n in item["look_alikes"]]
        item["look_alikes"] = [frame.number for frame in look_alikes if frame is not None]
        return [{"frame": number} | item]

    def _answer(self, row: MapRow, stop: PathFrame, request: NewMapCoverage) -> Answer:
        """Query a frame without the excluded frames, on one core; return the answer."""
        plain = Query(seed=request.seed, keep=False)
        origin = QueryOrigin(stop.robot, stop.session, stop.captured_at)
        left_out_s = request.not_within_s
        if request.other_sessions:  # exclude the whole session, even without times
            origin, left_out_s = replace(origin, captured_at=stop.captured_at or 0.0), _FOREVER_S
        query = plain
        if left_out_s > 0 and origin.session is not None and origin.captured_at is not None:
            query = plain.model_copy(update={"filter": Filter(not_within_s=left_out_s)})

        def ask(rows: list[MapRow]) -> Answer:
            self._context.signers(rows[0].model_id)  # this is slow, so do it before the transaction
            ready = prepare_stored(self._store, self._context.signers, row.name, stop.id, plain)
            if ready.frame is None or ready.frame[0] != stop.number:
                raise UnknownFrame(f"Frame {stop.id} was deleted and replaced by a new frame.")
            ready = replace(ready, origin=origin)
            return self._queries.answer(rows, ready, query, Deadline(None))

        return steadily(self._store, [row.name], ask)

    def finish(
        self, task: LongJob, request: NewMapCoverage, progress: dict[str, Any],
        items: list[dict[str, Any]],
    ) -> SliceResult:  # fmt: skip
        """Return the last slice, with counts, and with plans as items after those of the frames."""
        with self._store.database.read() as connection:
            row = current_map(connection, task.of_map)
            results = items_of(connection, task.job.number) + items
            plans, cell_m = plans_of(connection, row, results, request.cell_m)
            states = count_states(connection, row.number)
            label = model_label(model_names(connection)[row.model_id], row.model_id)
        counts = Counter(item["outcome"] for item in results)
        result = CoverageResult(
            **{name: counts[name] for name in COVERAGE_OUTCOMES},
            frames=len(results), skipped=progress["skipped"],
            model=label, revision=progress["revision"], last_revision=row.revision,
            map_frames=states.get("indexed", 0), cell_m=cell_m,
        )  # fmt: skip
        return SliceResult(
            True, progress, items + [plan.model_dump(mode="json") for plan in plans],
            result=result.model_dump(mode="json"), event="coverage.measured",
        )  # fmt: skip

    def details(self, connection: Connection, job: JobRow) -> dict[str, Any]:
        """Return the plans of a succeeded job."""
        return {"plans": None if job.result is None else _plans(connection, job)}

    def frames(
        self, map_name: str, job_id: str, cursor: str | None = None, limit: int = 100,
        outcome: CoverageOutcome | None = None,
    ) -> Page[CoverageFrame]:  # fmt: skip
        """Return a page of the queried frames that still exist; the job may be running.

        Parameters
        ----------
        outcome : outcome of the frames; None selects all frames
        """

        def records(connection: Connection, block: list[dict[str, Any]]) -> list[CoverageFrame]:
            named = {number for item in block for number in (item["frame"], *item["look_alikes"])}
            stops = path_frames(connection, named)
            return [
                _frame_record(item, stops)
                for item in block
                if item["frame"] in stops and outcome in (None, item["outcome"])
            ]

        items, more = self.page_of_items(map_name, job_id, cursor, limit, records)
        return Page[CoverageFrame](items=items, next_cursor=more)

    def changes(self, map_name: str, job_id: str, since: str) -> CoverageChanges:
        """Return the changes of cells between two results with the same map and options.

        Parameters
        ----------
        job_id, since : ids of the later and of the earlier job

        Raises
        ------
        UnknownMap, UnknownJob, NotIndexed : If the map or a job does not exist, or a job has not
            succeeded.
        InvalidRequest : If the results have different options, cells or axes.
        """
        with self._store.database.read() as connection:
            after = self._measurement(connection, map_name, job_id)
            before = self._measurement(connection, map_name, since)
        _require_comparable(before, after)
        plans = plan_changes(before.plans, after.plans)
        trends = Counter(cell.trend for plan in plans for cell in plan.cells)
        return CoverageChanges(
            before=since, after=job_id, cell_m=after.result.cell_m,
            trends={name: trends[name] for name in CELL_TRENDS}, result_before=before.result,
            result_after=after.result, plans=plans,
        )  # fmt: skip

    def _measurement(self, connection: Connection, map_name: str, job_id: str) -> _Measurement:
        job = self.find(connection, map_name, job_id)
        stored = self.require_success(job, "plans")
        request = NewMapCoverage.model_validate(job.data or {})
        result = CoverageResult.model_validate(stored)
        return _Measurement(request, result, _plans(connection, job))


def _require_comparable(before: _Measurement, after: _Measurement) -> None:
    """Raise InvalidRequest if two results have different options, cells or axes."""
    names = [
        name
        for name in NewMapCoverage.model_fields
        if name != "cell_m" and getattr(before.request, name) != getattr(after.request, name)
    ]
    if names:
        raise InvalidRequest(
            "The two results cannot be compared, since their requests differ in "
            f"{', '.join(names)}. Measure again with the same options.",
            (("since", "different options"),),
        )
    if before.result.cell_m != after.result.cell_m:
        raise InvalidRequest(
            f"The two results cannot be compared, since their cells are {before.result.cell_m:g} m "
            f"and {after.result.cell_m:g} m wide. Measure again with `cell_m` = "
            f"{before.result.cell_m:g}.",
            (("since", "different cell width"),),
        )
    axes = {plan.parent_frame: [*plan.x_axis, *plan.y_axis] for plan in before.plans}
    for plan in after.plans:
        own = [*plan.x_axis, *plan.y_axis]
        if not np.allclose(axes.get(plan.parent_frame, own), own, atol=1e-3):
            raise InvalidRequest(
                f"The two results cannot be compared, since the up vector of parent frame "
                f"{plan.parent_frame!r:.80} has changed. Set `up` of the map, and measure both "
                "again.",
                (("since", "different vertical"),),
            )


def _plans(connection: Connection, job: JobRow) -> list[CoveragePlan]:
    """Return the plans of a succeeded job, which are stored as items after those of the frames."""
    items = items_of(connection, job.number, (job.result or {})["frames"])
    return [CoveragePlan.model_validate(item) for item in items]


def _frame_record(item: dict[str, Any], stops: dict[int, PathFrame]) -> CoverageFrame:
    stop = stops[item["frame"]]
    pose = stop.pose
    same = ("number", "outcome", "reason", "cause", "error_m", "error_deg")
    return CoverageFrame(
        frame_id=stop.id, robot=stop.robot, session=stop.session,
        parent_frame=None if pose is None else stop.parent,
        position=None if pose is None else vector(row[3] for row in pose[:3]),
        look_alikes=[stops[number].id for number in item["look_alikes"] if number in stops],
        **{name: item[name] for name in same},
    )  # fmt: skip


def outcome_of(answer: Answer, stop: PathFrame, request: NewMapCoverage) -> dict[str, Any]:
    """Return the outcome, pose errors and ids of look-alikes of a queried frame as a JSON item.

    Parameters
    ----------
    answer : answer to the query
    stop : queried frame
    request : options, including the tolerances of a correct pose
    """
    own = None if stop.pose is None else np.array(stop.pose)
    location = None if answer.location is None else answer.location.pose
    off = _difference(location, own, stop.parent)
    outcome: CoverageOutcome = "not_found"
    if answer.status == "found":
        outcome = "unchecked" if off is None else "found" if _is_within(off, request) else "wrong"
    elif answer.status == "ambiguous":
        outcome = "ambiguous"
    poses = [alternative.pose for alternative in answer.alternatives]
    if outcome == "wrong" and location is not None:
        poses = [location]
    elsewhere = [
        pose
        for pose in poses
        if (apart := _difference(pose, own, stop.parent)) is None or not _is_within(apart, request)
    ]
    return {
        "outcome": outcome, "reason": answer.reason, "cause": answer.cause,
        "error_m": None if off is None else off[0],
        "error_deg": None if off is None else math.degrees(off[1]),
        "look_alikes": _look_alikes(answer, elsewhere),
    }  # fmt: skip


def _difference(
    pose: Transform | None, own: Floats | None, parent: str | None
) -> tuple[float, float] | None:
    """Return metres and radians between two poses; None if one is unknown or in another frame."""
    if pose is None or own is None or pose.parent_frame != parent:
        return None
    return pose_difference(np.array(pose.matrix), own)


def _is_within(off: tuple[float, float], request: NewMapCoverage) -> bool:
    return off[0] <= request.tolerance_m and math.degrees(off[1]) <= request.tolerance_deg


#: Maximum distance, metres, between an answer's pose and the pose that a match implies.
_SAME_POSE_M = 1.0


def _look_alikes(answer: Answer, poses: Sequence[Transform]) -> list[str]:
    """Return the id of the match nearest to each pose, without duplicates."""
    frame_ids: list[str] = []
    for pose in poses:
        near = [
            (off[0], match.frame_id)
            for match in answer.matches
            if match.pose_in_map is not None
            and (off := _difference(pose, np.array(match.pose_in_map.matrix),
                                    match.pose_in_map.parent_frame)) is not None
            and off[0] <= _SAME_POSE_M
        ]  # fmt: skip
        if near:
            frame_ids.append(min(near)[1])
    return list(dict.fromkeys(frame_ids))


def plans_of(
    connection: Connection, row: MapRow, items: Sequence[dict[str, Any]], cell_m: float | None
) -> tuple[list[CoveragePlan], float]:
    """Return the plans of the queried frames that have poses, and the cell width in metres."""
    outcomes = {item["frame"]: item["outcome"] for item in items}
    by_parent: dict[str, list[PathFrame]] = {}
    for stop in path_frames(connection, outcomes).values():
        if stop.pose is not None and stop.parent is not None:
            by_parent.setdefault(stop.parent, []).append(stop)
    names = sorted(by_parent, key=lambda name: (-len(by_parent[name]), name))[:MOST_PLANS]
    queried = {
        name: [
            QueriedPosition(np.array(stop.pose)[:3, 3], outcomes[stop.number])
            for stop in by_parent[name]
        ]
        for name in names
    }
    axes = {
        name: parent_axes(connection, row, [stop.number for stop in by_parent[name]])
        for name in names
    }
    return coverage_plans(queried, positions_of_map(connection, row.number), axes, cell_m)
