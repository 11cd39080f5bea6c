"""One worker process: claim, sign, store, again."""

from __future__ import annotations

import logging
import os
import random
import signal
import socket
import threading
import time

from sceneprint.engine import Engine
from sceneprint.errors import SceneprintError
from sceneprint.logs import log_as_json
from sceneprint.settings import Settings

log = logging.getLogger(__name__)

#: Seconds between two looks at an empty queue, and between two looks at the indexes.
IDLE_S, UPKEEP_S = 0.1, 5.0
#: A robot that waits for an answer goes before a frame that waits to be signed.
NICENESS = 5
#: Seconds to wait where the database does not answer.
TROUBLE_S = 2.0


def work(settings: Settings, parent: int) -> None:
    """Work until told to stop, or until the process that started this one is gone.

    SIGTERM and SIGINT let the frame in hand be finished first.

    Parameters
    ----------
    settings : see Settings
    parent : process id of the one that started this
    """
    log_as_json()
    os.nice(NICENESS)
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    with Engine(settings) as engine:
        engine.warm()
        name = f"{socket.gethostname()}:{os.getpid()}"
        log.info("worker ready", extra={"worker": name})
        _loop(engine, name, stop, parent)
    log.info("worker stopped", extra={"worker": name})


def _loop(engine: Engine, name: str, stop: threading.Event, parent: int) -> None:
    looked = 0.0
    while not stop.is_set() and os.getppid() == parent:  # nobody's child is nobody's worker
        try:
            claimed = engine.claim(name)
            if claimed is not None and stop.is_set():
                engine.put_back(claimed)
            elif claimed is not None:
                engine.run(claimed)
            if time.monotonic() - looked > UPKEEP_S:
                looked = time.monotonic()  # also where it fails: frames go first
                engine.publish_due()
            if claimed is None:
                # not all workers at the same moment
                stop.wait(IDLE_S * random.uniform(0.5, 1.5))
        except SceneprintError as error:
            log.error("the store does not answer", extra={"error": str(error)})
            stop.wait(TROUBLE_S)
