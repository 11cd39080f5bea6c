"""Supervisor of worker processes: it starts, replaces and stops them."""

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
from worker.loop import Trace, WorkerTrace, work

log = logging.getLogger(__name__)

#: Seconds that workers have to finish the current frame after the signal to stop.
GRACE_S = 20.0
#: Seconds before a worker that died without a job is replaced, in case it cannot start.
RESTART_S = 1.0
#: Signals that other processes send, which the current job does not cause.
_FROM_OUTSIDE = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP)


class Slot:
    """A slot of the supervisor: a worker process, or the earliest time of its replacement."""

    def __init__(self) -> None:
        self.worker: SpawnProcess | None = None
        self.trace = Trace()
        self.free_at = 0.0

    def end(self) -> tuple[int, int, WorkerTrace]:
        """Free the slot of an ended worker; return its process id, exit code and trace."""
        assert self.worker is not None
        self.worker.join()
        pid, code = self.worker.pid or 0, self.worker.exitcode or 0
        trace = self.trace.read()
        self.worker.close()
        self.trace.close()
        self.worker, self.trace, self.free_at = None, Trace(), time.monotonic()
        return pid, code, trace


class Supervisor:
    """A group of a constant number of worker processes."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        # Forked processes would inherit locks of threads, and crash in OpenMP.
        self._context = multiprocessing.get_context("spawn")
        self._slots: list[Slot] = []

    def start(self) -> None:
        """Start all workers."""
        self._slots = [Slot() for _ in range(self._settings.workers)]
        for slot in self._slots:
            self._start_worker(slot)

    def watch(self, stop: threading.Event) -> None:
        """Replace workers that end until `stop` is set; then stop all workers."""
        try:
            with _readable(stop) as stopped:
                while not stop.is_set():
                    now = time.monotonic()
                    for slot in self._slots:
                        if slot.worker is None and slot.free_at <= now:
                            self._start_worker(slot)
                    free = [slot.free_at - now for slot in self._slots if slot.worker is None]
                    busy = {slot.worker.sentinel: slot for slot in self._slots if slot.worker}
                    for ready in wait([stopped, *busy], min(free, default=None)):
                        if isinstance(ready, int) and ready in busy:
                            self._replace(busy[ready])
        finally:  # even if a worker cannot start
            self.stop()

    def stop(self) -> None:
        """Let all workers finish their frames, and kill those that take longer than GRACE_S."""
        slots = [(slot, slot.worker) for slot in self._slots if slot.worker is not None]
        for _, worker in slots:
            worker.terminate()
        until = time.monotonic() + GRACE_S
        for slot, worker in slots:
            worker.join(max(until - time.monotonic(), 0.1))
            if worker.is_alive():
                log.error("worker does not stop", extra={"pid": worker.pid})
                worker.kill()
            _, code, trace = slot.end()
            self._report(code, trace)
        self._slots = []

    def _start_worker(self, slot: Slot) -> None:
        worker = self._context.Process(
            target=work, args=(self._settings, os.getpid(), slot.trace), name="sceneprint-worker"
        )
        worker.start()
        slot.worker = worker

    def _replace(self, slot: Slot) -> None:
        """Replace an ended worker, later if it died without a job, and release the job that it
        held.
        """
        pid, code, trace = slot.end()
        if code == 0:
            log.info("worker replaced", extra={"pid": pid})
        else:
            about = {"pid": pid, "code": code, "job_id": trace.job_id}
            log.error("worker died", extra=about)
            if trace.job_id is None:
                if trace.text:
                    log.error("worker traceback", extra={"pid": pid, "traceback": trace.text})
                slot.free_at += RESTART_S
                return
        self._start_worker(slot)
        self._report(code, trace)

    def _report(self, code: int, trace: WorkerTrace) -> None:
        """Release the job of a dead worker, instead of waiting for the end of its lease."""
        if trace.job_id is None:
            return
        error = _cause(code, trace, self._settings.job_timeout_s)
        counts = -code not in _FROM_OUTSIDE
        text = trace.text or "It left no traceback."
        try:
            store = open_store(self._settings.database, self._settings.blobs)
            with closing(store):
                worker_died(store, trace.job_id, trace.token, error, text, counts=counts)
        except SceneprintError as trouble:  # the job waits for the end of its lease
            log.error("store unreachable", extra={"error": str(trouble)})


def _cause(code: int, trace: WorkerTrace, job_s: float) -> str:
    if trace.timed_out:
        return (
            f"its worker exceeded {job_s:g} s and was stopped. If the machine is slow or busy, "
            "raise SCENEPRINT_JOB_TIMEOUT_S and restart."
        )
    if code == -signal.SIGKILL:
        return "its worker was killed by signal 9 (possibly out of memory)"
    if code < 0:
        return f"its worker was killed by signal {-code} ({signal.strsignal(-code)})"
    return f"its worker ended with exit code {code}"


@contextmanager
def _readable(event: threading.Event) -> Iterator[int]:
    """Yield a descriptor that becomes readable once an event is set, to wait for it together with
    processes. The event is always set at the end.
    """
    reader, writer = os.pipe()

    def pass_on() -> None:
        event.wait()
        os.close(writer)

    thread = threading.Thread(target=pass_on, name="stop", daemon=True)
    thread.start()
    try:
        yield reader
    finally:
        if not event.is_set():  # the lock of the event is not reentrant in signal handlers
            event.set()
        thread.join()
        os.close(reader)


def run(settings: Settings) -> None:
    """Run workers until SIGINT or SIGTERM."""
    stop = threading.Event()

    def end(_number: int, _frame: FrameType | None) -> None:
        if not stop.is_set():
            stop.set()

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, end)
    supervisor = Supervisor(settings)
    supervisor.start()
    supervisor.watch(stop)
