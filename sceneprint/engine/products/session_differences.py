"""Differences between two sessions of a map: surfaces that disappeared, and new surfaces.

    frames of both sessions  --view_cells, merge_views-->  cells  --frame_verdicts-->  counts
    counts  --cell_states-->  same, gone, new, unseen

Each slice of a job fuses frames into cells, or compares frames with the cells of the other session.
A file of the job stores the state between slices.
"""

from __future__ import annotations

import io
from typing import Any, Literal

import numpy as np
from sqlalchemy import Connection

from sceneprint.engine.jobs.tasks import IsOver, LongJob, SliceResult, ends_within
from sceneprint.engine.maps.surface_job import cell_width, surface_points
from sceneprint.engine.products.product import SLICE_S, Products, spread_evenly
from sceneprint.engine.search.up_vectors import parent_axes
from sceneprint.errors import DamagedBlob, InvalidRequest, UnreadableGeometry
from sceneprint.formats.artifact import read_geometry
from sceneprint.formats.export import MEDIA_TYPE, encode_points
from sceneprint.geometry.cells import (
    CELL_SUM,
    CHANGED,
    SAME,
    UNSEEN,
    SessionCells,
    VerdictCounts,
    ViewStamp,
    cell_positions,
    cell_states,
    count_cells,
    empty_counts,
    frame_verdicts,
    merge_views,
    view_cells,
)
from sceneprint.geometry.registration.overlap import OverlapParameters
from sceneprint.geometry.rigid import transform_points
from sceneprint.store import queue
from sceneprint.store.frame_queries import (
    any_purged,
    parents_of_session,
    path_frames,
    posed_in_session,
)
from sceneprint.store.maps import current_map, geometry_blobs
from sceneprint.store.tables import JobRow, MapRow
from sceneprint.types import Floats, Geometry
from sceneprint_client.api import sessions as api
from sceneprint_client.api.sessions import Difference, DifferenceResult, NewDifference
from sceneprint_client.surface_encoding import NO_SESSION

#: Maximum number of cells of a session; with more, the job starts over with cells twice as wide.
MOST_CELLS = 500_000
#: Maximum number of unmerged cells in memory.
_MOST_UNMERGED = 1_000_000
#: Names of the files of a job: the state of a running job, and the points of the result.
STATE, POINTS = "state.npz", "points"

Side = Literal["before", "after"]
SIDES: tuple[Side, Side] = ("before", "after")


def shared_parent(connection: Connection, row: MapRow, request: NewDifference) -> str:
    """Return the parent frame in which to compare two sessions: the requested or most common one.

    Raise InvalidRequest if a session has no poses, or the sessions share no parent frame.
    """
    counts = {}
    for side in SIDES:
        name: str = getattr(request, side)
        counts[side] = parents_of_session(connection, row.number, name)
        if not counts[side]:
            raise InvalidRequest(
                f"Session {name!r:.80} of map {row.name!r} has no indexed frame with a pose. "
                f"See GET /v1/maps/{row.name}/sessions.",
                ((side, "no indexed frame with a pose"),),
            )
    before, after = (counts[side] for side in SIDES)
    shared = sorted(before.keys() & after.keys(), key=lambda p: (-min(before[p], after[p]), p))
    if request.parent_frame is not None and request.parent_frame not in shared:
        raise InvalidRequest(
            f"Sessions {request.before!r:.80} and {request.after!r:.80} do not both have poses in "
            f"parent frame {request.parent_frame!r:.80}. "
            + (f"Choose from {', '.join(shared)!r:.300}." if shared else "They share no frame."),
            (("parent_frame", "not of both sessions"),),
        )
    if not shared:
        raise InvalidRequest(
            f"Session {request.before!r:.80} has poses in {', '.join(before)!r:.200}, but session "
            f"{request.after!r:.80} in {', '.join(after)!r:.200}, so they share no parent frame. "
            "Associate the sessions: a strong join moves their poses to one parent frame.",
            (("after", "no parent frame in common"),),
        )
    return request.parent_frame or shared[0]


