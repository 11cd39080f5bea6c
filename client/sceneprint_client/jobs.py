"""What a job does: jobs themselves, imports, associations, coverage, differences of sessions,
reconstructions.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, TypeVar, get_args

import httpx

from sceneprint_client.api import (
    Answer,
    Job,
    JobState,
    Page,
)
from sceneprint_client.api.admin import Product, RetriedJobs
from sceneprint_client.api.base import checked
from sceneprint_client.api.coverage import (
    CoverageChanges,
    CoverageFrame,
    CoverageOutcome,
    MapCoverage,
)
from sceneprint_client.api.frames import ImportItem, ImportOptions
from sceneprint_client.api.sessions import (
    Association,
    Difference,
    Edge,
    GraphFormat,
)
from sceneprint_client.api.surface import NewReconstruction, Reconstruction
from sceneprint_client.errors import InvalidRequest, UnreadableArchive, UnreadableCloud
from sceneprint_client.http import (
    ServiceConnection,
    error_of,
    given,
    growing_pauses,
    job_path,
    map_path,
    product_path,
    query_path,
    read_record,
)

if TYPE_CHECKING:
    from sceneprint_client.surface_encoding import SurfacePoints


_Product = TypeVar("_Product", bound=Product)
#: Jobs that are looked at in one round; workers take them in about this order.
_WINDOW = 8
#: Bytes of an archive that are sent at once.
_CHUNK = 1 << 20


class JobMethods(ServiceConnection):
    """Jobs, and what is begun as one."""

    def job(self, job_id: str) -> Job:
        """Return a job; UnknownJob if it does not exist."""
        return self._ask(Job, "GET", job_path(job_id))

    def jobs(self, state: JobState | None = None) -> Iterator[Job]:
        """Jobs of all maps, newest first, optionally only those in one state."""
        return self._items(Page[Job], "/v1/jobs", state=state)

    def cancel_job(self, job_id: str) -> Job:
        """Cancel a job that has not ended; its frame becomes `failed`.

        Raises
        ------
        UnknownJob : it does not exist.
        JobOver : it has ended already.
        """
        return self._ask(Job, "POST", f"{job_path(job_id)}/cancel")

    def retry_job(self, job_id: str) -> Job:
        """Retry a job that is dead, cancelled or failed.

        Returns
        -------
        job : a new one, or the retry that exists already

        Raises
        ------
        UnknownJob : it does not exist.
        CannotRetry : it did not fail, or there is nothing to retry.
        """
        return self._ask(Job, "POST", f"{job_path(job_id)}/retry")

    def retry_dead_jobs(self, map_name: str | None = None) -> Iterator[RetriedJobs]:
        """Retry all dead jobs, or those of a map, except those already retried.

        Yields
        ------
        done : result of each page of jobs

        Raises
        ------
        UnknownMap : no such map.
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
        """Wait until jobs have ended.

        Parameters
        ----------
        job_ids : of uploads
        timeout_s : seconds after which they are returned as they are
        progress : called with the number of ended jobs and the total

        Returns
        -------
        jobs : in the order given; `job.state.over` is False if the time ran out

        Raises
        ------
        UnknownJob : one of them does not exist.
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

    # archives and whole maps: imports are jobs

    def import_archive(
        self, map_name: str, archive: Path | BinaryIO, options: ImportOptions | None = None
    ) -> Job:
        """Import an archive of sequences into a map; a worker reads its frames one by one.

        Parameters
        ----------
        map_name : of the map
        archive : a zip, or a tar (plain, .gz, .bz2 or .xz), of a 7-Scenes scene or sequence, a TUM
            RGB-D folder, or depth images with their intrinsics.json
        options : metadata of all its frames; default: a name from the file's

        Returns
        -------
        job : wait for it with `wait`; `import_items` lists the results

        Raises
        ------
        UnknownMap : no such map.
        UnreadableArchive : not an archive, or the file cannot be read.
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

    def import_map(
        self, map_name: str, file: Path | BinaryIO, options: ImportOptions | None = None
    ) -> Job:
        """Import a map that comes as one file, a cloud or a mesh: a worker renders views of it.

        Parameters
        ----------
        map_name : of the map that they become frames of
        file : PCD, PLY (points or mesh), LAS, LAZ, OBJ, STL, glTF or E57
        options : with `as` = `map`; default: that, and the name of the file. Of a file without a
            path, `name` says its format by its ending

        Returns
        -------
        job : wait for it with `wait`; its `result` is a MapImportResult, and `import_items` lists
            the views

        Raises
        ------
        UnknownMap : no such map.
        InvalidRequest : options of an archive.
        UnreadableCloud : no file of a map, or it cannot be read.
        """
        if not isinstance(file, Path):
            return self._send_archive(map_name, file, _of_map(options, None))
        try:
            with file.open("rb") as opened:
                return self._send_archive(map_name, opened, _of_map(options, file.name))
        except OSError as error:
            raise UnreadableCloud(
                f"{file}: The file cannot be read ({error.strerror}). Check its name."
            ) from error

    def import_items(self, map_name: str, job_id: str) -> Iterator[ImportItem]:
        """Results for the members of an archive so far, in their order."""
        job = job_path(job_id).rpartition("/")[2]
        return self._items(Page[ImportItem], f"{map_path(map_name)}/imports/{job}/items")

    def _send_archive(self, map_name: str, archive: BinaryIO, options: ImportOptions) -> Job:
        """Send an archive, from its start at each try."""
        path = f"{map_path(map_name)}/imports"
        parameters = {"options": options.model_dump_json(exclude_defaults=True, by_alias=True)}

        def send() -> httpx.Response:
            archive.seek(0)
            return self._http.request(
                "POST", path, content=iter(lambda: archive.read(_CHUNK), b""), params=parameters,
                timeout=self._timeout_s, headers={"Content-Type": "application/octet-stream"},
            )  # fmt: skip

        response, _ = self._persist(send)
        if not response.is_success:
            raise error_of(response)
        return read_record(Job, response)

    # products of maps: coverage, associations and differences of sessions

    def compute(
        self, kind: type[_Product], map_name: str, *, timeout_s: float = 3600.0,
        progress: Callable[[int, int], None] | None = None, **request: Any,
    ) -> _Product:  # fmt: skip
        """Compute a product of a map: measure its coverage, find where two of its sessions see the
        same places or one returns to a place, or compare two sessions.

        Parameters
        ----------
        kind : MapCoverage, Association or Difference
        map_name : of the map
        timeout_s : seconds to wait; 0 returns at once. The job continues in any case
        progress : called with the number of finished steps and the total
        request : fields of NewMapCoverage, NewAssociation or NewDifference

        Returns
        -------
        product : `product.state.over` is False if the time ran out

        Raises
        ------
        UnknownMap : no such map.
        InvalidRequest : the map has no such frames, or a field is out of range.
        """
        wanted = checked(kind.request_type, f"The {kind.noun}", **request)
        begun = self._begin(kind, f"{map_path(map_name)}/{kind.collection}", wanted)
        return self.wait_for_product(begun, timeout_s=timeout_s, progress=progress)

    def product(self, kind: type[_Product], map_name: str | None, job_id: str) -> _Product:
        """Return a product as it is now; UnknownMap or UnknownJob if it does not exist.

        Parameters
        ----------
        kind : MapCoverage, Association, Difference or Reconstruction
        map_name, job_id : of the product; a Reconstruction has no map
        """
        return self._ask(kind, "GET", product_path(kind, map_name, job_id))

    def products(self, kind: type[_Product], map_name: str) -> Iterator[_Product]:
        """Products of a map, newest first, coverage without plans; UnknownMap if it does not exist.

        Parameters
        ----------
        kind, map_name : see `product`
        """
        page: type[Page[_Product]] = Page[kind]  # type: ignore[valid-type]
        return self._items(page, f"{map_path(map_name)}/{kind.collection}")

    def delete_product(self, kind: type[Product], map_name: str | None, job_id: str) -> None:
        """Delete a product with its results, also while a worker computes it; see `product`.

        Raises
        ------
        UnknownMap, UnknownJob : it does not exist.
        JoinStands : it is an association, whose join must be undone first.
        """
        self._delete(product_path(kind, map_name, job_id))

    def wait_for_product(
        self, product: _Product, *, timeout_s: float = 3600.0,
        progress: Callable[[int, int], None] | None = None,
    ) -> _Product:  # fmt: skip
        """Return a product once it has ended, or when the time ran out.

        Parameters
        ----------
        product : as it is known
        timeout_s : seconds to wait
        progress : called with the number of finished steps and the total
        """
        pauses = growing_pauses(time.monotonic() + timeout_s)
        while True:
            done = product.progress
            if progress is not None and done is not None and done.total is not None:
                progress(done.done, done.total)
            pause = next(pauses, None)
            if product.state.over or pause is None:
                return product
            self._let_work(pause)
            product = self.product(type(product), product.map, product.job_id)

    # associations

    def undo_join(self, map_name: str, job_id: str) -> Association:
        """Undo the join of an association: poses are again as they were sent, or in the parent
        frame that other joins lead to. The map's sessions are not joined again automatically.

        Raises
        ------
        UnknownMap, UnknownJob : it does not exist.
        NotIndexed : it has not succeeded.
        """
        path = f"{product_path(Association, map_name, job_id)}/join"
        return self._ask(Association, "DELETE", path)

    def edges(
        self, map_name: str, job_id: str, *, min_overlap: float = 0.0,
        consistent: bool | None = None,
    ) -> Iterator[Edge]:  # fmt: skip
        """Edges of an association in the order they were found.

        Parameters
        ----------
        map_name, job_id : of the association
        min_overlap : least overlap
        consistent : only edges that a second edge or a join supports (True), or that were outvoted
            (False); default: all

        Raises
        ------
        UnknownMap, UnknownJob : it does not exist.
        InvalidRequest : an overlap out of range.
        """
        _check_overlap(min_overlap)
        return self._items(
            Page[Edge], f"{product_path(Association, map_name, job_id)}/edges",
            min_overlap=min_overlap, consistent=consistent,
        )  # fmt: skip

    def graph(
        self, map_name: str, job_id: str, kind: GraphFormat = "g2o", *,
        min_overlap: float = 0.0, odometry: bool = False, consistent: bool = True,
    ) -> str:  # fmt: skip
        """Return the pose graph of an association that has succeeded, as a file.

        Parameters
        ----------
        map_name, job_id : of the association
        kind : g2o, tum or json
        min_overlap : least overlap of an edge
        odometry : add an edge between consecutive frames, from their poses
        consistent : only edges that a second edge of another viewpoint or a join supports; False
            adds those that nothing checks, such as all edges of frames without poses

        Raises
        ------
        UnknownMap, UnknownJob : it does not exist.
        NotIndexed : it has not ended, or did not succeed.
        InvalidRequest : there is no such file, or an overlap out of range.
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
        path = f"{product_path(Association, map_name, job_id)}/graph"
        return self._bytes(path, params=asked).decode()

    # coverage

    def coverage_frames(
        self, map_name: str, job_id: str, outcome: CoverageOutcome | None = None
    ) -> Iterator[CoverageFrame]:
        """Queried frames of a coverage job, optionally only those with one outcome.

        Raises
        ------
        UnknownMap, UnknownJob : it does not exist.
        """
        path = f"{product_path(MapCoverage, map_name, job_id)}/frames"
        return self._items(Page[CoverageFrame], path, outcome=outcome)

    def coverage_changes(self, map_name: str, job_id: str, since: str) -> CoverageChanges:
        """Which cells became better or worse since an earlier result with the same options.

        Raises
        ------
        UnknownMap, UnknownJob : one of them does not exist.
        NotIndexed : one of them has not ended, or did not succeed.
        InvalidRequest : they cannot be compared.
        """
        path = f"{product_path(MapCoverage, map_name, job_id)}/changes"
        return self._ask(CoverageChanges, "GET", path, params={"since": since})

    # differences of sessions

    def difference_points(self, map_name: str, job_id: str) -> SurfacePoints:
        """Cells of both sessions as points. `patches` gives the kind of each: SAME, GONE, NEW,
        UNSEEN_AFTER or UNSEEN_BEFORE of `sceneprint_client.api.sessions`.

        Raises
        ------
        UnknownMap, UnknownJob : it does not exist.
        NotIndexed : it has not ended, or did not succeed.
        Refused : the service has another version.
        """
        from sceneprint_client.surface_encoding import decode_points  # loads numpy

        return decode_points(self._bytes(f"{product_path(Difference, map_name, job_id)}/points"))

    # reconstructions

    def reconstruct(
        self, query: str | Answer, *, wait_s: float | None = None, **request: Any
    ) -> Reconstruction:
        """Fuse the accepted matches of an answer into a surface, in the query's camera frame.

        Parameters
        ----------
        query : the answer, or the id of its query
        wait_s : seconds to wait for it; default: none
        request : fields of NewReconstruction

        Returns
        -------
        reconstruction : has a `result` when its state is `succeeded`; else `error` says why

        Raises
        ------
        UnknownQuery : the answer is not stored, or no longer.
        InvalidRequest : it has no accepted match, or lacks a named one.
        """
        wanted = checked(NewReconstruction, "The reconstruction", **request)
        query_id = query if isinstance(query, str) else query.query_id
        begun = self._begin(Reconstruction, f"{query_path(query_id)}/reconstruction", wanted)
        return begun if wait_s is None else self.wait_for_product(begun, timeout_s=wait_s)

    def reconstruction_mesh(self, job_id: str) -> bytes:
        """Return the surface of a reconstruction as a PLY file.

        Raises
        ------
        UnknownJob : it does not exist.
        NotIndexed : it has not ended, or failed.
        """
        return self._bytes(f"{product_path(Reconstruction, None, job_id)}/mesh.ply")


def _of_map(options: ImportOptions | None, name: str | None) -> ImportOptions:
    """Return the options of the import of a map; InvalidRequest where they are of an archive."""
    if options is None:
        own = {"as": "map"} if name is None else {"as": "map", "name": name[-64:].lstrip(".")}
        return checked(ImportOptions, "The map's name", **own)
    if options.as_ != "map":
        raise InvalidRequest(
            "The options are those of an archive. Make them with `as` = `map`.",
            (("as", "not `map`"),),
        )
    return options


def _check_overlap(least: float) -> None:
    if not 0.0 <= least <= 1.0:
        raise InvalidRequest(
            f"The least overlap is {least}. Give one from 0 to 1.",
            (("min_overlap", "out of its range"),),
        )
