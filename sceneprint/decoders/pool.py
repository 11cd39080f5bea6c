"""A pool of decoder processes: started when needed, shared fairly, replaced after failures.

    DecoderPool.place  -->  a decoder for one upload  --samples | points-->  arrays

A compromised decoder can send any reply. Replies are therefore JSON and plain arrays, which are
copied from the shared memory before they are checked. The memory is sealed: a decoder that shrank
it would crash the service.
"""

from __future__ import annotations

import fcntl
import json
import logging
import math
import mmap
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneprint import errors
from sceneprint.decoders.child_process import MESSAGE_BYTES, SHARED_BYTES
from sceneprint.decoders.sandbox import Protections
from sceneprint.errors import DecoderFailure
from sceneprint.formats.depth_file import Samples, decode_samples
from sceneprint.formats.points.cloud import FARTHEST_M, ReadPoints
from sceneprint.formats.points.rows import MAXIMUM_POINTS
from sceneprint.turns import ThreadTurns
from sceneprint.types import MAXIMUM_SAMPLES, Floats32
from sceneprint_client.files import MAXIMUM_IMAGE_BYTES
from sceneprint_client.formats import CloudFormat
from sceneprint_client.sidecars import Position, Unsaid

log = logging.getLogger(__name__)

PROGRAM = "sceneprint.decoders.child_process"
#: Formats with compiled readers: their process takes 1 s and 140 MB more.
_COMPILED = ("ply", "pcd")
#: Errors of an upload that a decoder may report.
_ERRORS = {
    one.__name__: one
    for one in (
        errors.UnreadableFrame, errors.UnreadableCloud, errors.UselessFrame,
        errors.InvalidIntrinsics, errors.MissingDependency,
    )
}  # fmt: skip
#: Maximum seconds until a process is ready, which may compile first; seconds between two looks at
#: its processor time; and maximum seconds until an upload gets a decoder.
_BEGIN_S, _LOOK_S, _WAIT_S = 300.0, 0.25, 60.0
#: Maximum ratio of a task's wall time to its limit of processor time, for busy machines.
_PATIENCE = 8
#: Size of a task above which its shared memory is given back, and not erased, bytes.
_KEPT_BYTES = 8 << 20
#: Sizes of glibc up to which a process keeps freed memory: half a decoder's time went into pages
#: that it returned after each image and got back for the next.
_MALLOC = ("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_")
#: Variables that a decoder needs to find its code; others may be secrets.
_ENVIRONMENT = (
    "PATH", "LANG", "LC_ALL", "HOME", "USER", "TMPDIR", "XDG_CACHE_HOME", "PYTHONPATH",
    "PYTHONHOME", "VIRTUAL_ENV", "LD_LIBRARY_PATH", "NUMBA_CACHE_DIR", "NUMBA_CPU_NAME",
    "NUMBA_CPU_FEATURES", "PYTHONDONTWRITEBYTECODE",
)  # fmt: skip


class DecoderEnded(Exception):
    """The process ended; the message says why."""


