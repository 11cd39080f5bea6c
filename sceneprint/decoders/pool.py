"""Pool of decoder processes that start on demand, are shared fairly, and are replaced on failure.

    DecoderPool.place  -->  a decoder for one upload  --samples | points-->  arrays

A compromised decoder can send any reply. Replies are therefore JSON and plain arrays, and the pool
copies the arrays from the shared memory before it checks them. The memory is sealed: a decoder that
shrinks it would crash the service.
"""

from __future__ import annotations

import fcntl
import json
import logging
import math
import mmap
import os
import select
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

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
#: Formats with compiled readers. Their processes start 1 s later and use 140 MB more memory.
_COMPILED = ("ply", "pcd")
#: Upload errors that a decoder may report, by name.
_ERRORS = {
    kind.__name__: kind
    for kind in (
        errors.UnreadableFrame, errors.UnreadableCloud, errors.UselessFrame,
        errors.UnreadableArchive, errors.InvalidIntrinsics, errors.MissingDependency,
    )
}  # fmt: skip
#: Seconds: limit for the start of a process, including compilation; interval between checks of its
#: processor time; and limit for the wait of an upload for a decoder.
_BEGIN_S, _LOOK_S, _WAIT_S = 300.0, 0.25, 60.0
#: Maximum wall time of a task on a busy machine, as a multiple of the limit for processor time.
_PATIENCE = 8
#: Maximum size of used shared memory that is overwritten after a task, bytes; more is freed.
_ERASED_BYTES = 8 << 20
#: Settings of glibc. A process retains freed memory up to a maximum size: otherwise, a decoder
#: would spend half of its time on freeing and allocating pages. Freed memory is overwritten, since
#: the next image may be another tenant's.
_MALLOC = {
    "MALLOC_TRIM_THRESHOLD_": f"{_ERASED_BYTES}", "MALLOC_MMAP_THRESHOLD_": f"{_ERASED_BYTES}",
    "MALLOC_PERTURB_": "85",
}  # fmt: skip
#: Environment variables that a decoder needs to find its code. Other variables may contain secrets.
_ENVIRONMENT = (
    "PATH", "LANG", "LC_ALL", "HOME", "USER", "TMPDIR", "XDG_CACHE_HOME", "PYTHONPATH",
    "PYTHONHOME", "VIRTUAL_ENV", "LD_LIBRARY_PATH", "NUMBA_CACHE_DIR", "NUMBA_CPU_NAME",
    "NUMBA_CPU_FEATURES", "PYTHONDONTWRITEBYTECODE",
)  # fmt: skip


@contextmanager
def inheritable(source: BinaryIO) -> Iterator[int]:
    """Yield a file descriptor that a decoder process can inherit, for the content of `source`."""
    with tempfile.TemporaryFile() as copy:
        try:
            descriptor = source.fileno()
        except OSError:  # files of object stores have no descriptor
            shutil.copyfileobj(source, copy)
            copy.flush()
            descriptor = copy.fileno()
        yield descriptor


class DecoderEnded(Exception):
    """A decoder process ended or sent an invalid reply. The message is the cause."""


