"""Client methods for jobs: imports, associations, coverage, differences and reconstructions."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, TypeVar

import httpx

from sceneprint_client.api import Answer, Job, JobState, Page
from sceneprint_client.api.admin import Product, RetriedJobs
from sceneprint_client.api.base import checked
from sceneprint_client.api.coverage import (
    CoverageChanges,
    CoverageFrame,
    CoverageOutcome,
    MapCoverage,
)
from sceneprint_client.api.frames import ImportItem, ImportOptions
from sceneprint_client.api.sessions import Association, Difference, Edge, GraphFormat
from sceneprint_client.api.surface import NewReconstruction, Reconstruction
from sceneprint_client.calls import Call, Series
from sceneprint_client.errors import FrameError, InvalidRequest, UnreadableArchive, UnreadableCloud
from sceneprint_client.http import (
    ServiceConnection,
    error_of,
    growing_pauses,
    job_path,
    map_path,
    product_path,
    query_path,
    read_record,
    without_none,
)

if TYPE_CHECKING:
    from sceneprint_client.surface_encoding import SurfacePoints


_Product = TypeVar("_Product", bound=Product)
#: Number of jobs that `wait` checks at a time, in the order in which workers usually run them.
_WINDOW = 8
#: Size of the pieces in which an archive is sent, bytes.
_CHUNK = 1 << 20


class JobMethods(ServiceConnection):
    """Client methods for jobs and their results."""

    @Call
    async def job(self, job_id: str) -> Job:
        """Return a job; raise UnknownJob if it does not exist."""
        return await self._call(Job, "GET", job_path(job_id))

    @Series
    def jobs(self, state: JobState | None = None) -> AsyncIterator[Job]:
        """Yield the jobs of all maps, newest first, optionally only those in one state."""
        return self._pages(Page[Job], "/v1/jobs", state=state)

    @Call
    async def cancel_job(self, job_id: str) -> Job:
        """Cancel a job that has not ended, and return it; its frame becomes `failed`.

        Raise UnknownJob if the job does not exist. Raise JobOver if the job has ended.
        """
        return await self._call(Job, "POST", f"{job_path(job_id)}/cancel")

    @Call
    async def retry_job(self, job_id: str) -> Job:
        """Retry a job that is dead, cancelled or failed.

        Returns
        -------
        job : the new job, or the existing retry

        Raises
        ------
        UnknownJob : If the job does not exist.
        CannotRetry : If the job did not fail, or there is nothing to retry.
        """
        return await self._call(Job, "POST", f"{job_path(job_id)}/retry")

    @Series
    async def retry_dead_jobs(self, map_name: str | None = None) -> AsyncIterator[RetriedJobs]:
        """Retry all dead jobs, or those of a map, except jobs with an earlier retry.

        Yields
        ------
        done : result of each page of jobs

        Raises
        ------
        UnknownMap : If the map does not exist.
        """
        cursor: str | None = None
        while True:
            parameters = without_none(map=map_name, cursor=cursor)
            done = await self._call(RetriedJobs, "POST", "/v1/jobs/retry", params=parameters)
            yield done
            cursor = done.next_cursor
            if cursor is None:
                return

    @Call
    async def wait(
        self, job_ids: Iterable[str], *, timeout_s: float = 600.0,
        progress: Callable[[int, int], None] | None = None,
    ) -> list[Job]:  # fmt: skip
        """Wait until jobs have ended.

        Parameters
        ----------
        job_ids : ids of jobs, such as `job_id` of uploads
        timeout_s : longest wait, seconds
        progress : function that is called with the number of ended jobs and the total

        Returns
        -------
        jobs : the jobs in the order of `job_ids`; `job.state.over` is False after a timeout

        Raises
        ------
        UnknownJob : If one of the jobs does not exist.
        """
        order, latest = list(job_ids), dict[str, Job]()
        waiting = list(dict.fromkeys(order))
        total, until = len(waiting), time.monotonic() + timeout_s
        for pause in growing_pauses(until):
            while waiting:  # pause only if no job in the window has ended
                window = waiting[:_WINDOW]
                latest |= {job_id: await self.job(job_id) for job_id in window}
                unfinished = [job_id for job_id in window if not latest[job_id].state.over]
                waiting[:_WINDOW] = unfinished
                if progress is not None:
                    progress(total - len(waiting), total)
                if len(unfinished) == len(window) or time.monotonic() > until:
                    break
            if not waiting:
                break
            await self._work_or_wait(pause)
        return [latest[job_id] if job_id in latest else await self.job(job_id) for job_id in order]

    @Call
    async def import_archive(
        self, map_name: str, archive: Path | BinaryIO, options: ImportOptions | None = None
    ) -> Job:
        """Import an archive of sequences into a map; a worker reads its frames one by one.

        Parameters
        ----------
        archive : zip or tar (plain, .gz, .bz2 or .xz) of a 7-Scenes scene or sequence, a TUM RGB-D
            folder, or depth images with their intrinsics.json; or an MCAP file or ROS 1 bag
        options : metadata of all frames; default: only a name, derived from the file name. With
            `as` = `recording`, `name` is the file name, and `progress.recording` of the job lists
            the topics

        Returns
        -------
        job : the import; `wait` waits for it, and `import_items` lists its results

        Raises
        ------
        UnknownMap : If the map does not exist.
        UnreadableArchive : If the file cannot be read or is not an archive.
        """
        if not isinstance(archive, Path):
            return await self._send_archive(map_name, archive, options or ImportOptions())
        name = archive.name.partition(".")[0][:64] or "import"
        own = options or checked(ImportOptions, "The archive's name", name=name)
        with _opened(archive, UnreadableArchive) as file:
            return await self._send_archive(map_name, file, own)

    @Call
    async def import_map(
        self, map_name: str, file: Path | BinaryIO, options: ImportOptions | None = None
    ) -> Job:
        """Import a map from a file with a cloud or a mesh; a worker renders views of it.

        Parameters
        ----------
        map_name : name of the map that receives the views as frames
        file : PCD, PLY (points or mesh), LAS, LAZ, OBJ, STL, glTF or E57
        options : options with `as` = `map`; default: `as` = `map` and the file's name. For a file
            object, the suffix of `name` determines the format

        Returns
        -------
        job : the import; its `result` is a MapImportResult, `wait` waits for it, and `import_items`
            lists the views

        Raises
        ------
        UnknownMap : If the map does not exist.
        InvalidRequest : If the options are those of an archive.
        UnreadableCloud : If the file cannot be read or its format cannot hold a map.
        """
        if not isinstance(file, Path):
            return await self._send_archive(map_name, file, _map_import_options(options, None))
        own = _map_import_options(options, file.name)
        with _opened(file, UnreadableCloud) as opened:
            return await self._send_archive(map_name, opened, own)

    @Series
    def import_items(self, map_name: str, job_id: str) -> AsyncIterator[ImportItem]:
        """Yield the available results of an import, in the order of the archive."""
        job = job_path(job_id).rpartition("/")[2]
        return self._pages(Page[ImportItem], f"{map_path(map_name)}/imports/{job}/items")

    async def _send_archive(self, map_name: str, archive: BinaryIO, options: ImportOptions) -> Job:
        """Send a file to import and return the job; each attempt sends it from the beginning."""
        path = f"{map_path(map_name)}/imports"
        parameters = {"options": options.model_dump_json(exclude_defaults=True, by_alias=True)}

        def send() -> httpx.Response | Awaitable[httpx.Response]:
            archive.seek(0)
            return self._http.request(
                "POST", path, content=self._pieces(archive), params=parameters,
                timeout=self._timeout_s, headers={"Content-Type": "application/octet-stream"},
            )  # fmt: skip

        response, _ = await self._persist(send)
        if not response.is_success:
            raise error_of(response)
        return read_record(Job, response)

    def _pieces(self, archive: BinaryIO) -> Any:
        """Return an iterator over the content of an archive, asynchronous for AsyncClient."""
        if self._is_blocking:
            return iter(lambda: archive.read(_CHUNK), b"")

        async def pieces() -> AsyncIterator[bytes]:
            while piece := await self._run(archive.read, _CHUNK):
                yield piece

        return pieces()

    @Call
    async def compute(
        self, /, kind: type[_Product], map_name: str, *, timeout_s: float = 3600.0,
        progress: Callable[[int, int], None] | None = None, **request: Any,
    ) -> _Product:  # fmt: skip
        """Compute a product of a map: coverage, an association, or a difference of sessions.

        An association finds places that two sessions share, or to which one session returns.

        Parameters
        ----------
        kind : MapCoverage, Association or Difference
        timeout_s : longest wait, seconds; the job continues after it. 0 returns immediately
        progress : function that is called with the number of finished steps and the total
        request : fields of NewMapCoverage, NewAssociation or NewDifference

        Returns
        -------
        product : the product; `product.state.over` is False after a timeout

        Raises
        ------
        UnknownMap : If the map does not exist.
        InvalidRequest : If the map lacks the requested frames, or a field is out of range.
        """
        options = checked(kind.request_type, f"The {kind.noun}", **request)
        product = await self._create(kind, f"{map_path(map_name)}/{kind.collection}", options)
        return await self.wait_for_product(product, timeout_s=timeout_s, progress=progress)

    @Call
    async def product(self, kind: type[_Product], map_name: str | None, job_id: str) -> _Product:
        """Return a product.

        Parameters
        ----------
        kind : MapCoverage, Association, Difference or Reconstruction
        map_name, job_id : ids of the product; `map_name` is None for a Reconstruction

        Raises
        ------
        UnknownMap, UnknownJob : If the map or job does not exist.
        """
        return await self._call(kind, "GET", product_path(kind, map_name, job_id))

    @Series
    def products(self, kind: type[_Product], map_name: str) -> AsyncIterator[_Product]:
        """Yield the products of a map, newest first; coverage results omit their plans.

        Parameters
        ----------
        kind, map_name : see `product`
        """
        page: type[Page[_Product]] = Page[kind]  # type: ignore[valid-type]
        return self._pages(page, f"{map_path(map_name)}/{kind.collection}")

    @Call
    async def delete_product(self, kind: type[Product], map_name: str | None, job_id: str) -> None:
        """Delete a product with its results, even while a worker computes it; see `product`.

        Raise UnknownMap or UnknownJob if the map or job does not exist. Raise JoinStands if the
        product is an association whose join must be undone first.
        """
        await self._delete(product_path(kind, map_name, job_id))

    @Call
    async def wait_for_product(
        self, product: _Product, *, timeout_s: float = 3600.0,
        progress: Callable[[int, int], None] | None = None,
    ) -> _Product:  # fmt: skip
        """Wait until a product has ended, and return its latest state.

        A timeout raises no error; check `state.over`.

        Parameters
        ----------
        product : product to wait for
        timeout_s : longest wait, seconds
        progress : function that is called after each poll with the number of finished steps and
            the total, if the latter is known
        """
        pauses = growing_pauses(time.monotonic() + timeout_s)
        while True:
            done = product.progress
            if progress is not None and done is not None and done.total is not None:
                progress(done.done, done.total)
            pause = next(pauses, None)
            if product.state.over or pause is None:
                return product
            await self._work_or_wait(pause)
            product = await self.product(type(product), product.map, product.job_id)

    @Call
    async def undo_join(self, map_name: str, job_id: str) -> Association:
        """Undo the join of an association and return it; its frames regain their uploaded poses.

        The effects of other joins on these frames remain. The sessions are not joined again
        automatically.

        Raise UnknownMap or UnknownJob if the map or job does not exist. Raise NotIndexed if the job
        has not succeeded.
        """
        path = f"{product_path(Association, map_name, job_id)}/join"
        return await self._call(Association, "DELETE", path)

    @Series
    def edges(
        self, map_name: str, job_id: str, *, min_overlap: float = 0.0,
        consistent: bool | None = None,
    ) -> AsyncIterator[Edge]:  # fmt: skip
        """Yield the edges of an association in the order of their discovery.

        Parameters
        ----------
        min_overlap : smallest overlap, 0 to 1
        consistent : True selects edges that a second edge or a join supports, False edges that
            contradict the majority; default: all

        Raises
        ------
        UnknownMap, UnknownJob : If the map or job does not exist.
        InvalidRequest : If the overlap is out of range.
        """
        return self._pages(
            Page[Edge], f"{product_path(Association, map_name, job_id)}/edges",
            min_overlap=min_overlap, consistent=consistent,
        )  # fmt: skip

    @Call
    async def graph(
        self, map_name: str, job_id: str, kind: GraphFormat = "g2o", *,
        min_overlap: float = 0.0, odometry: bool = False, consistent: bool = True,
    ) -> str:  # fmt: skip
        """Return the pose graph of a successful association as the text of a file.

        Parameters
        ----------
        kind : file format, g2o, tum or json
        min_overlap : smallest overlap of an edge, 0 to 1
        odometry : whether to add an edge between consecutive frames, from their poses
        consistent : whether to return only edges that a second edge of another viewpoint or a join
            supports; unsupported edges include all edges of frames without poses

        Raises
        ------
        UnknownMap, UnknownJob : If the map or job does not exist.
        NotIndexed : If the job has not succeeded.
        InvalidRequest : If the file format is unknown, or the overlap is out of range.
        """
        parameters = {
            "format": kind, "min_overlap": min_overlap, "odometry": odometry,
            "consistent": consistent,
        }  # fmt: skip
        path = f"{product_path(Association, map_name, job_id)}/graph"
        return (await self._bytes(path, params=parameters)).decode()

    @Series
    def coverage_frames(
        self, map_name: str, job_id: str, outcome: CoverageOutcome | None = None
    ) -> AsyncIterator[CoverageFrame]:
        """Yield the query frames of a coverage job, optionally only those with one outcome.

        Raise UnknownMap or UnknownJob if the map or job does not exist.
        """
        path = f"{product_path(MapCoverage, map_name, job_id)}/frames"
        return self._pages(Page[CoverageFrame], path, outcome=outcome)

    @Call
    async def coverage_changes(self, map_name: str, job_id: str, since: str) -> CoverageChanges:
        """Return the cells that became better or worse since an earlier job with the same options.

        Raises
        ------
        UnknownMap, UnknownJob : If the map or one of the jobs does not exist.
        NotIndexed : If one of the jobs has not succeeded.
        InvalidRequest : If the two results cannot be compared.
        """
        path = f"{product_path(MapCoverage, map_name, job_id)}/changes"
        return await self._call(CoverageChanges, "GET", path, params={"since": since})

    @Call
    async def difference_points(self, map_name: str, job_id: str) -> SurfacePoints:
        """Return the cells of both sessions as points. `patches` contains the class of each point:
        SAME, GONE, NEW, UNSEEN_AFTER or UNSEEN_BEFORE of `sceneprint_client.api.sessions`.

        Raises
        ------
        UnknownMap, UnknownJob : If the map or job does not exist.
        NotIndexed : If the job has not succeeded.
        Refused : If the service sends another version of the format.
        """
        from sceneprint_client.surface_encoding import decode_points  # this import loads numpy

        path = f"{product_path(Difference, map_name, job_id)}/points"
        return decode_points(await self._bytes(path))

    @Call
    async def reconstruct(
        self, /, query: str | Answer, *, wait_s: float | None = None, **request: Any
    ) -> Reconstruction:
        """Fuse the accepted matches of an answer into a surface, in the query's camera frame.

        Parameters
        ----------
        query : the answer, or the id of its query
        wait_s : longest wait for the result, seconds; default: no wait
        request : fields of NewReconstruction

        Returns
        -------
        reconstruction : the job, with its `result` if it has succeeded or its `error` if it failed

        Raises
        ------
        UnknownQuery : If the answer is not stored.
        InvalidRequest : If the answer has no accepted match, or lacks a requested match.
        """
        options = checked(NewReconstruction, "The reconstruction", **request)
        query_id = query if isinstance(query, str) else query.query_id
        product = await self._create(
            Reconstruction, f"{query_path(query_id)}/reconstruction", options
        )
        if wait_s is None:
            return product
        return await self.wait_for_product(product, timeout_s=wait_s)

    @Call
    async def reconstruction_mesh(self, job_id: str) -> bytes:
        """Return the surface of a reconstruction as a PLY file.

        Raise UnknownJob if the job does not exist. Raise NotIndexed if the job has not succeeded.
        """
        return await self._bytes(f"{product_path(Reconstruction, None, job_id)}/mesh.ply")


@contextmanager
def _opened(path: Path, kind: type[FrameError]) -> Iterator[BinaryIO]:
    """Open a file for reading; raise an error of type `kind` if it cannot be read."""
    try:
        with path.open("rb") as file:
            yield file
    except OSError as error:
        raise kind(
            f"{path}: The file cannot be read ({error.strerror}). Check its path."
        ) from error


def _map_import_options(options: ImportOptions | None, name: str | None) -> ImportOptions:
    """Return the options of a map import; raise InvalidRequest for those of an archive."""
    if options is None:
        own = {"as": "map"} if name is None else {"as": "map", "name": name[-64:].lstrip(".")}
        return checked(ImportOptions, "The map's name", **own)
    if options.as_ != "map":
        raise InvalidRequest(
            "The options are for an archive. Pass options with `as` = `map`.",
            (("as", "not `map`"),),
        )
    return options