class DecoderProcess:
    """A decoder process, its socket and its shared memory. It runs one task at a time.

    Parameters
    ----------
    program : module that it runs
    more_bytes : memory that it may allocate for its work, bytes; 0 for no limit
    compiled : whether it loads kernels
    files : descriptors that it may read, which are arguments of the program
    more : arguments after these
    """

    def __init__(
        self,
        program: str,
        more_bytes: int,
        *,
        compiled: bool,
        files: tuple[int, ...] = (),
        more: tuple[str, ...] = (),
    ) -> None:
        self.compiled, self._more_bytes = compiled, more_bytes
        self._sent = self._used = 0  # bytes of the upload, and of the memory that the task used
        self.protections = Protections(no_new_privileges=False, seccomp=False, landlock=0)
        memory = os.memfd_create("sceneprint-decoder", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            os.ftruncate(memory, SHARED_BYTES)
            seals = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL
            fcntl.fcntl(memory, fcntl.F_ADD_SEALS, seals)
            self._shared = mmap.mmap(memory, SHARED_BYTES)
            given = (theirs.fileno(), memory, os.getpid(), more_bytes)
            kind = "kernels" if compiled else "plain"
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", program, *map(str, given), kind, *map(str, files),
                 *more],
                env={name: os.environ[name] for name in _ENVIRONMENT if name in os.environ}
                | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
                | dict.fromkeys(_MALLOC, str(_KEPT_BYTES)),
                pass_fds=(*given[:2], *files), stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )  # fmt: skip
        except BaseException:
            self._socket.close()
            raise
        finally:
            theirs.close()
            os.close(memory)

    @property
    def pid(self) -> int:
        """The process id."""
        return self._process.pid

    def await_ready(self) -> None:
        """Wait until the process is confined; raise DecoderEnded if that fails."""
        reply = self._receive(_BEGIN_S)
        walls = reply.get("ready")
        if not isinstance(walls, dict):
            raise DecoderEnded(str(reply.get("broke", reply))[-2000:])
        self.protections = Protections(
            walls["no_new_privileges"] is True, walls["seccomp"] is True, int(walls["landlock"])
        )

    def run(self, request: dict[str, Any], data: bytes, seconds: float) -> dict[str, Any]:
        """Run a task and return its reply, unchecked; `array_of` returns its arrays.

        Raises
        ------
        DecoderEnded : The process ended during the task.
        DecoderFailure : The task took too long.
        """
        self._sent, self._used = len(data), SHARED_BYTES  # until a reply says how much it wrote
        self._shared[: len(data)] = data
        try:
            self._socket.send(json.dumps({**request, "bytes": len(data)}).encode())
        except OSError as error:
            raise DecoderEnded(self._cause()) from error
        return self._receive(seconds * _PATIENCE, seconds)

    def result(
        self, reply: dict[str, Any], checked: Callable[[DecoderProcess, dict[str, Any]], Any]
    ) -> Any:
        """Return the content of a reply.

        Parameters
        ----------
        reply : a reply of `run`
        checked : checks a reply and returns its result; an error means that the reply is false

        Raises
        ------
        DecoderEnded : The reply is false.
        DecoderFailure : The task needed too much memory.
        FrameError, MissingDependency : The decoder reports an error of the upload.
        """
        if reply.get("memory") is True:
            raise DecoderFailure(
                f"it needs more than {self._more_bytes >> 20} MiB of memory to decode"
            )
        if "broke" in reply:
            text = str(reply["broke"])
            log.error("decoder failed", extra={"pid": self.pid, "traceback": text})
            raise RuntimeError(f"A decoder failed: {text.strip().rpartition(chr(10))[2][:200]}")
        self._used = self._sent
        if "error" in reply:
            raise _error_of(reply)
        try:
            return checked(self, reply)
        except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
            raise DecoderEnded(f"its answer is no result: {str(error)[:80]}") from error

    def array_of(self, kind: str, shape: tuple[int, ...], first: int = 0) -> NDArray[Any]:
        """Return a copy of an array of the reply, which starts at byte `first` of the memory."""
        found = np.frombuffer(self._shared, kind, math.prod(shape), first).copy()
        self._used = max(self._used, first + found.nbytes)
        return found.reshape(shape)

    def clear(self) -> None:
        """Erase the shared memory: the next upload may be another tenant's."""
        if self._used > _KEPT_BYTES:
            self._shared.madvise(mmap.MADV_REMOVE)  # gives the memory back, and reads as zeros
        else:
            self._shared[: self._used] = bytes(self._used)

    def end(self) -> None:
        """Kill the process."""
        self._process.kill()
        self._process.wait()
        self._socket.close()
        with suppress(BufferError):
            self._shared.close()

    def _receive(self, longest_s: float, cpu_s: float = math.inf) -> dict[str, Any]:
        begun, until = self._cpu_s(), time.monotonic() + longest_s
        waiting = select.poll()
        waiting.register(self._socket, select.POLLIN)
        asleep_s = 0.0
        while not waiting.poll(1e3 * _LOOK_S):
            asleep_s = asleep_s + _LOOK_S if self._is_asleep() else 0.0
            if asleep_s > cpu_s:
                raise DecoderFailure(f"its decoder has been idle for {cpu_s:g} s")
            if self._cpu_s() - begun > cpu_s or time.monotonic() > until:
                raise DecoderFailure(f"it takes longer than {cpu_s:g} s to decode")
        try:
            message = self._socket.recv(MESSAGE_BYTES)
        except OSError:
            message = b""
        if not message:
            raise DecoderEnded(self._cause())
        try:
            reply = json.loads(message)
        except (ValueError, RecursionError) as error:
            raise DecoderEnded("its answer is no JSON") from error
        if not isinstance(reply, dict):
            raise DecoderEnded("its answer is no record")
        return reply

    def _cpu_s(self) -> float:
        """Return the processor time of the process, seconds."""
        with suppress(OSError):  # it ended, and the socket will show it
            return time.clock_gettime((~self._process.pid << 3) | 2)
        return 0.0

    def _is_asleep(self) -> bool:
        """Return whether the process waits for neither a processor nor a disk."""
        with suppress(OSError):
            stat = Path(f"/proc/{self._process.pid}/stat").read_text()
            return stat.rpartition(")")[2].split()[0] not in ("R", "D")
        return False

    def _cause(self) -> str:
        code = self._process.wait()
        if code < 0:
            return f"signal {-code}, {signal.strsignal(-code)}"
        return f"exit code {code}"