class Differences(Products[NewDifference, Difference]):
    """Differences between sessions."""

    kind = "difference"
    record = Difference

    def start(self, connection: Connection, row: MapRow, request: NewDifference) -> dict[str, Any]:
        """Return the initial progress with the frames to compare, and their parent frame."""
        parent = shared_parent(connection, row, request)
        frames = {
            side: spread_evenly(
                posed_in_session(connection, row.number, getattr(request, side), parent),
                api.MOST_COMPARED,
            )
            for side in SIDES
        }
        return {
            "done": 0, "total": 2 * sum(map(len, frames.values())), "skipped": 0,
            "frames": frames, "parent": parent,
        }  # fmt: skip

    def shows_deleted(self, connection: Connection, job: JobRow) -> bool:
        """Return whether a frame of a job was deleted permanently."""
        frames: dict[Side, list[int]] = (job.progress or {}).get("frames", {})
        return any_purged(connection, [number for own in frames.values() for number in own])

    def run_slice(self, task: LongJob, is_over: IsOver) -> SliceResult:
        """Fuse or compare at least one frame, or conclude the job; return the slice's results."""
        is_over = ends_within(is_over, SLICE_S)
        request = NewDifference.model_validate(task.data)
        progress = dict(task.progress) or self.restart(task.of_map, request)
        with self._store.database.read() as connection:
            row = current_map(connection, task.of_map)
            file = queue.files_of(connection, task.job.number).get(STATE)
        # this is slow, so do it before a transaction
        parameters = self._context.signers(row.model_id).model.parameters
        progress.setdefault("cell_m", cell_width(parameters.cloud.voxel_size))
        state = _State() if file is None else _State.read(self._store.blobs.get(file.blob))
        if progress["done"] < progress["total"] // 2:
            self._fuse(row, progress, state, is_over)
            if max(map(count_cells, state.cells.values())) > MOST_CELLS:
                progress |= {"done": 0, "skipped": 0, "cell_m": 2 * progress["cell_m"]}
                return SliceResult(False, progress, drop=(STATE,))
        else:
            self._judge(row, progress, state, is_over, parameters.validation.agreement)
        if progress["done"] < progress["total"]:
            return SliceResult(False, progress, files=[self._file(STATE, state.data())])
        return self._conclude(row, progress, state)

    def _fuse(self, row: MapRow, progress: dict[str, Any], state: _State, is_over: IsOver) -> None:
        """Fuse frames into the cells of their sessions, while time allows."""
        views: dict[Side, list[SessionCells]] = {side: [] for side in SIDES}
        cell_count = 0
        for side, number in _order(progress["frames"])[progress["done"] :]:
            posed = self._posed(row, number, progress["parent"])
            if posed is None:
                progress["skipped"] += 1
            else:
                points = transform_points(posed[1], surface_points(posed[0]))
                stamp = ViewStamp(number, None, NO_SESSION)
                views[side].append(view_cells(points, progress["cell_m"], stamp))
                cell_count += count_cells(views[side][-1])
            progress["done"] += 1
            if is_over() or cell_count > _MOST_UNMERGED:
                break
        for side in SIDES:
            state.cells[side] = merge_views(state.cells[side], views[side])
            state.counts[side] = empty_counts(count_cells(state.cells[side]))

    def _judge(
        self, row: MapRow, progress: dict[str, Any], state: _State, is_over: IsOver,
        p: OverlapParameters,
    ) -> None:  # fmt: skip
        """Compare frames with the cells of the other session, while time allows."""
        order = _order(progress["frames"])
        positions = {side: cell_positions(state.cells[side], progress["cell_m"]) for side in SIDES}
        for side, number in order[progress["done"] - len(order) :]:
            posed = self._posed(row, number, progress["parent"])
            if posed is not None:
                other: Side = "after" if side == "before" else "before"
                verdicts = frame_verdicts(positions[other], posed[0].surface, posed[1], p)
                state.counts[other].add(verdicts)
            progress["done"] += 1
            if is_over():
                break

    def _posed(self, row: MapRow, number: int, parent: str) -> tuple[Geometry, Floats] | None:
        """Return the geometry and T_parent_sensor of a frame; None if either is not available."""
        with self._store.database.read() as connection:
            stop = path_frames(connection, [number]).get(number)
            blob = geometry_blobs(connection, [number], row.model_id).get(number)
        if stop is None or stop.pose is None or stop.parent != parent or blob is None:
            return None
        try:
            return read_geometry(self._store.blobs.get(blob)), np.array(stop.pose)
        except (DamagedBlob, UnreadableGeometry):
            return None

    def _file(self, name: str, data: bytes) -> queue.JobFile:
        return queue.JobFile(name, self._store.blobs.put(data), len(data), MEDIA_TYPE)

    def _conclude(self, row: MapRow, progress: dict[str, Any], state: _State) -> SliceResult:
        """Return the last slice, with the counts and the points of all cells by state."""
        frames = progress["frames"]
        positions, states = {}, {}
        for side, other in zip(SIDES, reversed(SIDES), strict=True):
            positions[side] = cell_positions(state.cells[side], progress["cell_m"])
            states[side] = cell_states(state.counts[side], len(frames[other]))
        kinds: tuple[tuple[Side, int], ...] = (
            ("after", SAME), ("before", CHANGED), ("after", CHANGED),
            ("before", UNSEEN), ("after", UNSEEN),
        )  # fmt: skip
        groups = [positions[side][states[side] == own] for side, own in kinds]
        points = np.concatenate(groups)
        counts = [len(group) for group in groups]
        with self._store.database.read() as connection:
            axes = parent_axes(connection, row, frames["before"] + frames["after"]).axes
        result = DifferenceResult(
            same=counts[api.SAME], gone=counts[api.GONE], new=counts[api.NEW],
            unseen_after=counts[api.UNSEEN_AFTER], unseen_before=counts[api.UNSEEN_BEFORE],
            cell_m=progress["cell_m"], parent_frame=progress["parent"],
            up=np.cross(axes[0], axes[1]).tolist(), frames_before=len(frames["before"]),
            frames_after=len(frames["after"]), skipped=progress["skipped"],
        )  # fmt: skip
        labels = np.repeat(np.arange(len(counts), dtype=np.int32), counts)
        file = self._file(POINTS, encode_points(points, patches=labels))
        return SliceResult(
            True, progress, files=[file], drop=(STATE,), result=result.model_dump(mode="json"),
            event="difference.found",
        )  # fmt: skip