class DecoderProcess:
    """A decoder process with its socket and shared memory. It runs one task at a time.

    Parameters
    ----------
    program : name of the module that the process runs
    more_bytes : maximum memory that the process may allocate for its work, bytes; 0 for no limit
    compiled : whether the process loads kernels
    files : descriptors of files that the process inherits, passed as arguments to the program
    more : further arguments of the program
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
        self._sent = self._used = 0  # size of the upload, and of the memory that the task used
        self.protections = Protections(no_new_privileges=False, seccomp=False, landlock=0)
        memory = os.memfd_create("sceneprint-decoder", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            os.ftruncate(memory, SHARED_BYTES)
            seals = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL
            fcntl.fcntl(memory, fcntl.F_ADD_SEALS, seals)
            self._shared = mmap.mmap(memory, SHARED_BYTES)
            arguments = (theirs.fileno(), memory, os.getpid(), more_bytes)
            kind = "kernels" if compiled else "plain"
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", program, *map(str, arguments), kind, *map(str, files),
                 *more],
                env={name: os.environ[name] for name in _ENVIRONMENT if name in os.environ}
                | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
                | _MALLOC,
                pass_fds=(*arguments[:2], *files), stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            )  # fmt: skip
        except BaseException:
            self._socket.close()
            raise
        finally:
            theirs.close()
            os.close(memory)

    @property
    def pid(self) -> int:
        """Return the id of the process."""
        return self._process.pid

    def await_ready(self) -> None:
        """Wait until the process is confined; raise DecoderEnded if it fails."""
        reply = self._receive(_BEGIN_S)
        walls = reply.get("ready")
        if not isinstance(walls, dict):
            raise DecoderEnded(str(reply.get("broke", reply))[-2000:])
        self.protections = Protections(
            walls["no_new_privileges"] is True, walls["seccomp"] is True, int(walls["landlock"])
        )

    def run(self, request: dict[str, Any], data: bytes, seconds: float) -> dict[str, Any]:
        """Run a task on an upload; return its reply, an object with unchecked content.

        Parameters
        ----------
        request : name of the task and its parameters
        data : bytes of the upload
        seconds : maximum processor time, and maximum idle time

        Raises
        ------
        DecoderEnded : If the process ends during the task, or the reply is not an object.
        DecoderFailure : If the task exceeds `seconds`, or takes eight times as long in all; the
            process continues.
        """
        self._sent, self._used = len(data), SHARED_BYTES  # upper bound until the reply arrives
        self._shared[: len(data)] = data
        try:
            self._socket.send(json.dumps({**request, "bytes": len(data)}).encode())
        except OSError as error:
            raise DecoderEnded(self._cause()) from error
        return self._receive(seconds * _PATIENCE, seconds)

    def result(
        self, reply: dict[str, Any], checked: Callable[[DecoderProcess, dict[str, Any]], Any]
    ) -> Any:
        """Check a reply, and return its result.

        Parameters
        ----------
        reply : return value of `run`
        checked : function that checks a reply and returns its result; it raises an error for an
            invalid reply

        Raises
        ------
        DecoderEnded : If the reply is invalid.
        DecoderFailure : If the task needs too much memory.
        FrameError, MissingDependency : If the decoder reports an error of the upload.
        RuntimeError : If the task failed with another exception, which is logged.
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
            raise _reported_error(reply)
        try:
            return checked(self, reply)
        except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
            raise DecoderEnded(f"its reply is invalid: {str(error)[:80]}") from error

    def array_of(self, kind: str, shape: tuple[int, ...], first: int = 0) -> NDArray[Any]:
        """Return a copy of an array that starts at byte `first` of the shared memory."""
        array = np.frombuffer(self._shared, kind, math.prod(shape), first).copy()
        self._used = max(self._used, first + array.nbytes)
        return array.reshape(shape)

    def clear(self) -> None:
        """Erase the shared memory: the next upload may be another tenant's."""
        if self._used > _ERASED_BYTES:
            self._shared.madvise(mmap.MADV_REMOVE)  # frees the pages, which then read as zeros
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
        """Wait for a reply; raise DecoderFailure after a timeout, or DecoderEnded."""
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
            raise DecoderEnded("its reply is not JSON") from error
        if not isinstance(reply, dict):
            raise DecoderEnded("its reply is not an object")
        return reply

    def _cpu_s(self) -> float:
        with suppress(OSError):  # if the process has ended, the socket reports it
            return time.clock_gettime((~self._process.pid << 3) | 2)
        return 0.0

    def _is_asleep(self) -> bool:
        """Return whether the process is neither runnable nor waiting for a disk."""
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
    """A place in the pool. It serves one upload at a time, and starts its process on demand."""

    def __init__(self, pool: DecoderPool) -> None:
        self._pool = pool
        self.process: DecoderProcess | None = None

    def samples(self, data: bytes) -> Samples:
        """Return the samples of a depth image; see `decode_samples`."""
        if len(data) > MAXIMUM_IMAGE_BYTES:  # `decode_samples` rejects it without decoding
            return decode_samples(data)

        def checked(process: DecoderProcess, reply: dict[str, Any]) -> Samples:
            kind, shape = reply["type"], _checked_shape(reply, MAXIMUM_SAMPLES)
            if kind not in ("<u2", "<f4"):
                raise ValueError(f"type {kind!r:.40}")
            return process.array_of(kind, shape)

        samples: Samples = self.run({"task": "samples"}, data, checked)
        return samples

    def points(
        self, data: bytes, file_format: CloudFormat, viewpoint: Position | Unsaid | None,
        units_per_metre: float,
    ) -> ReadPoints:  # fmt: skip
        """Return the points of a cloud; see `read_points`."""
        position = viewpoint.value if isinstance(viewpoint, Unsaid) else viewpoint
        request = {
            "task": "points", "format": file_format, "viewpoint": position,
            "units_per_metre": units_per_metre,
        }  # fmt: skip

        def checked(process: DecoderProcess, reply: dict[str, Any]) -> ReadPoints:
            shape = _checked_shape(reply, 3 * MAXIMUM_POINTS)
            file_points = int(reply["file_points"])
            if shape[1] != 3 or not shape[0] <= file_points <= MAXIMUM_POINTS:
                raise ValueError(f"{shape} points of {file_points}")
            place = reply["viewpoint"]
            if place is not None:
                x, y, z = map(float, place)
                if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
                    raise ValueError("the viewpoint is not finite")
                place = x, y, z
            points: Floats32 = process.array_of("<f4", shape)
            # kernels compute indices from points; NaN fails these comparisons too
            if len(points) and not (points.min() >= -FARTHEST_M and points.max() <= FARTHEST_M):
                raise ValueError("a point is too far away")
            return ReadPoints(points, place, file_points)

        read: ReadPoints = self.run(request, data, checked, compiled=file_format in _COMPILED)
        return read

    def run(
        self, request: dict[str, Any], data: bytes,
        checked: Callable[[DecoderProcess, dict[str, Any]], Any], *, compiled: bool = False,
    ) -> Any:  # fmt: skip
        """Run a task; if its process ends, retry once in a new process. Return the checked result.

        Parameters
        ----------
        request : name of the task and its parameters
        data : bytes of the upload
        checked : function that checks a reply and returns its result; it raises an error for an
            invalid reply
        compiled : whether the task needs kernels

        Raises
        ------
        DecoderFailure : If the task crashes twice, takes too long, or needs too much memory.
        FrameError, MissingDependency, RuntimeError : See `DecoderProcess.result`.
        Busy : If no process can be started.
        """
        try:
            return self._run(request, data, checked, compiled=compiled)
        except DecoderEnded as first:
            self._pool.drop_process(self, str(first))
            try:
                return self._run(request, data, checked, compiled=compiled)
            except DecoderEnded as again:
                self._pool.drop_process(self, str(again))
                raise DecoderFailure(f"it crashes the decoder ({again})") from again
        except DecoderFailure as error:
            self._pool.drop_process(self, str(error))
            raise

    def end(self) -> None:
        """Kill the process if one is running."""
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
            process = self.process = self._pool.start_process(compiled=compiled)
        try:
            return process.result(process.run(request, data, self._pool.seconds), checked)
        finally:
            process.clear()


