"""Several worker processes: started, restarted when they die, stopped together."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import threading
import time
from multiprocessing.context import SpawnProcess

from sceneprint.settings import Settings
from worker.loop import work

log = logging.getLogger(__name__)

#: Seconds that a frame in hand may take after the signal to stop.
GRACE_S = 20.0
#: Seconds before a worker that died is replaced, so that one that cannot start does not spin.
RESTART_S = 1.0


class Supervisor:
    """Keeps a number of workers running.

    Parameters
    ----------
    settings : see Settings; `workers` of it are kept
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        # spawned, never forked: a forked child inherits threads' locks and dies in OpenMP
        self._context = multiprocessing.get_context("spawn")
        self._workers: list[SpawnProcess] = []

    def start(self) -> None:
        """Start all workers."""
        self._workers = [self._started() for _ in range(self._settings.workers)]

    def watch(self, stop: threading.Event) -> None:
        """Replace workers that die until told to stop; then stop them all."""
        try:
            while not stop.wait(RESTART_S):
                for place, worker in enumerate(self._workers):
                    if not worker.is_alive():
                        log.error("worker died", extra={"pid": worker.pid, "code": worker.exitcode})
                        worker.close()
                        self._workers[place] = self._started()
        finally:  # also where none can be started: the others are not left behind
            self.stop()

    def stop(self) -> None:
        """Let every worker finish its frame, and end those that do not."""
        for worker in self._workers:
            if worker.is_alive():
                worker.terminate()
        until = time.monotonic() + GRACE_S
        for worker in self._workers:
            worker.join(max(until - time.monotonic(), 0.1))
            if worker.is_alive():
                log.error("worker does not stop", extra={"pid": worker.pid})
                worker.kill()
                worker.join()
        self._workers = []

    def _started(self) -> SpawnProcess:
        worker = self._context.Process(
            target=work, args=(self._settings, os.getpid()), name="sceneprint-worker"
        )
        worker.start()
        return worker


def run(settings: Settings) -> None:
    """Keep workers running until SIGINT or SIGTERM."""
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    supervisor = Supervisor(settings)
    supervisor.start()
    supervisor.watch(stop)
