"""A service of one's own for as long as it is needed, in processes of its own."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from selectors import EVENT_READ, DefaultSelector
from typing import IO

from sceneprint.errors import Unreachable

#: Seconds that the service may take to start, on a machine that compiles first, and to stop.
START_S, STOP_S = 120.0, 30.0
_READY = "sceneprint: serving "


@contextmanager
def serving(data: Path, workers: int) -> Iterator[str]:
    """Run `sceneprint serve` on a free loopback port; it is gone when this ends.

    Parameters
    ----------
    data : folder for database and blobs; its log goes there too
    workers : processes that sign

    Yields
    ------
    url : of the service, which answers

    Raises
    ------
    Unreachable : it did not start; says what it said.
    """
    log = data / "service.log"
    arguments = ["--port", "0", "--data", str(data), "--workers", str(workers)]
    with log.open("wb") as errors:
        process = subprocess.Popen(
            [sys.executable, "-m", "sceneprint", "serve", *arguments],
            stdout=subprocess.PIPE,
            stderr=errors,
            bufsize=0,
        )
    try:
        line = "" if process.stdout is None else _first_line(process.stdout)
        if not line.startswith(_READY):
            last = log.read_text(errors="replace").strip().splitlines()[-1:]
            raise Unreachable(
                f"The service did not start: {' '.join(last) or 'it said nothing'}. "
                "Run `sceneprint doctor` to see what is missing."
            )
        yield line.removeprefix(_READY).strip()
    finally:
        process.terminate()
        try:
            with suppress(subprocess.TimeoutExpired):
                process.wait(STOP_S)
        finally:  # also where Ctrl-C ends the wait
            process.kill()
            process.wait()
            if process.stdout is not None:
                process.stdout.close()


def _first_line(pipe: IO[bytes]) -> str:
    """The first line; what there is of it where the other end is closed.

    Raises
    ------
    Unreachable : none came in time.
    """
    got, until = b"", time.monotonic() + START_S
    with DefaultSelector() as selector:
        selector.register(pipe, EVENT_READ)
        while b"\n" not in got:
            if not selector.select(max(until - time.monotonic(), 0.0)):
                raise Unreachable(
                    f"The service did not start within {START_S:g} s. "
                    "Run `sceneprint doctor` to see what is missing, or try again."
                )
            more = os.read(pipe.fileno(), 4096)  # what is there: never waits for a whole line
            if not more:
                break
            got += more
    return got.partition(b"\n")[0].decode(errors="replace")
