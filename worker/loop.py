"""One worker process: claim, sign, store, again."""

from __future__ import annotations

import logging
import math
import multiprocessing
import os
import random
import time

from sceneprint.engine import Engine
from sceneprint.engine.engine import open_engine
from sceneprint.errors import NewerSchema, SceneprintError, StoreAway
from sceneprint.logs import log_as_json, of_request
from sceneprint.maintenance.scrub import Scrub
from sceneprint.maintenance.snapshot.catalog import LONGEST_S as SNAPSHOT_S
from sceneprint.maintenance.snapshot.catalog import SNAPSHOT, snapshot_handler
from sceneprint.process_limits import StopSignal, limit_memory, raise_descriptors
from sceneprint.settings import Settings
from sceneprint.store.wakeup import Listening, process_name
from worker.crash_traces import Trace

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
    settings : see Settings
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

    try:  # without an end: its place would be given to another that waits
        opened = open_engine(settings, math.inf, may_go_on)
    except StoreAway:
        return
    with opened as engine, engine.bell.listen() as listener:
        engine.warm()
        engine.tasks.register(SNAPSHOT, snapshot_handler(settings), SNAPSHOT_S)
        limit_memory(settings.worker_bytes)
        worker = Worker(engine, listener, trace, stop)
        engine.operations.statistics.began(worker.name)
        log.info("worker ready", extra={"worker": worker.name})
        while not (stop.asked or worker.unsound) and os.getppid() == parent:
            worker.turn()
    log.info("worker stopped", extra={"worker": worker.name})
    if worker.unsound:
        logging.shutdown()
        os._exit(0)  # at once: taking it down in order takes a second, and may crash


class Worker:
    """What one process has at hand.

    Parameters
    ----------
    engine, trace, stop : see there
    listener : of the engine's bell
    """

    def __init__(self, engine: Engine, listener: Listening, trace: Trace, stop: StopSignal) -> None:
        self._engine, self._listener, self._trace, self._stop = engine, listener, trace, stop
        self._scrub = Scrub(engine.settings, engine.store)
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
                self._publish()
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
        claimed = self._engine.claim(self.name)
        if claimed is None:
            return False
        if self._stop.asked:
            self._engine.put_back(claimed)
            return True
        held = claimed.job
        asked = (held.data or {}).get("request_id")
        usual_s = self._engine.settings.job_s
        seconds = self._engine.tasks.longest_s(held.kind, usual_s)
        with of_request(asked), self._trace.job(held.id, held.token, seconds):
            self._engine.run(claimed, self._break)
        return True

    def _break(self) -> None:
        self.unsound = True

    def _publish(self) -> None:
        self._upkeep_at = time.monotonic() + UPKEEP_S  # also where it fails: frames go first
        try:
            self._engine.publish_due()
            self._scrub.run()
        except MemoryError:  # the next process would have no more
            log.error("not enough memory to publish an index; raise SCENEPRINT_WORKER_BYTES")
            self._upkeep_at = time.monotonic() + POOR_S

    def _pause(self) -> float:
        """Seconds until there may be something to do, if nobody rings."""
        due_s = self._engine.due_in_s()
        left = LONGEST_S if due_s is None else min(due_s, LONGEST_S)
        left = min(left, self._upkeep_at - time.monotonic())
        return max(left, SHORTEST_S * random.uniform(1, 2))  # not all workers at the same moment
