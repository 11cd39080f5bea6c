"""A worker process: its loop over jobs, and traces that its parent can read after its death."""

from __future__ import annotations

import faulthandler
import logging
import math
import multiprocessing
import os
import random
import time
import traceback
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from multiprocessing.reduction import DupFd
from typing import Any

from sceneprint.engine.admin.statistics import record_start
from sceneprint.engine.context import Context, open_context
from sceneprint.engine.jobs.job_runner import JobRunner
from sceneprint.engine.upkeep.housekeeping import Housekeeping
from sceneprint.errors import NewerSchema, SceneprintError, StoreAway
from sceneprint.maintenance.scrub import Scrub
from sceneprint.process import StopSignal, limit_memory, log_as_json, of_request, raise_descriptors
from sceneprint.settings import Settings
from sceneprint.store.wakeup import Listening, process_name

log = logging.getLogger(__name__)

#: Minimum and maximum pause between reads of an empty queue, seconds; wake-ups usually end the
#: pause early.
SHORTEST_S, LONGEST_S = 0.05, 2.0
#: Interval between runs of housekeeping, and pause after a lack of memory, seconds.
UPKEEP_S, POOR_S = 5.0, 300.0
#: Niceness of the process, since queries have precedence over signing.
NICENESS = 5
#: Pause after an error of the database, seconds.
TROUBLE_S = 2.0
#: Interval of log lines that report a newer schema, seconds.
OUTDATED_S = 60.0


def work(settings: Settings, parent: int, trace: Trace) -> None:
    """Run jobs until a signal arrives, the parent process has ended, or an unexpected error occurs.

    After SIGTERM or SIGINT, the current frame is finished first.

    Parameters
    ----------
    parent : process id of the parent
    trace : memory that the parent reads after this process has died
    """
    log_as_json()
    os.nice(NICENESS)
    raise_descriptors()
    trace.watch()
    stop = StopSignal()

    def should_continue(seconds: float) -> bool:
        stop.wait(seconds)
        return not stop.requested and os.getppid() == parent

    with ExitStack() as stack:
        try:  # wait without a limit, since a replacement would have to wait too
            context = stack.enter_context(open_context(settings, math.inf, should_continue))
        except StoreAway:
            return
        listener = stack.enter_context(context.bell.listen())
        context.signers.warm()
        limit_memory(settings.worker_memory_bytes)
        worker = Worker(context, listener, trace, stop)
        record_start(context.store, worker.name)
        log.info("worker ready", extra={"worker": worker.name})
        while not (stop.requested or worker.unsound) and os.getppid() == parent:
            worker.turn()
    log.info("worker stopped", extra={"worker": worker.name})
    if worker.unsound:
        logging.shutdown()
        os._exit(0)  # a regular exit takes a second and may crash


class Worker:
    """The loop of a worker process."""

    def __init__(
        self, context: Context, listener: Listening, trace: Trace, stop: StopSignal
    ) -> None:
        self._job_s = context.settings.job_timeout_s
        self._jobs, self._housekeeping = JobRunner(context), Housekeeping(context)
        self._scrub = Scrub(context.settings, context.store)
        self._listener, self._trace, self._stop = listener, trace, stop
        self.name = process_name()
        self.unsound = False  # whether an unexpected error has occurred
        # Sign first, so that each worker signs some frames even if housekeeping kills it.
        self._upkeep_at = time.monotonic() + UPKEEP_S
        starter = multiprocessing.parent_process()
        self._wakers = (stop.descriptor, -1 if starter is None else int(starter.sentinel))

    def turn(self) -> None:
        """Run a job, and housekeeping if it is due; without either, wait for a job.

        Log errors of the store, and pause after them.
        """
        try:
            was_busy = self._work()
            if time.monotonic() > self._upkeep_at and not self.unsound:
                was_busy = self._run_upkeep() or was_busy
            if not was_busy:
                self._listener.wait(self._pause(), *self._wakers)
        except NewerSchema as error:
            log.error("store migrated by a later version", extra={"error": str(error)})
            self._stop.wait(OUTDATED_S)
        except SceneprintError as error:
            log.error("store unreachable", extra={"error": str(error)})
            self._stop.wait(TROUBLE_S)

    def _work(self) -> bool:
        """Run a job; return whether there was one."""
        claimed = self._jobs.claim(self.name)
        if claimed is None:
            return False
        if self._stop.requested:
            self._jobs.put_back(claimed)
            return True
        held = claimed.job
        data, limit_s = held.data or {}, self._job_s
        with of_request(data.get("request_id")), self._trace.job(held.id, held.token, limit_s):
            self._jobs.run(claimed, self._mark_unsound)
        return True

    def _mark_unsound(self) -> None:
        self.unsound = True

    def _run_upkeep(self) -> bool:
        """Run housekeeping and the scrub until a wake-up; return whether there was one."""
        self._upkeep_at = time.monotonic() + UPKEEP_S  # set it first, in case housekeeping fails
        woken = False

        def is_quiet() -> bool:
            nonlocal woken
            woken = self._listener.wait(0.0)
            return not woken

        try:
            self._housekeeping.run()
            self._scrub.run(is_quiet)
        except MemoryError:  # a new process would not have more memory
            log.error("not enough memory to publish an index; raise SCENEPRINT_WORKER_MEMORY_BYTES")
            self._upkeep_at = time.monotonic() + POOR_S
        return woken

    def _pause(self) -> float:
        """Return the maximum seconds to wait for a wake-up."""
        due_s = self._jobs.due_in_s()
        pause_s = LONGEST_S if due_s is None else min(due_s, LONGEST_S)
        pause_s = min(pause_s, self._upkeep_at - time.monotonic())
        return max(pause_s, SHORTEST_S * random.uniform(1, 2))  # spread the reads of workers


