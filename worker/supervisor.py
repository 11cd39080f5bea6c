"""Several worker processes: started, replaced when they end, stopped together."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from multiprocessing.connection import wait
from multiprocessing.context import SpawnProcess
from types import FrameType

from sceneprint.engine.jobs.lifecycle import worker_died
from sceneprint.errors import SceneprintError
from sceneprint.settings import Settings
from sceneprint.store import open_store
from worker.loop import Left, Trace, work

log = logging.getLogger(__name__)

#: Seconds that a frame in hand may take after the signal to stop.
GRACE_S = 20.0
#: Seconds before a worker is replaced that died of no job, so that one that cannot start does
#: not spin.
RESTART_S = 1.0
#: What comes from outside, and says nothing of the job that was in hand.
_FROM_OUTSIDE = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP)


class Post:
    """A worker's place: the process that has it, or the time when another gets it."""

    def __init__(self) -> None:
        self.worker: SpawnProcess | None = None
        self.trace = Trace()
        self.free_at = 0.0

    def end(self) -> tuple[int, int, Left]:
        """Process id, exit code and remains of a worker that is over; the place is free."""
        assert self.worker is not None
        self.worker.join()
        pid, code = self.worker.pid or 0, self.worker.exitcode or 0
        left = self.trace.left()
        self.worker.close()
        self.trace.close()
        self.worker, self.trace, self.free_at = None, Trace(), time.monotonic()
        return pid, code, left


class Supervisor:
    """Keeps a number of workers running, as the settings say."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        # spawned, never forked: a forked child inherits threads' locks and dies in OpenMP
        self._context = multiprocessing.get_context("spawn")
        self._posts: list[Post] = []

    def start(self) -> None:
        """Start all workers."""
        self._posts = [Post() for _ in range(self._settings.workers)]
        for post in self._posts:
            self._fill(post)

    def watch(self, stop: threading.Event) -> None:
        """Replace workers that end until told to stop; then stop them all."""
        try:
            with _readable(stop) as told:
                while not stop.is_set():
                    now = time.monotonic()
                    for post in self._posts:
                        if post.worker is None and post.free_at <= now:
                            self._fill(post)
                    free = [post.free_at - now for post in self._posts if post.worker is None]
                    busy = {post.worker.sentinel: post for post in self._posts if post.worker}
                    for one in wait([told, *busy], min(free, default=None)):
                        if isinstance(one, int) and one in busy:
                            self._replace(busy[one])
        finally:  # also where none can be started: the others are not left behind
            self.stop()

    def stop(self) -> None:
        """Let every worker finish its frame, and end those that do not."""
        posts = [(post, post.worker) for post in self._posts if post.worker is not None]
        for _, worker in posts:
            worker.terminate()
        until = time.monotonic() + GRACE_S
        for post, worker in posts:
            worker.join(max(until - time.monotonic(), 0.1))
            if worker.is_alive():
                log.error("worker does not stop", extra={"pid": worker.pid})
                worker.kill()
            _, code, left = post.end()
            self._report(code, left)
        self._posts = []

    def _fill(self, post: Post) -> None:
        worker = self._context.Process(
            target=work, args=(self._settings, os.getpid(), post.trace), name="sceneprint-worker"
        )
        worker.start()
        post.worker = worker

    def _replace(self, post: Post) -> None:
        pid, code, left = post.end()
        if code == 0:
            log.info("worker replaced", extra={"pid": pid})
        else:
            about = {"pid": pid, "code": code, "job_id": left.job_id}
            log.error("worker died", extra=about)
            if left.job_id is None:
                if left.text:
                    log.error("worker traceback", extra={"pid": pid, "traceback": left.text})
                post.free_at += RESTART_S
                return
        self._fill(post)
        self._report(code, left)

    def _report(self, code: int, left: Left) -> None:
        """Take the job that a dead worker was at, rather than wait for its lease."""
        if left.job_id is None:
            return
        error = _cause(code, left, self._settings.job_timeout_s)
        counts = -code not in _FROM_OUTSIDE
        text = left.text or "It left no traceback."
        try:
            store = open_store(self._settings.database, self._settings.blobs)
            with closing(store):
                worker_died(store, left.job_id, left.token, error, text, counts=counts)
        except SceneprintError as trouble:  # its lease will end it
            log.error("store unreachable", extra={"error": str(trouble)})


def _cause(code: int, left: Left, job_s: float) -> str:
    if left.too_long:
        return f"its worker ran longer than {job_s:g} s and was stopped"
    if code == -signal.SIGKILL:
        return "its worker was killed by signal 9 (possibly out of memory)"
    if code < 0:
        return f"its worker was killed by signal {-code} ({signal.strsignal(-code)})"
    return f"its worker ended with exit code {code}"


@contextmanager
def _readable(event: threading.Event) -> Iterator[int]:
    """A descriptor that is readable once the event is set: what waits for processes waits for it.

    The event is set in the end, by whom ever: the thread that waits for it is not left behind.
    """
    told, tell = os.pipe()

    def pass_on() -> None:
        event.wait()
        os.close(tell)

    passing = threading.Thread(target=pass_on, name="stop", daemon=True)
    passing.start()
    try:
        yield told
    finally:
        if not event.is_set():  # a handler of signals may be about to, and its lock is not its own
            event.set()
        passing.join()
        os.close(told)


def run(settings: Settings) -> None:
    """Keep workers running until SIGINT or SIGTERM."""
    stop = threading.Event()

    def end(_number: int, _frame: FrameType | None) -> None:
        if not stop.is_set():
            stop.set()

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, end)
    supervisor = Supervisor(settings)
    supervisor.start()
    supervisor.watch(stop)