class _Slot:
    """A place in the pool, with the process that it has; a decoder while an upload holds it."""

    def __init__(self, pool: DecoderPool) -> None:
        self._pool = pool
        self.process: DecoderProcess | None = None

    def samples(self, data: bytes) -> Samples:
        """See Decoder."""
        if len(data) > MAXIMUM_IMAGE_BYTES:  # refused by its length, unread
            return decode_samples(data)

        def checked(process: DecoderProcess, reply: dict[str, Any]) -> Samples:
            kind, shape = reply["type"], _shape(reply, MAXIMUM_SAMPLES)
            if kind not in ("<u2", "<f4"):
                raise ValueError(f"type {kind!r:.40}")
            return process.array_of(kind, shape)

        found: Samples = self.run({"task": "samples"}, data, checked)
        return found

    def points(
        self, data: bytes, file_format: CloudFormat, viewpoint: Position | Unsaid | None,
        units_per_metre: float,
    ) -> ReadPoints:  # fmt: skip
        """See Decoder."""
        told = viewpoint.value if isinstance(viewpoint, Unsaid) else viewpoint
        request = {
            "task": "points", "format": file_format, "viewpoint": told,
            "units_per_metre": units_per_metre,
        }  # fmt: skip

        def checked(process: DecoderProcess, reply: dict[str, Any]) -> ReadPoints:
            shape, given = _shape(reply, 3 * MAXIMUM_POINTS), int(reply["given"])
            if shape[1] != 3 or not shape[0] <= given <= MAXIMUM_POINTS:
                raise ValueError(f"{shape} points of {given}")
            place = reply["viewpoint"]
            if place is not None:
                x, y, z = map(float, place)
                if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
                    raise ValueError("no viewpoint")
                place = x, y, z
            points: Floats32 = process.array_of("<f4", shape)
            # kernels index by them; a comparison with NaN is false
            if len(points) and not (points.min() >= -FARTHEST_M and points.max() <= FARTHEST_M):
                raise ValueError("points beyond reach")
            return ReadPoints(points, place, given)

        read: ReadPoints = self.run(request, data, checked, compiled=file_format in _COMPILED)
        return read

    def run(
        self, request: dict[str, Any], data: bytes,
        checked: Callable[[DecoderProcess, dict[str, Any]], Any], *, compiled: bool = False,
    ) -> Any:  # fmt: skip
        """Run a task, and again in another process if the first one ended, whatever the cause.

        Parameters
        ----------
        request : task and its parameters
        checked : checks a reply and returns its result; an error means that the reply is false
        compiled : whether kernels are needed

        Raises
        ------
        DecoderFailure : The task crashed twice, took too long, or needed too much memory.
        FrameError, MissingDependency : The decoder reports an error of the upload.
        Busy : No process can be started.
        """
        try:
            return self._run(request, data, checked, compiled=compiled)
        except DecoderEnded as first:
            self._pool.note(self, str(first))
            try:
                return self._run(request, data, checked, compiled=compiled)
            except DecoderEnded as again:
                self._pool.note(self, str(again))
                raise DecoderFailure(f"it crashes the decoder ({again})") from again
        except DecoderFailure as error:
            self._pool.note(self, str(error))
            raise

    def end(self) -> None:
        """End the process if there is one."""
        process, self.process = self.process, None
        if process is not None:
            process.end()

    def _run(
        self, request: dict[str, Any], data: bytes,
        checked: Callable[[DecoderProcess, dict[str, Any]], Any], *, compiled: bool,
    ) -> Any:  # fmt: skip
        process = self.process
        if process is None or (compiled and not process.compiled):
            self.end()
            process = self.process = self._pool.begin(compiled=compiled)
        try:
            return process.result(process.run(request, data, self._pool.seconds), checked)
        finally:
            process.clear()