class DecoderPool:
    """Decoders in confined processes, shared fairly among tenants (`sceneprint.turns`).

    Parameters
    ----------
    count : maximum number of processes
    more_bytes : maximum memory that each process may allocate for its work, bytes; 0 for no limit
    seconds : maximum processor time per upload
    whose : function that returns the tenant of the current request
    program : name of the module that the processes run
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
        # a process is killed when the thread that started it ends, so this thread must persist
        self._starter = ThreadPoolExecutor(1, "decoder-starter")
        self._compiling = threading.Lock()
        #: Protections of the processes; None before the first process is ready.
        self.protections: Protections | None = None

    @contextmanager
    def place(self) -> Iterator[_Slot]:
        """Reserve a free decoder; raise Busy if none becomes free in time."""
        tenant = self._whose()
        if not self._turns.acquire(tenant, _WAIT_S):
            raise errors.Busy(
                f"No decoder became free within {_WAIT_S:g} s. Nothing was stored. Retry in a "
                "minute."
            )
        slot = self._free.pop()  # last in, first out: a lightly loaded pool uses few processes
        try:
            yield slot
        finally:
            self._free.append(slot)
            self._turns.release(tenant)

    def start(self) -> None:
        """Start a process in advance."""
        with self.place() as slot, suppress(errors.Busy):
            if slot.process is None:
                slot.process = self.start_process(compiled=False)

    def pids(self) -> list[int]:
        """Return the process ids of the running decoders."""
        return [slot.process.pid for slot in self._slots if slot.process is not None]

    def close(self) -> None:
        """Kill all processes; uploads in progress fail."""
        self._closed = True
        self._turns.close()
        for slot in self._slots:
            slot.end()
        self._starter.shutdown()

    def start_process(self, *, compiled: bool) -> DecoderProcess:
        """Start a process and wait until it is ready; raise Busy if it fails."""
        try:
            if self._closed:
                raise DecoderEnded("the service is stopping")
            starting = self._starter.submit(
                DecoderProcess, self._program, self.more_bytes, compiled=compiled
            )
            process = starting.result()
            try:
                if compiled:  # the first process compiles kernels, and later processes load them
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
                "No decoder can be started for this upload. Nothing was stored. Retry in a minute. "
                "The log of the service shows the cause."
            ) from error
        if self.protections is None:
            walls = process.protections
            level = logging.INFO if walls.seccomp else logging.WARNING
            log.log(level, "decoders are confined", extra={"protections": walls.text})
        self.protections = process.protections
        return process

    def drop_process(self, slot: _Slot, reason: str) -> None:
        """Log the failure of a decoder, and kill its process."""
        process = slot.process
        about = {"pid": None if process is None else process.pid, "error": reason}
        log.warning("decoder replaced", extra={**about, "tenant": self._whose()})
        slot.end()


def _checked_shape(reply: dict[str, Any], most: int) -> tuple[int, int]:
    """Return the shape of a reply's array; raise ValueError if it is invalid or exceeds `most`."""
    height, width = reply["shape"]
    if not (type(height) is int and type(width) is int and height >= 0 and width >= 1):
        raise ValueError("the shape is invalid")
    if height * width > most:
        raise ValueError(f"shape {height} x {width}")
    return height, width


def _reported_error(reply: dict[str, Any]) -> errors.SceneprintError:
    kind = _ERRORS.get(str(reply["error"]))
    if kind is None:
        raise DecoderEnded(f"it raised {str(reply['error'])[:40]!r}")
    text = reply.get("text")
    return kind(text if isinstance(text, str) else "")
