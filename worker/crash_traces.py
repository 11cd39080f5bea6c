"""What a worker leaves behind: the job it was at, and where in the code it was when it died.

A worker that crashes, or hangs in code that never gives the interpreter back, can tell nobody.
Python's faulthandler still writes its tracebacks, to memory that outlives the process; who
started the worker reads them there.
"""

from __future__ import annotations

import faulthandler
import os
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.reduction import DupFd
from typing import Any

from sceneprint.errors import SceneprintError

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
