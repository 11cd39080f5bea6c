"""One worker process: claim, sign, store, again; and what it leaves behind when it dies."""

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

#: Shortest pause before another look at a queue that had nothing, and the longest: for jobs
#: that no wakeup announces, such as those that another machine queued.
SHORTEST_S, LONGEST_S = 0.05, 2.0
#: Seconds between two looks at the indexes, and after one for which there was no memory.
UPKEEP_S, POOR_S = 5.0, 300.0
#: A robot that waits for an answer goes before a frame that waits to be signed.
NICENESS = 5
#: Seconds to wait where the database does not answer.
TROUBLE_S = 2.0
#: Seconds between two lines of the log that say that this version may not write any more.
OUTDATED_S = 60.0


def work(settings: Settings, parent: int, trace: Trace) -> None:
    """Work until told to stop, or until the process that started this one is gone.

    SIGTERM and SIGINT let the frame in hand be finished first. An error that nobody raised on
    purpose ends the process too, in good order: the next try has a fresh one.

    Parameters
    ----------
    parent : process id of the one that started this
    trace : for what it reads when this process dies
    """
    log_as_json()
    os.nice(NICENESS)
    raise_descriptors()
    trace.watch()
    stop = StopSignal()

    def may_go_on(seconds: float) -> bool:
        stop.wait(seconds)
        return not stop.asked and os.getppid() == parent

    with ExitStack() as stack:
        try:  # without an end: its place would be given to another that waits
            context = stack.enter_context(open_context(settings, math.inf, may_go_on))
        except StoreAway:
            return
        listener = stack.enter_context(context.bell.listen())
        context.signers.warm()
        limit_memory(settings.worker_memory_bytes)
        worker = Worker(context, listener, trace, stop)
        record_start(context.store, worker.name)
        log.info("worker ready", extra={"worker": worker.name})
        while not (stop.asked or worker.unsound) and os.getppid() == parent:
            worker.turn()
    log.info("worker stopped", extra={"worker": worker.name})
    if worker.unsound:
        logging.shutdown()
        os._exit(0)  # at once: taking it down in order takes a second, and may crash


class Worker:
    """Does the work of one process."""

    def __init__(
        self, context: Context, listener: Listening, trace: Trace, stop: StopSignal
    ) -> None:
        self._job_s = context.settings.job_timeout_s
        self._jobs, self._housekeeping = JobRunner(context), Housekeeping(context)
        self._scrub = Scrub(context.settings, context.store)
        self._listener, self._trace, self._stop = listener, trace, stop
        self.name = process_name()
        self.unsound = False  # an error came that nobody raised on purpose
        # frames first: where publishing kills every worker, each still signs for a while
        self._upkeep_at = time.monotonic() + UPKEEP_S
        starter = multiprocessing.parent_process()
        self._wakers = (stop.descriptor, -1 if starter is None else int(starter.sentinel))

    def turn(self) -> None:
        """Do a job, look after the indexes if it is time, or wait where there is none to do."""
        try:
            found = self._work()
            if time.monotonic() > self._upkeep_at and not self.unsound:
                found = self._publish() or found
            if not found:
                self._listener.wait(self._pause(), *self._wakers)
        except NewerSchema as error:  # nothing but another version can go on
            log.error("store migrated by a later version", extra={"error": str(error)})
            self._stop.wait(OUTDATED_S)
        except SceneprintError as error:
            log.error("store unreachable", extra={"error": str(error)})
            self._stop.wait(TROUBLE_S)

    def _work(self) -> bool:
        """Do a job; whether there was one."""
        claimed = self._jobs.claim(self.name)
        if claimed is None:
            return False
        if self._stop.asked:
            self._jobs.put_back(claimed)
            return True
        held = claimed.job
        asked = held.data or {}
        with of_request(asked.get("request_id")), self._trace.job(held.id, held.token, self._job_s):
            self._jobs.run(claimed, self._break)
        return True

    def _break(self) -> None:
        self.unsound = True

    def _publish(self) -> bool:
        """Look after the indexes, and scrub until somebody rings; whether somebody did."""
        self._upkeep_at = time.monotonic() + UPKEEP_S  # also where it fails: frames go first
        rung = False

        def is_quiet() -> bool:
            nonlocal rung
            rung = self._listener.wait(0.0)
            return not rung

        try:
            self._housekeeping.run()
            self._scrub.run(is_quiet)
        except MemoryError:  # the next process would have no more
            log.error("not enough memory to publish an index; raise SCENEPRINT_WORKER_MEMORY_BYTES")
            self._upkeep_at = time.monotonic() + POOR_S
        return rung

    def _pause(self) -> float:
        """Seconds until there may be something to do, if nobody rings."""
        due_s = self._jobs.due_in_s()
        left = LONGEST_S if due_s is None else min(due_s, LONGEST_S)
        left = min(left, self._upkeep_at - time.monotonic())
        return max(left, SHORTEST_S * random.uniform(1, 2))  # not all workers at the same moment