class DecoderPool:
    """Decoders in confined processes; see Decoders. Tenants take turns (`sceneprint.turns`).

    Parameters
    ----------
    count : maximum number of processes
    more_bytes : memory that each may allocate for its work, bytes; 0 for no limit
    seconds : maximum processor time of an upload
    whose : returns the tenant of this thread's request
    program : module that the processes run
    """

    def __init__(
        self, count: int, more_bytes: int, seconds: float, whose: Callable[[], str] = str,
        program: str = PROGRAM,
    ) -> None:  # fmt: skip
        self.more_bytes, self.seconds = more_bytes, seconds
        self._whose, self._program = whose, program
        self._turns = ThreadTurns(count)
        self._free = [_Slot(self) for _ in range(count)]
        self._slots = tuple(self._free)
        self._closed = False
        # a process ends with the thread that started it, so one thread starts all processes
        self._starter = ThreadPoolExecutor(1, "decoder-starter")
        self._compiling = threading.Lock()
        #: Confinement of the processes; None before the first is ready.
        self.protections: Protections | None = None

    @contextmanager
    def place(self) -> Iterator[_Slot]:
        """See Decoders; raise Busy if no decoder becomes free in time."""
        tenant = self._whose()
        if not self._turns.acquire(tenant, _WAIT_S):
            raise errors.Busy(
                f"No decoder is free within {_WAIT_S:g} s. Nothing was stored. Retry in a minute."
            )
        slot = self._free.pop()  # the last one first, so that the others need not be started
        try:
            yield slot
        finally:
            self._free.append(slot)
            self._turns.release(tenant)

    def start(self) -> None:
        """Start one process."""
        with self.place() as slot, suppress(errors.Busy):
            if slot.process is None:
                slot.process = self.begin(compiled=False)

    def pids(self) -> list[int]:
        """Return the ids of the running processes."""
        return [one.process.pid for one in self._slots if one.process is not None]

    def close(self) -> None:
        """End all processes; uploads in progress fail."""
        self._closed = True
        self._turns.close()
        for slot in self._slots:
            slot.end()
        self._starter.shutdown()

    def begin(self, *, compiled: bool) -> DecoderProcess:
        """Start a process and wait until it is ready; raise Busy if that fails."""
        try:
            if self._closed:
                raise DecoderEnded("the service stops")
            begin = self._starter.submit(
                DecoderProcess, self._program, self.more_bytes, compiled=compiled
            )
            process = begin.result()
            try:
                if compiled:  # the first may compile, and the others load the result
                    with self._compiling:
                        process.await_ready()
                else:
                    process.await_ready()
            except BaseException:
                process.end()
                raise
        except (DecoderEnded, DecoderFailure, OSError, RuntimeError) as error:
            log.error("decoder cannot be started", extra={"error": str(error)})
            raise errors.Busy(
                "No decoder can be started for this upload; the service's log says why. Nothing "
                "was stored. Retry in a minute."
            ) from error
        if self.protections is None:
            walls = process.protections
            level = logging.INFO if walls.seccomp else logging.WARNING
            log.log(level, "decoders are confined", extra={"protections": walls.text})
        self.protections = process.protections
        return process

    def note(self, slot: _Slot, reason: str) -> None:
        """Log that a decoder failed, and end it."""
        process = slot.process
        about = {"pid": None if process is None else process.pid, "error": reason}
        log.warning("decoder replaced", extra={**about, "tenant": self._whose()})
        slot.end()


def _shape(reply: dict[str, Any], most: int) -> tuple[int, int]:
    """Return the shape of a two-dimensional array with `most` numbers at most."""
    height, width = reply["shape"]
    if not (type(height) is int and type(width) is int and height >= 0 and width >= 1):
        raise ValueError("no shape")
    if height * width > most:
        raise ValueError(f"shape {height} x {width}")
    return height, width


def _error_of(reply: dict[str, Any]) -> errors.SceneprintError:
    kind = _ERRORS.get(str(reply["error"]))
    if kind is None:
        raise DecoderEnded(f"it raised {str(reply['error'])[:40]!r}")
    text = reply.get("text")
    return kind(text if isinstance(text, str) else "")
