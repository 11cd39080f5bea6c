"""Runner of all kinds of jobs."""

from __future__ import annotations

from collections.abc import Callable

from sceneprint.engine.context import Context
from sceneprint.engine.ingest.archive_import import KINDS, Imports
from sceneprint.engine.ingest.map_import import MapImporter
from sceneprint.engine.ingest.recording_import import RecordingImporter
from sceneprint.engine.ingest.uploads import Uploads
from sceneprint.engine.jobs import lifecycle, signature_job
from sceneprint.engine.jobs.lifecycle import Work
from sceneprint.engine.jobs.tasks import Handler, LongJob, Tasks
from sceneprint.engine.maps.surface_job import SURFACE, SurfaceHandler
from sceneprint.engine.products.associations import Associations
from sceneprint.engine.products.map_coverage import Coverages
from sceneprint.engine.products.reconstruction import Reconstructions
from sceneprint.engine.products.session_differences import Differences
from sceneprint.engine.search.query import Queries
from sceneprint.process import work_of
from sceneprint.store import queue
from sceneprint_client.api import JobState


class JobRunner:
    """Runner of the jobs of a store: signing of frames, and slices of long jobs.

    Attributes
    ----------
    handlers : handlers of long jobs, by kind
    """

    def __init__(self, context: Context) -> None:
        uploads, queries = Uploads(context), Queries(context)
        products = (
            Associations(context), Coverages(context, queries), Differences(context),
            Reconstructions(context),
        )  # fmt: skip
        self.handlers: dict[str, Handler] = {
            KINDS["frames"]: Imports(context, uploads).handle,
            KINDS["map"]: MapImporter(context, uploads, queries),
            KINDS["recording"]: RecordingImporter(context, uploads),
            SURFACE: SurfaceHandler(context.store, context.signers),
            **{product.kind: product.run_slice for product in products},
        }
        self._context = context
        self._tasks = Tasks(context.store, context.bell, self.handlers)

    def claim(self, worker: str) -> Work | LongJob | None:
        """Claim the next job; return None if no job is due. See `signature_job.claim`."""
        return signature_job.claim(self._context.store, worker, self._context.settings.job_lease_s)

    def due_in_s(self) -> float | None:
        """Return the seconds until the next queued job is due; None if no job is queued."""
        with self._context.store.database.read() as connection:
            return queue.due_in_s(connection)

    def run(self, work: Work | LongJob, broke: Callable[[], None] | None = None) -> JobState | None:
        """Run a claimed job or a slice of it; return its new state, or None for a lost lease."""
        context, settings = self._context, self._context.settings
        with work_of(work.job.tenant):  # jobs that this job creates belong to the same tenant
            if isinstance(work, LongJob):
                return self._tasks.run(work, settings.job_lease_s, settings.job_timeout_s, broke)
            return signature_job.run(
                context.store, context.signers, context.readers, work, settings.job_lease_s,
                settings.job_timeout_s, broke,
            )  # fmt: skip

    def put_back(self, work: Work | LongJob) -> None:
        """Return a claimed job to the queue, and wake a worker."""
        if isinstance(work, LongJob):
            self._tasks.put_back(work)
        else:
            lifecycle.put_back(self._context.store, work)
        self._context.bell.ring()