# The job that a worker was at, and where in the code it was when it died.
#
# A worker that crashes, or hangs in code that never gives the interpreter back, can tell nobody.
# Python's faulthandler still writes its tracebacks, to memory that outlives the process; who
# started the worker reads them there.

#: Bytes of a traceback that are kept, from its end; and the most that its first line has.
KEPT, HEAD = 20_000, 200
#: How faulthandler begins where the time was over.
_TIMEOUT = "Timeout ("


@dataclass(frozen=True)
class Left:
    """What a dead worker left.

    Parameters
    ----------
    job_id, token : of the claim it was at; None where it was at none
    text : traceback of all its threads, or nothing
    """

    job_id: str | None
    token: int
    text: str

    @property
    def too_long(self) -> bool:
        """Whether it was ended as its job took too long."""
        return self.text.startswith(_TIMEOUT)


class Trace:
    """Memory that a worker and who started it share; given to the worker as an argument."""

    def __init__(self) -> None:
        self._descriptor = os.memfd_create("sceneprint-trace")

    def __getstate__(self) -> Any:
        return DupFd(self._descriptor)

    def __setstate__(self, state: Any) -> None:
        self._descriptor = state.detach()

    def watch(self) -> None:
        """Note where this process is when it crashes."""
        faulthandler.enable(self._descriptor)

    @contextmanager
    def job(self, job_id: str, token: int, limit_s: float) -> Iterator[None]:
        """Note which job this process is at; it ends if it takes longer than that."""
        self._begin(f"{job_id} {token}\n")
        # from a thread of C: it needs no turn of the interpreter
        faulthandler.dump_traceback_later(limit_s, exit=True, file=self._descriptor)
        try:
            yield
        except SceneprintError:
            self._end()
            raise
        except BaseException:  # this process ends of it, and the job is still held
            faulthandler.cancel_dump_traceback_later()
            os.write(self._descriptor, traceback.format_exc().encode())
            raise
        self._end()

    def left(self) -> Left:
        """What is written, once the worker is dead."""
        size = os.fstat(self._descriptor).st_size
        head = os.pread(self._descriptor, HEAD, 0).partition(b"\n")[0]
        start = max(len(head) + 1, size - KEPT)
        text = os.pread(self._descriptor, KEPT, start).decode(errors="replace")
        job_id, _, token = head.decode(errors="replace").partition(" ")
        if not token.isdigit():  # it crashed while it was at none
            return Left(None, 0, os.pread(self._descriptor, KEPT, 0).decode(errors="replace"))
        return Left(job_id, int(token), text)

    def close(self) -> None:
        """Give the memory back."""
        os.close(self._descriptor)

    def _begin(self, head: str) -> None:
        os.ftruncate(self._descriptor, 0)
        os.lseek(self._descriptor, 0, os.SEEK_SET)
        os.write(self._descriptor, head.encode())

    def _end(self) -> None:
        faulthandler.cancel_dump_traceback_later()
        self._begin("")
