"""What a job does: jobs themselves, imports, associations, coverage, differences of sessions,
reconstructions.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Literal, TypeVar, get_args

import httpx

from sceneprint_client.api import (
    Answer,
    Filter,
    Job,
    JobState,
    Page,
    Progress,
    ValidationOptions,
)
from sceneprint_client.api.admin import RetriedJobs
from sceneprint_client.api.base import checked
from sceneprint_client.api.coverage import (
    CoverageChanges,
    CoverageFrame,
    CoverageOutcome,
    MapCoverage,
    NewMapCoverage,
)
from sceneprint_client.api.frames import ImportItem, ImportOptions
from sceneprint_client.api.sessions import (
    Association,
    Difference,
    Edge,
    GraphFormat,
    NewAssociation,
    NewDifference,
)
from sceneprint_client.api.surface import NewReconstruction, Reconstruction
from sceneprint_client.errors import InvalidRequest, UnreadableArchive
from sceneprint_client.http import ServiceConnection, error_of, read_record
from sceneprint_client.requests import (
    association_path,
    coverage_path,
    difference_path,
    given,
    job_path,
    map_path,
    query_path,
    reconstruction_path,
)

if TYPE_CHECKING:
    from sceneprint_client.surface_encoding import SurfacePoints

#: A record of what a job does, with its `state`.
_Begun = TypeVar("_Begun", Association, MapCoverage, Difference, Reconstruction)
#: Pauses between two looks at a job, seconds: the first, and the longest.
_PAUSES_S = (0.02, 0.5)
#: Jobs that are looked at in one round; workers take them in about this order.
_WINDOW = 8
#: Bytes of an archive that are sent at once.
_CHUNK = 1 << 20


def growing_pauses(until: float) -> Iterator[float]:
    """Growing pauses that end at a time of `time.monotonic`; none if it has come."""
    pause, longest = _PAUSES_S
    while (left := until - time.monotonic()) > 0:
        yield min(pause, left)
        pause = min(1.4 * pause, longest)


class JobMethods(ServiceConnection):
    """Jobs, and what is begun as one."""

    def job(self, job_id: str) -> Job:
        """A job; UnknownJob where there is none."""
        return self._ask(Job, "GET", job_path(job_id))

    def jobs(self, state: JobState | None = None) -> Iterator[Job]:
        """Jobs of all maps, the newest first; those in one state where asked for."""
        return self._items(Page[Job], "/v1/jobs", state=state)

    def cancel_job(self, job_id: str) -> Job:
        """Give up a job that is not over; its frame is `failed` then.

        Raises
        ------
        UnknownJob : there is none.
        JobOver : there is nothing left to give up.
        """
        return self._ask(Job, "POST", f"{job_path(job_id)}/cancel")

    def retry_job(self, job_id: str) -> Job:
        """Try again what was given up: dead, cancelled or failed.

        Returns
        -------
        job : a new one, or the one that is trying again already

        Raises
        ------
        UnknownJob : there is none.
        CannotRetry : it was not given up, or there is nothing to try again.
        """
        return self._ask(Job, "POST", f"{job_path(job_id)}/retry")

    def retry_dead_jobs(self, map_name: str | None = None) -> Iterator[RetriedJobs]:
        """Try again all dead jobs, or those of a map; those that were tried since stay.

        Yields
        ------
        done : of a page of them, as it is done

        Raises
        ------
        UnknownMap : there is no map of that name.
        """
        cursor: str | None = None
        while True:
            asked = given(map=map_name, cursor=cursor)
            done = self._ask(RetriedJobs, "POST", "/v1/jobs/retry", params=asked)
            yield done
            cursor = done.next_cursor
            if cursor is None:
                return

    def wait(
        self, job_ids: Iterable[str], *, timeout_s: float = 600.0,
        progress: Callable[[int, int], None] | None = None,
    ) -> list[Job]:  # fmt: skip
        """Wait until jobs are over.

        Parameters
        ----------
        job_ids : of uploads
        timeout_s : after which they are returned as they are
        progress : called with the number of jobs that are over, and of all

        Returns
        -------
        jobs : in the order given; `job.state.over` is False where the time ran out

        Raises
        ------
        UnknownJob : there is no job of one of the ids.
        """
        order, known = list(job_ids), dict[str, Job]()
        waiting = list(dict.fromkeys(order))
        total, until = len(waiting), time.monotonic() + timeout_s
        for pause in growing_pauses(until):
            while waiting:  # without a pause, as long as some of the window are over
                window = waiting[:_WINDOW]
                known |= {job_id: self.job(job_id) for job_id in window}
                left = [job_id for job_id in window if not known[job_id].state.over]
                waiting[:_WINDOW] = left
                if progress is not None:
                    progress(total - len(waiting), total)
                if len(left) == len(window) or time.monotonic() > until:
                    break
            if not waiting:
                break
            self._let_work(pause)
        return [known[job_id] if job_id in known else self.job(job_id) for job_id in order]

    def _until_over(
        self, begun: _Begun, look: Callable[[], _Begun], timeout_s: float,
        progress: Callable[[int, int], None] | None = None,
    ) -> _Begun:  # fmt: skip
        """What a job does, once it is over, or as it is when the time has come.

        Parameters
        ----------
        begun : as it is known
        look : asks for it once more
        timeout_s : for its end
        progress : called with the steps that are done, and of how many, where it tells them
        """
        pauses = growing_pauses(time.monotonic() + timeout_s)
        while True:
            done: Progress | None = getattr(begun, "progress", None)
            if progress is not None and done is not None and done.total is not None:
                progress(done.done, done.total)
            pause = next(pauses, None)
            if begun.state.over or pause is None:
                return begun
            self._let_work(pause)
            begun = look()

    # archives: imports are jobs

    def import_archive(
        self, map_name: str, archive: Path | BinaryIO, options: ImportOptions | None = None
    ) -> Job:
        """Take an archive of sequences into a map; a worker takes its frames one by one.

        Parameters
        ----------
        map_name : of the map
        archive : a zip, or a tar (plain, .gz, .bz2 or .xz), of a 7-Scenes scene or sequence, a TUM
            RGB-D folder, or depth images with their intrinsics.json
        options : what is said of all its frames; default: named as the file is

        Returns
        -------
        job : wait for it with `wait`, and see what came of it with `import_items`

        Raises
        ------
        UnknownMap : no such map.
        UnreadableArchive : no archive, or the file cannot be read.
        """
        if not isinstance(archive, Path):
            return self._send_archive(map_name, archive, options or ImportOptions())
        try:
            with archive.open("rb") as file:
                name = archive.name.partition(".")[0][:64] or "import"
                own = options or checked(ImportOptions, "The archive's name", name=name)
                return self._send_archive(map_name, file, own)
        except OSError as error:
            raise UnreadableArchive(
                f"{archive}: The file cannot be read ({error.strerror}). Check its name."
            ) from error

    def import_job(self, map_name: str, job_id: str) -> Job:
        """An import of a map; UnknownMap or UnknownJob where there is none."""
        return self._ask(Job, "GET", _import_path(map_name, job_id))

    def import_items(self, map_name: str, job_id: str) -> Iterator[ImportItem]:
        """What came of each member of an archive so far, in their order."""
        return self._items(Page[ImportItem], f"{_import_path(map_name, job_id)}/items")

    def _send_archive(self, map_name: str, archive: BinaryIO, options: ImportOptions) -> Job:
        """Send an archive, from its start at each try."""
        path = f"{map_path(map_name)}/imports"
        parameters = {"options": options.model_dump_json(exclude_defaults=True)}

        def send() -> httpx.Response:
            archive.seek(0)
            return self._http.request(
                "POST", path, content=_chunks(archive), params=parameters,
                timeout=self._timeout_s, headers={"Content-Type": "application/octet-stream"},
            )  # fmt: skip

        response, _ = self._persist(send)
        if not response.is_success:
            raise error_of(response)
        return read_record(Job, response)

    # associations

    def associate(
        self, map_name: str, session: str, other: str | None = None, *,
        robots: Sequence[str] | None = None, filter: Filter | Mapping[str, Any] | None = None,  # noqa: A002
        apart: int | None = None, not_within_s: float | None = None, k: int = 3,
        candidates: int = 10, seed: int = 0, min_overlap: float = 0.0,
        validation: ValidationOptions | Mapping[str, Any] | None = None, timeout_s: float = 3600.0,
        progress: Callable[[int, int], None] | None = None,
    ) -> Association:  # fmt: skip
        """Find where two sessions see the same places, or one session comes back to some.

        Parameters
        ----------
        map_name : of the map
        session : each of its frames is looked up
        other : among the frames of this one; default: among the session's own, taken before it
        robots : who took each of them, needed where several robots call their sessions alike
        filter : only frames that pass it are taken
        apart, not_within_s : of one session, frames or seconds that come between
        k, candidates, seed : accepted edges wanted of each frame, among so many candidates
        min_overlap : least overlap of an edge that is kept
        validation : what an edge must stand
        timeout_s : for its end; 0 to return at once. It goes on, whoever waits
        progress : called with the number of frames that are done, and of all

        Returns
        -------
        association : `association.state.over` is False where the time ran out

        Raises
        ------
        UnknownMap : no such map.
        InvalidRequest : a session without frames, of several robots, or with too many frames; or
            an option out of its range.
        """
        sessions = [session] if other is None else [session, other]
        fields = given(
            robots=robots, filter=filter, apart=apart, not_within_s=not_within_s,
            validation=validation,
        )  # fmt: skip
        wanted = checked(
            NewAssociation, "The association", sessions=sessions, k=k, candidates=candidates,
            seed=seed, min_overlap=min_overlap, **fields,
        )  # fmt: skip
        begun = self._ask(
            Association, "POST", f"{map_path(map_name)}/associations",
            json=wanted.model_dump(mode="json", exclude_unset=True),
        )  # fmt: skip
        return self.wait_for_association(begun, timeout_s=timeout_s, progress=progress)

    def wait_for_association(
        self, association: Association, *, timeout_s: float = 3600.0,
        progress: Callable[[int, int], None] | None = None,
    ) -> Association:  # fmt: skip
        """An association once it is over, or as it is when the time has come; see `associate`."""
        return self._until_over(
            association, lambda: self.association(association.map, association.association_id),
            timeout_s, progress,
        )  # fmt: skip

    def association(self, map_name: str, association_id: str) -> Association:
        """An association; UnknownMap or UnknownJob where there is none."""
        return self._ask(Association, "GET", association_path(map_name, association_id))

    def delete_association(self, map_name: str, association_id: str) -> None:
        """Forget an association with its edges; UnknownMap or UnknownJob where there is none."""
        self._delete(association_path(map_name, association_id))

    def associations(self, map_name: str) -> Iterator[Association]:
        """Associations of a map, the newest first; UnknownMap."""
        return self._items(Page[Association], f"{map_path(map_name)}/associations")

    def edges(
        self, map_name: str, association_id: str, *, min_overlap: float = 0.0,
        consistent: bool | None = None,
    ) -> Iterator[Edge]:  # fmt: skip
        """Edges of an association in the order in which they were found.

        Parameters
        ----------
        map_name, association_id : of the association
        min_overlap : least overlap
        consistent : those that loops confirm, or those that were outvoted; default: all

        Raises
        ------
        UnknownMap, UnknownJob : there is none.
        InvalidRequest : an overlap out of its range.
        """
        _check_overlap(min_overlap)
        return self._items(
            Page[Edge], f"{association_path(map_name, association_id)}/edges",
            min_overlap=min_overlap, consistent=consistent,
        )  # fmt: skip

    def graph(
        self, map_name: str, association_id: str, kind: GraphFormat = "g2o", *,
        min_overlap: float = 0.0, odometry: bool = False, consistent: bool = False,
    ) -> str:  # fmt: skip
        """The pose graph of an association that has succeeded, as a file.

        Parameters
        ----------
        map_name, association_id : of the association
        kind : g2o, tum or json
        min_overlap : least overlap of an edge
        odometry : with an edge between each two consecutive frames, from their poses
        consistent : only edges that loops confirm; else all that were not outvoted

        Raises
        ------
        UnknownMap, UnknownJob : there is none.
        NotIndexed : it is not over, or did not succeed.
        InvalidRequest : there is no such file, or an overlap out of its range.
        """
        known = get_args(GraphFormat)
        if kind not in known:
            raise InvalidRequest(
                f"A graph does not come as {kind!r:.80}. Give one of {', '.join(known)}.",
                (("format", f"give one of {', '.join(known)}"),),
            )
        _check_overlap(min_overlap)
        asked = {
            "format": kind, "min_overlap": min_overlap, "odometry": odometry,
            "consistent": consistent,
        }  # fmt: skip
        path = f"{association_path(map_name, association_id)}/graph"
        return self._bytes(path, params=asked).decode()

    # coverage

    def coverage(
        self, map_name: str, *, session: str | None = None, robot: str | None = None,
        every: int = 1, most: int = 1000, not_within_s: float | None = None,
        other_sessions: bool = False, tolerance_m: float = 0.5, tolerance_deg: float = 15.0,
        cell_m: float | None = None, seed: int = 0, like: MapCoverage | None = None,
        timeout_s: float = 3600.0, progress: Callable[[int, int], None] | None = None,
    ) -> MapCoverage:  # fmt: skip
        """Measure where in a map a robot would be found: query frames of it against the rest.

        Parameters
        ----------
        map_name : of the map
        session, robot : query only frames of these
        every, most : every n-th frame, and at most so many
        not_within_s : leave out frames of the queried frame's session taken within so many
            seconds; default: 10
        other_sessions : leave out all of its session
        tolerance_m, tolerance_deg : within which a pose that was found is right
        cell_m : width of the plans' cells; default: one that fits
        seed : of the queries
        like : an earlier result, whose options are taken in place of all above, and the width of
            its cells: `coverage_changes` can compare the two
        timeout_s : for its end; 0 to return at once. It goes on, whoever waits
        progress : called with the number of frames that are done, and of all

        Returns
        -------
        coverage : `coverage.state.over` is False where the time ran out

        Raises
        ------
        UnknownMap : no such map.
        InvalidRequest : it has no such frames, or an option is out of its range.
        """
        wanted = checked(
            NewMapCoverage, "The coverage", every=every, most=most, tolerance_m=tolerance_m,
            tolerance_deg=tolerance_deg, seed=seed, other_sessions=other_sessions,
            **given(session=session, robot=robot, not_within_s=not_within_s, cell_m=cell_m),
        )  # fmt: skip
        if like is not None:
            width = None if like.result is None else like.result.cell_m
            wanted = like.asked.model_copy(update=given(cell_m=width))
        begun = self._ask(
            MapCoverage, "POST", f"{map_path(map_name)}/coverage",
            json=wanted.model_dump(mode="json", exclude_unset=True),
        )  # fmt: skip
        return self.wait_for_coverage(begun, timeout_s=timeout_s, progress=progress)

    def wait_for_coverage(
        self, coverage: MapCoverage, *, timeout_s: float = 3600.0,
        progress: Callable[[int, int], None] | None = None,
    ) -> MapCoverage:  # fmt: skip
        """A coverage job once it is over, or as it is when the time has come; see `coverage`."""
        return self._until_over(
            coverage, lambda: self.coverage_result(coverage.map, coverage.coverage_id), timeout_s,
            progress,
        )  # fmt: skip

    def coverage_result(self, map_name: str, coverage_id: str) -> MapCoverage:
        """A coverage job as it is now; UnknownMap or UnknownJob where there is none."""
        return self._ask(MapCoverage, "GET", coverage_path(map_name, coverage_id))

    def coverage_jobs(self, map_name: str) -> Iterator[MapCoverage]:
        """Coverage jobs of a map without their plans, the newest first; UnknownMap."""
        return self._items(Page[MapCoverage], f"{map_path(map_name)}/coverage")

    def coverage_frames(
        self, map_name: str, coverage_id: str, outcome: CoverageOutcome | None = None
    ) -> Iterator[CoverageFrame]:
        """Queried frames of a coverage job; those of one outcome where asked for.

        Raises
        ------
        UnknownMap, UnknownJob : there is none.
        """
        path = f"{coverage_path(map_name, coverage_id)}/frames"
        return self._items(Page[CoverageFrame], path, outcome=outcome)

    def coverage_changes(self, map_name: str, coverage_id: str, since: str) -> CoverageChanges:
        """Which cells became better or worse since an earlier result of the same options.

        Raises
        ------
        UnknownMap, UnknownJob : one of them is not there.
        NotIndexed : one of them is not over, or did not succeed.
        InvalidRequest : they cannot be compared.
        """
        path = f"{coverage_path(map_name, coverage_id)}/changes"
        return self._ask(CoverageChanges, "GET", path, params={"since": since})

    def coverage_plan(
        self, map_name: str, coverage_id: str, parent_frame: str | None = None
    ) -> bytes:
        """A plan of a coverage job as a PNG file: of most queried frames, or of a parent frame.

        Raises
        ------
        UnknownMap, UnknownJob : there is none.
        NotIndexed : it is not over, did not succeed, or no queried frame has a pose.
        InvalidRequest : it has no plan of that parent frame.
        """
        path = f"{coverage_path(map_name, coverage_id)}/plan.png"
        return self._bytes(path, params=given(parent_frame=parent_frame))

    def delete_coverage(self, map_name: str, coverage_id: str) -> None:
        """Delete a coverage job with its result; UnknownMap or UnknownJob where there is none."""
        self._delete(coverage_path(map_name, coverage_id))

    # differences of sessions

    def compare_sessions(
        self, map_name: str, before: str, after: str, *, parent_frame: str | None = None,
        timeout_s: float = 3600.0, progress: Callable[[int, int], None] | None = None,
    ) -> Difference:  # fmt: skip
        """Compare two sessions of a map: which surfaces are gone, and which are new.

        Parameters
        ----------
        map_name : of the map
        before, after : the earlier and the later session
        parent_frame : of the poses; default: the one that most frames of both share
        timeout_s : for its end; 0 to return at once. It goes on, whoever waits
        progress : called with the number of steps that are done, and of all

        Returns
        -------
        difference : `difference.state.over` is False where the time ran out

        Raises
        ------
        UnknownMap : no such map.
        InvalidRequest : one session twice or one that is not there, or the two share no parent
            frame.
        """
        wanted = checked(
            NewDifference, "The difference", before=before, after=after,
            **given(parent_frame=parent_frame),
        )  # fmt: skip
        begun = self._ask(
            Difference, "POST", f"{map_path(map_name)}/differences",
            json=wanted.model_dump(mode="json", exclude_unset=True),
        )  # fmt: skip
        return self._until_over(
            begun, lambda: self.difference(map_name, begun.difference_id), timeout_s, progress
        )

    def difference(self, map_name: str, difference_id: str) -> Difference:
        """A difference as it is now; UnknownMap or UnknownJob where there is none."""
        return self._ask(Difference, "GET", difference_path(map_name, difference_id))

    def differences(self, map_name: str) -> Iterator[Difference]:
        """Differences of a map, the newest first; UnknownMap."""
        return self._items(Page[Difference], f"{map_path(map_name)}/differences")

    def difference_points(self, map_name: str, difference_id: str) -> SurfacePoints:
        """Cells of both sessions as points. `patches` says what each is: SAME, GONE, NEW,
        UNSEEN_AFTER or UNSEEN_BEFORE of `sceneprint_client.api.sessions`.

        Raises
        ------
        UnknownMap, UnknownJob : there is none.
        NotIndexed : it is not over, or did not succeed.
        Refused : the service is of another version.
        """
        from sceneprint_client.surface_encoding import decode_points  # loads numpy

        return decode_points(self._bytes(f"{difference_path(map_name, difference_id)}/points"))

    def delete_difference(self, map_name: str, difference_id: str) -> None:
        """Delete a difference with its points; UnknownMap or UnknownJob where there is none."""
        self._delete(difference_path(map_name, difference_id))

    # reconstructions

    def reconstruct(
        self, query: str | Answer, *, frames: Iterable[str] | None = None,
        strength: Literal["strong", "any"] = "any", include_query: bool = True,
        voxel_m: float | None = None, output: Literal["mesh", "cloud"] = "mesh",
        wait_s: float | None = None,
    ) -> Reconstruction:  # fmt: skip
        """Fuse the accepted matches of an answer to a surface, in the query's camera frame.

        Parameters
        ----------
        query : the answer, or the id of its query; answers are kept for an hour
        frames, strength, include_query, voxel_m, output : see NewReconstruction
        wait_s : seconds to wait until it is done; default: none

        Returns
        -------
        reconstruction : `coverage` is there when its state is `succeeded`; `error` says why not

        Raises
        ------
        UnknownQuery : the answer is not kept, or no longer.
        InvalidRequest : it has no accepted match, or not those that are named.
        """
        chosen = None if frames is None else tuple(frames)
        wanted = checked(
            NewReconstruction, "The reconstruction", frames=chosen, strength=strength,
            include_query=include_query, voxel_m=voxel_m, output=output,
        )  # fmt: skip
        query_id = query if isinstance(query, str) else query.query_id
        begun = self._ask(
            Reconstruction, "POST", f"{query_path(query_id)}/reconstruction",
            json=wanted.model_dump(mode="json", exclude_unset=True),
        )  # fmt: skip
        if wait_s is None:
            return begun
        return self._until_over(begun, lambda: self.reconstruction(begun.job_id), wait_s)

    def reconstruction(self, job_id: str) -> Reconstruction:
        """A reconstruction as it is now; UnknownJob where there is none."""
        return self._ask(Reconstruction, "GET", reconstruction_path(job_id))

    def reconstruction_mesh(self, job_id: str) -> bytes:
        """Its surface as a PLY file.

        Raises
        ------
        UnknownJob : there is no such reconstruction.
        NotIndexed : it is not done, or has failed.
        """
        return self._bytes(f"{reconstruction_path(job_id)}/mesh.ply")

    def reconstruction_picture(self, job_id: str) -> bytes:
        """Its picture as a PNG file; see `reconstruction_mesh`."""
        return self._bytes(f"{reconstruction_path(job_id)}/picture.png")

    def delete_reconstruction(self, job_id: str) -> None:
        """Remove a reconstruction with its files; UnknownJob where there is none."""
        self._delete(reconstruction_path(job_id))


def _import_path(map_name: str, job_id: str) -> str:
    return f"{map_path(map_name)}/imports/{job_path(job_id).rpartition('/')[2]}"


def _chunks(file: BinaryIO) -> Iterator[bytes]:
    while chunk := file.read(_CHUNK):
        yield chunk


def _check_overlap(least: float) -> None:
    if not 0.0 <= least <= 1.0:
        raise InvalidRequest(
            f"The least overlap is {least}. Give one from 0 to 1.",
            (("min_overlap", "out of its range"),),
        )