class _State:
    """Cells of both sessions, with counts of the verdicts on them."""

    def __init__(self) -> None:
        self.cells: dict[Side, SessionCells] = {side: {} for side in SIDES}
        self.counts: dict[Side, VerdictCounts] = {side: empty_counts(0) for side in SIDES}

    @classmethod
    def read(cls, data: bytes) -> _State:
        """Read a state from the bytes that `data` returns."""
        state = cls()
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            for side in SIDES:
                places, rows = arrays[f"{side}_places"], arrays[f"{side}_rows"].view(CELL_SUM)
                ends = np.cumsum(arrays[f"{side}_sizes"])
                state.cells[side] = {
                    (x, y, z): rows[end - size : end]
                    for (x, y, z), size, end in zip(
                        places.tolist(), arrays[f"{side}_sizes"].tolist(), ends.tolist(),
                        strict=True,
                    )
                }  # fmt: skip
                agreeing, through = arrays[f"{side}_said"]
                state.counts[side] = VerdictCounts(agreeing, through)
        return state

    def data(self) -> bytes:
        """Return the state as a file; equal states have equal bytes."""
        arrays: dict[str, Any] = {}
        for side in SIDES:
            cells, counts = self.cells[side], self.counts[side]
            rows = np.concatenate([np.zeros(0, CELL_SUM), *cells.values()])
            arrays[f"{side}_places"] = np.array(list(cells), np.int64).reshape(-1, 3)
            arrays[f"{side}_sizes"] = np.array([len(own) for own in cells.values()], np.int64)
            arrays[f"{side}_rows"] = np.frombuffer(rows.tobytes(), np.uint8)
            arrays[f"{side}_said"] = np.stack([counts.agreeing, counts.through])
        file = io.BytesIO()
        np.savez(file, **arrays)
        return file.getvalue()


def _order(frames: dict[Side, list[int]]) -> list[tuple[Side, int]]:
    """Return the side and the number of each frame, in the order of processing."""
    return [(side, number) for side in SIDES for number in frames[side]]
