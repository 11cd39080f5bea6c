"""A service of one's own for as long as it is needed, in processes of its own."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from sceneprint.errors import Unreachable

#: Seconds that the service may take to stop.
STOP_S = 30.0
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
            text=True,
        )
    try:
        line = "" if process.stdout is None else process.stdout.readline()
        if not line.startswith(_READY):
            last = log.read_text(errors="replace").strip().splitlines()[-1:]
            raise Unreachable(
                f"The service did not start: {' '.join(last) or 'it said nothing'}. "
                "Run `sceneprint doctor` to see what is missing."
            )
        yield line.removeprefix(_READY).strip()
    finally:
        process.terminate()
        with suppress(subprocess.TimeoutExpired):
            process.wait(STOP_S)
        process.kill()
        process.wait()
        if process.stdout is not None:
            process.stdout.close()