# Traces: the current job of a worker, and the traceback of its death.
#
# A worker that crashes, or hangs in code that never releases the interpreter lock, cannot report
# it. The faulthandler of Python then writes tracebacks to shared memory, which the parent reads.

#: Maximum number of bytes from the end of a traceback, and of the head, which names the job.
TAIL, HEAD = 20_000, 200
#: Prefix of the output of faulthandler after a timeout.
_TIMEOUT = "Timeout ("


@dataclass(frozen=True)
class WorkerTrace:
    """The trace of a dead worker.

    Parameters
    ----------
    job_id, token : claim of the current job; None and 0 without a job
    text : traceback of all threads, or ""
    """

    job_id: str | None
    token: int
    text: str

    @property
    def timed_out(self) -> bool:
        """Return whether the worker ended because its job exceeded the time limit."""
        return self.text.startswith(_TIMEOUT)


class Trace:
    """Memory that a worker shares with its parent; it is passed to the worker as an argument."""

    def __init__(self) -> None:
        self._descriptor = os.memfd_create("sceneprint-trace")

    def __getstate__(self) -> Any:
        return DupFd(self._descriptor)

    def __setstate__(self, state: Any) -> None:
        self._descriptor = state.detach()

    def watch(self) -> None:
        """Write a traceback if this process crashes."""
        faulthandler.enable(self._descriptor)

    @contextmanager
    def job(self, job_id: str, token: int, limit_s: float) -> Iterator[None]:
        """Record the current job; the process ends if the job exceeds `limit_s`."""
        self._begin(f"{job_id} {token}\n")
        # The timer runs in a C thread, which does not need the interpreter lock.
        faulthandler.dump_traceback_later(limit_s, exit=True, file=self._descriptor)
        try:
            yield
        except SceneprintError:
            self._end()
            raise
        except BaseException:  # leave the record: the process ends with the job claimed
            faulthandler.cancel_dump_traceback_later()
            os.write(self._descriptor, traceback.format_exc().encode())
            raise
        self._end()

    def read(self) -> WorkerTrace:
        """Return the trace after the worker has died."""
        size = os.fstat(self._descriptor).st_size
        head = os.pread(self._descriptor, HEAD, 0).partition(b"\n")[0]
        start = max(len(head) + 1, size - TAIL)
        text = os.pread(self._descriptor, TAIL, start).decode(errors="replace")
        job_id, _, token = head.decode(errors="replace").partition(" ")
        if not token.isdigit():  # the worker crashed without a job
            text = os.pread(self._descriptor, TAIL, 0).decode(errors="replace")
            return WorkerTrace(None, 0, text)
        return WorkerTrace(job_id, int(token), text)

    def close(self) -> None:
        """Release the memory."""
        os.close(self._descriptor)

    def _begin(self, head: str) -> None:
        os.ftruncate(self._descriptor, 0)
        os.lseek(self._descriptor, 0, os.SEEK_SET)
        os.write(self._descriptor, head.encode())

    def _end(self) -> None:
        faulthandler.cancel_dump_traceback_later()
        self._begin("")
