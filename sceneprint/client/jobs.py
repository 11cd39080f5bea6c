"""What a client can do about jobs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

from sceneprint.client.backend import Backend
from sceneprint.client.waiting import wait_for
from sceneprint.schemas import Job, JobState


class Jobs:
    """The part of a client that lists jobs, gives them up, tries them again, and waits."""

    _backend: Backend

    def job(self, job_id: str) -> Job:
        """A job; UnknownJob where there is none."""
        return self._backend.get_job(job_id)

    def jobs(self, state: JobState | None = None) -> Iterator[Job]:
        """Jobs of all maps, the newest first; those in one state where asked for."""
        page = self._backend.list_jobs(None, state)
        yield from page.items
        while page.next_cursor is not None:
            page = self._backend.list_jobs(page.next_cursor, state)
            yield from page.items

    def cancel_job(self, job_id: str) -> Job:
        """Give up a job that is not over; its frame is `failed` then.

        Raises
        ------
        UnknownJob : there is none.
        JobOver : there is nothing left to give up.
        """
        return self._backend.cancel_job(job_id)

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
        return self._backend.retry_job(job_id)

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
        return wait_for(self._backend, list(job_ids), timeout_s, progress)
