"""Import of a map from one cloud or mesh: rendered views of it become frames.

    file  --read-->  surface  --choose-->  viewpoints  --render-->  frames  --sign, test-->  result

Each phase is one or more slices of the job. The file of the job is first the upload, then the
decoded surface, then the surface with viewpoints. It counts against the quota until the job ends.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from dataclasses import dataclass, replace
from functools import partial
from pathlib import PurePath
from typing import Any, BinaryIO

import numpy as np
from numpy.lib import format as npy

from sceneprint.decoders.pool import inheritable
from sceneprint.decoders.surface_decoder import read_surface_confined
from sceneprint.engine.context import Context
from sceneprint.engine.ingest.archive_import import (
    import_item,
    states_of_import,
    view_parameters_of,
)
from sceneprint.engine.ingest.uploads import Upload, Uploads
from sceneprint.engine.jobs.tasks import IsOver, LongJob, SliceResult
from sceneprint.engine.maps.map_plans import QueriedPosition, coverage_plans
from sceneprint.engine.products.map_coverage import outcome_of
from sceneprint.engine.search.query import Queries, steadily
from sceneprint.engine.search.retrieval import Deadline, prepare_upload
from sceneprint.engine.search.up_vectors import PlanAxes, plan_axes
from sceneprint.engine.serializers import copy_fields, direction, vector
from sceneprint.errors import (
    DecoderFailure,
    FrameError,
    InvalidRequest,
    QuotaExceeded,
    UnreadableCloud,
)
from sceneprint.formats.depth_file import encode_npy, encode_png
from sceneprint.formats.surface_file.reading import SurfaceOptions
from sceneprint.geometry.views import Renderer, ViewParameters, choose_views
from sceneprint.store import queue
from sceneprint.store.database_errors import unusable
from sceneprint.store.frame_queries import PathFrame, has_parent_frame
from sceneprint.store.maps import current_map, living_frame, map_usage
from sceneprint.store.tables import ARCHIVE, MapRow
from sceneprint.types import Floats, Intrinsics, ReferenceSurface
from sceneprint_client.api import Answer, Filter, FrameMeta, FrameState, Query
from sceneprint_client.api.base import (
    CameraIntrinsics,
    GivenDirection,
    GivenPose,
    GivenVector,
)
from sceneprint_client.api.coverage import COVERAGE_OUTCOMES, NewMapCoverage
from sceneprint_client.api.frames import VIRTUAL, ImportOptions, MapImportResult, WeakArea

#: Number of views to render and add in one commit.
_AT_ONCE = 16
#: Seconds between checks for unsigned views.
_PAUSE_S = 1.0
#: Maximum number of depth units per metre in rendered images, and maximum depth in these units.
_DEPTH_SCALE, _FARTHEST = 1000.0, 65_000
#: Maximum number of weak areas in an import result.
_MOST_WEAK = 20


@dataclass(frozen=True, eq=False)
class StoredSurface:
    """The file of a job: a surface and its viewpoints.

    Parameters
    ----------
    poses, held_out : (V, 4, 4) and (H, 4, 4) T_map_sensor of the views to add, and of the views
        to test localisation with; empty before the phase `choose`
    floor : height of the floor along `up`, metres
    """

    surface: ReferenceSurface
    poses: Floats
    held_out: Floats
    floor: float = 0.0

    def write(self, file: Any) -> None:
        """Write the surface to a file as consecutive NPY arrays."""
        s = self.surface
        triangles = np.empty((0, 3), np.int32) if s.triangles is None else s.triangles
        floor = np.array([self.floor])
        for array in (s.points, triangles, s.offset, s.up, self.poses, self.held_out, floor):
            npy.write_array(file, np.ascontiguousarray(array), allow_pickle=False)

    @classmethod
    def read(cls, file: BinaryIO) -> StoredSurface:
        """Read a surface from a file that `write` wrote."""
        arrays = [npy.read_array(file, allow_pickle=False) for _ in range(7)]
        points, triangles, offset, up, poses, held_out, floor = arrays
        surface = ReferenceSurface(points, triangles if len(triangles) else None, offset, up)
        return cls(surface, poses, held_out, float(floor[0]))


_NO_POSES: Floats = np.empty((0, 4, 4))


class _Views:
    """Renderer of the views that a job adds to a map.

    Parameters
    ----------
    stored : surface and viewpoints
    """

    def __init__(
        self, stored: StoredSurface, parameters: ViewParameters, options: ImportOptions
    ) -> None:
        self._stored, self._p, self._options = stored, parameters, options
        self._renderer = Renderer(stored.surface, parameters)

    def upload(self, number: int) -> Upload:
        """Render a view, and return its upload.

        The frame id is a hash of the image, the pose and the names: a repeated view is a duplicate,
        but equal views of two places are two frames.

        Parameters
        ----------
        number : index into the poses
        """
        pose, options = self._stored.poses[number], self._options
        view = self.view(pose)
        session, parent = names_of(options)
        R_sensor_map = pose[:3, :3].T
        up = R_sensor_map @ self._stored.surface.up
        meta = view.meta.model_copy(
            update={
                "robot": options.robot, "session": session, "tags": [*options.tags, VIRTUAL],
                "name": f"{options.name}/{number:05d}", "sequence": number,
                "pose": GivenPose(matrix=pose.tolist(), parent_frame=parent),
                "up": GivenDirection(x=up[0], y=up[1], z=up[2]),
            }
        )  # fmt: skip
        place = f"{options.robot}\n{session}\n{parent}\n".encode() + pose.tobytes()
        frame_id = hashlib.sha256(place + view.data).hexdigest()[:32]
        return Upload(view.data, meta, options.priority, options.if_novel, frame_id)

    def view(self, pose: Floats) -> Upload:
        """Return a view rendered at T_map_sensor (4, 4), without the pose in its metadata."""
        image, camera = self._renderer.view(pose), self._p.camera
        if not isinstance(camera, Intrinsics):
            return Upload(encode_npy(image), FrameMeta())
        scale = min(_DEPTH_SCALE, _FARTHEST / self._p.farthest)
        samples = np.round(image * scale).astype(np.uint16)
        intrinsics = copy_fields(CameraIntrinsics, camera)
        return Upload(encode_png(samples), FrameMeta(intrinsics=intrinsics, depth_scale=scale))


def names_of(options: ImportOptions) -> tuple[str, str]:
    """Return the names of the session and of the parent frame for the views of an import."""
    stem = PurePath(options.name).stem
    own = stem if options.robot is None else f"{options.robot}/{stem}"
    return options.session or stem, options.parent_frame or own


class MapImporter:
    """Handler of jobs that import maps from single files.

    Parameters
    ----------
    queries : search that localises held-out views as a test
    """

    def __init__(self, context: Context, uploads: Uploads, queries: Queries) -> None:
        # limit of processor time, which leaves a quarter of the timeout for writing
        self._seconds = 0.75 * context.settings.job_timeout_s
        self._store, self._signers = context.store, context.signers
        self._uploads, self._queries = uploads, queries
        self._phases = {
            "read": self._read, "choose": self._choose, "render": self._render,
            "sign": self._await_signatures, "test": self._test,
        }  # fmt: skip

    def __call__(self, task: LongJob, is_over: IsOver) -> SliceResult:
        """Run a slice, which is a phase of the import or part of one; return its results."""
        options = ImportOptions.model_validate(task.data)
        with self._store.database.read() as connection:
            file = queue.files_of(connection, task.job.number).get(ARCHIVE)
        if file is None:
            raise InvalidRequest(
                "The file of the map was removed when its import failed or was cancelled. Send it "
                "again."
            )
        phase = self._phases[task.progress.get("phase", "read")]
        return phase(task, options, file, is_over)

    def _read(
        self, task: LongJob, options: ImportOptions, file: queue.JobFile, is_over: IsOver
    ) -> SliceResult:
        """Decode the file in a confined process; return a slice that stores its surface."""
        del is_over, task
        axis = options.up if isinstance(options.up, str) else None
        surface_options = SurfaceOptions(units_per_metre=options.units_per_metre, up=axis)
        with self._open_file(file) as source, inheritable(source) as descriptor:
            try:
                read = read_surface_confined(
                    descriptor, options.name, surface_options, seconds=self._seconds
                )
            except DecoderFailure as error:
                raise UnreadableCloud(
                    f"{options.name} cannot be read: {error}. Downsample the points or simplify "
                    "the mesh, or write the file in another format."
                ) from error
        surface = read.surface
        if options.offset is not None:
            surface = _with_offset(surface, options.offset, options.name)
        progress = {
            "done": 0, "total": None, "phase": "choose", "points": len(surface.points),
            "triangles": 0 if surface.triangles is None else len(surface.triangles),
            "units_per_metre": read.units_per_metre, "units_from": read.units,
            "up_from": read.up_from, "notes": list(read.notes),
        }  # fmt: skip
        stored = self._store_surface(StoredSurface(surface, _NO_POSES, _NO_POSES))
        return SliceResult(False, progress, files=[stored])

    def _choose(
        self, task: LongJob, options: ImportOptions, file: queue.JobFile, is_over: IsOver
    ) -> SliceResult:
        """Choose the viewpoints, and return a slice that stores them with the surface."""
        del is_over
        stored = self._stored(file)
        plan = choose_views(stored.surface, self._parameters(task.of_map, options))
        n, tests = len(plan.poses), len(plan.held_out)
        if not n:
            raise InvalidRequest(
                "At every viewpoint in the map, a sensor would see too little surface. Check the "
                "units and the up axis, or pass the height of the sensor."
            )
        self._require_room(task.of_map, n)
        floor = 0.0 if plan.floor is None else plan.floor
        chosen = replace(stored, poses=plan.poses, held_out=plan.held_out, floor=floor)
        progress = task.progress | {
            "phase": "render", "total": 2 * n + tests, "views": n, "rendered": 0, "refused": 0,
            "signed": 0, "tested": 0, "outcomes": [], "seen": plan.covered,
        }  # fmt: skip
        return SliceResult(False, progress, files=[self._store_surface(chosen)])

    def _render(
        self, task: LongJob, options: ImportOptions, file: queue.JobFile, is_over: IsOver
    ) -> SliceResult:
        """Render and add at least one block of views; return the results of the slice."""
        stored = self._stored(file)
        views = self._views(task, options, stored)
        progress, items = dict(task.progress), list[dict[str, Any]]()
        if not progress["rendered"] and options.offset is None and stored.surface.offset.any():
            self._require_one_offset(task, options, stored.surface.offset, views)
        fence = partial(queue.check_held, held=task.job)
        while progress["rendered"] < progress["views"] and (not items or not is_over()):
            first = progress["rendered"]
            block = [
                views.upload(i) for i in range(first, min(first + _AT_ONCE, progress["views"]))
            ]
            outcomes, _ = self._uploads.add_all(task.of_map.name, block, fence=fence)
            for upload, outcome in zip(block, outcomes, strict=True):
                if isinstance(outcome.error, QuotaExceeded):
                    raise QuotaExceeded(
                        f"{outcome.error} {first} of {progress['views']} views were added. Send "
                        "the same file again to add the remaining views."
                    )
                item = import_item(str(upload.meta.name), outcome)
                progress["refused"] += outcome.added is None
                items.append(item.model_dump(mode="json"))
            progress["rendered"] += len(block)
        if progress["rendered"] == progress["views"]:
            progress["phase"] = "sign"
        return SliceResult(False, _counted(progress), items)

    def _await_signatures(
        self, task: LongJob, options: ImportOptions, file: queue.JobFile, is_over: IsOver
    ) -> SliceResult:
        """Return the progress of signing; schedule another slice unless all views are signed."""
        del options, file, is_over
        progress = dict(task.progress)
        states = self._states(task)
        waiting = states[FrameState.RECEIVED] + states[FrameState.SIGNING]
        progress["signed"] = progress["views"] - waiting
        if waiting:
            return SliceResult(False, _counted(progress), after_s=_PAUSE_S)
        progress["phase"] = "test"
        return SliceResult(False, _counted(progress))

    def _test(
        self, task: LongJob, options: ImportOptions, file: queue.JobFile, is_over: IsOver
    ) -> SliceResult:
        """Localise one or more held-out views; return the slice, which may conclude the job."""
        stored = self._stored(file)
        poses, progress = stored.held_out, dict(task.progress)
        outcomes = progress["outcomes"] = list(progress["outcomes"])
        views = self._views(task, options, stored)
        while len(outcomes) < len(poses):
            outcomes.append(self._outcome(task.of_map, views, poses[len(outcomes)], options))
            progress["tested"] = len(outcomes)
            if len(outcomes) < len(poses) and is_over():
                return SliceResult(False, _counted(progress))
        result = self._result(task, options, stored, progress)
        return SliceResult(
            True, _counted(progress), drop=[ARCHIVE], result=result.model_dump(mode="json"),
            event="import.done",
        )  # fmt: skip

    def _parameters(self, row: MapRow, options: ImportOptions) -> ViewParameters:
        with self._store.database.read() as connection:
            row = current_map(connection, row)
        return view_parameters_of(self._signers(row.model_id).model.parameters, options)

    def _views(self, task: LongJob, options: ImportOptions, stored: StoredSurface) -> _Views:
        return _Views(stored, self._parameters(task.of_map, options), options)

    def _open_file(self, file: queue.JobFile) -> BinaryIO:
        try:
            return self._store.blobs.open(file.blob)
        except FileNotFoundError as error:
            raise InvalidRequest("The file of the map is missing. Send it again.") from error
        except OSError as error:
            raise unusable("The file of the map cannot be read", error) from error

    def _stored(self, file: queue.JobFile) -> StoredSurface:
        with self._open_file(file) as source:
            return StoredSurface.read(source)

    def _store_surface(self, stored: StoredSurface) -> queue.JobFile:
        with self._store.blobs.incoming() as blob:
            stored.write(blob)
            return queue.JobFile(ARCHIVE, blob.keep(), blob.size, "application/octet-stream")

    def _require_one_offset(
        self, task: LongJob, options: ImportOptions, offset: Floats, views: _Views
    ) -> None:
        """Raise InvalidRequest if the parent frame has frames that used another offset."""
        _, parent = names_of(options)
        number, first = task.of_map.number, str(views.upload(0).frame_id)
        with self._store.database.read() as connection:
            in_use = has_parent_frame(connection, number, parent)
            if not in_use or living_frame(connection, number, first) is not None:
                return  # the first file of the parent frame, or a repeated import
        x, y, z = offset.tolist()
        raise InvalidRequest(
            f"The parent frame {parent!r} already has frames, but {options.name} lies far from the "
            f"origin of that frame and would get the offset {x:.0f},{y:.0f},{z:.0f}. Send the "
            "`offset` (--offset) of the first file in this parent frame, or another "
            "`parent_frame`.",
            (("offset", "required, since the parent frame has frames"),),
        )

    def _require_room(self, row: MapRow, views: int) -> None:
        """Raise QuotaExceeded if the map has no room for all views."""
        with self._store.database.read() as connection:
            row = current_map(connection, row)
            frames = map_usage(connection, row.number).frames
        if row.quota_frames is not None and frames + views > row.quota_frames:
            raise QuotaExceeded(
                f"The import has {views} views, but the map has {frames} of at most "
                f"{row.quota_frames} frames. Ask the operator for a larger quota (PATCH "
                f"/v1/maps/{row.name})."
            )

    def _states(self, task: LongJob) -> Counter[str]:
        with self._store.database.read() as connection:
            return states_of_import(connection, task.job)

    def _outcome(self, row: MapRow, views: _Views, pose: Floats, options: ImportOptions) -> str:
        """Localise a view rendered at a pose, on one core; return the coverage outcome."""
        session, parent = names_of(options)
        view = views.view(pose)
        query = Query(keep=False, filter=Filter(session=[session], tags=[VIRTUAL]))

        def ask(rows: list[MapRow]) -> Answer:
            signer = self._signers(rows[0].model_id)
            ready = prepare_upload(view.data, view.meta, signer, query, self._store.decoders)
            return self._queries.answer(rows, ready, query, Deadline(None))

        try:
            answer = steadily(self._store, [row.name], ask)
        except FrameError:
            return "not_found"
        stop = PathFrame(
            -1, "", None, None, None, parent, pose.tolist(), is_cloud=view.meta.intrinsics is None
        )
        return str(outcome_of(answer, stop, NewMapCoverage())["outcome"])

    def _result(
        self, task: LongJob, options: ImportOptions, stored: StoredSurface,
        progress: dict[str, Any],
    ) -> MapImportResult:  # fmt: skip
        surface, outcomes = stored.surface, progress["outcomes"]
        session, parent = names_of(options)
        counts = Counter(outcomes)
        names = ("points", "triangles", "units_per_metre", "units_from", "up_from", "notes")
        facts: dict[str, Any] = {name: progress[name] for name in names}
        # every view has a pose in the parent frame of the map, so no outcome is `unchecked`
        facts |= {name: counts[name] for name in COVERAGE_OUTCOMES if name != "unchecked"}
        return MapImportResult(
            **facts, up=direction(surface.up), offset=vector(surface.offset),
            session=session, parent_frame=parent, views=self._states(task)[FrameState.INDEXED],
            refused=progress["refused"], seen=progress["seen"], tested=len(outcomes),
            coverage=counts["found"] / len(outcomes) if outcomes else None,
            weak=weak_areas(stored, outcomes),
        )  # fmt: skip


#: Maximum coordinate of a point, in metres, for which single precision suffices.
_FARTHEST_M = 20_000.0


def _with_offset(surface: ReferenceSurface, offset: GivenVector, name: str) -> ReferenceSurface:
    """Return a surface with another offset; raise InvalidRequest if a point is too far from it."""
    to = np.array([offset.x, offset.y, offset.z])
    points = surface.points + (surface.offset - to)
    if not np.abs(points).max() <= _FARTHEST_M:
        middle = ", ".join(f"{x:.0f}" for x in surface.offset + surface.points.mean(axis=0))
        raise InvalidRequest(
            f"The centre of {name} is {middle}, more than {_FARTHEST_M / 1000:.0f} km from the "
            "offset. Check the offset (in metres) and the units of the file.",
            (("offset", "too far from the surface"),),
        )
    return replace(surface, points=points.astype(np.float32), offset=to)


def _counted(progress: dict[str, Any]) -> dict[str, Any]:
    """Return the progress with `done` updated to the number of completed steps."""
    return progress | {"done": sum(progress[name] for name in ("rendered", "signed", "tested"))}


def weak_areas(stored: StoredSurface, outcomes: list[Any]) -> list[WeakArea]:
    """Return the floor squares in which fewer than half of the test views were localised.

    Parameters
    ----------
    stored : surface with the poses of the test views
    outcomes : coverage outcome of each test view

    Returns
    -------
    areas : up to _MOST_WEAK areas, sorted by the number of failed views from high to low
    """
    if not outcomes:
        return []
    up = stored.surface.up
    flat = plan_axes(up)
    queried = [
        QueriedPosition(pose[:3, 3], outcome)
        for pose, outcome in zip(stored.held_out, outcomes, strict=True)
    ]
    plans, width = coverage_plans(
        {"": queried}, {"": stored.poses[:, :3, 3]}, {"": PlanAxes(flat, "frames")}, None
    )
    areas = []
    for cell in plans[0].cells:
        views = sum(getattr(cell, name) for name in COVERAGE_OUTCOMES)
        if 2 * cell.found < views:
            column, row = width * (cell.column + 0.5), width * (cell.row + 0.5)
            centre = column * flat[0] + row * flat[1] + stored.floor * up
            areas.append(
                WeakArea(centre=vector(centre), width_m=width, views=views, found=cell.found)
            )
    return sorted(areas, key=lambda area: area.found - area.views)[:_MOST_WEAK]
