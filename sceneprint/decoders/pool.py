"""Pool of decoder processes that start on demand, are shared fairly, and are replaced on failure.

    DecoderPool.place  -->  a decoder for one upload  --samples | points-->  arrays

A compromised decoder can send any reply. Replies are therefore JSON and plain arrays, and the pool
checks both.
"""

from __future__ import annotations

import json
import logging
import math
import os
import select
import shutil
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext, suppress
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from sceneprint import errors
from sceneprint.decoders.child_process import MESSAGE_BYTES
from sceneprint.errors import DecoderFailure
from sceneprint.formats.depth_file import Samples, decode_samples
from sceneprint.formats.points.cloud import FARTHEST_M, ReadPoints
from sceneprint.formats.points.rows import MAXIMUM_POINTS
from sceneprint.process import current_tenant
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
#: Settings of glibc. A process retains freed memory up to a maximum size: otherwise, a decoder
#: would spend half of its time on freeing and allocating pages. Freed memory is overwritten, since
#: the next image may be another tenant's.
_MALLOC = {
    "MALLOC_TRIM_THRESHOLD_": f"{8 << 20}", "MALLOC_MMAP_THRESHOLD_": f"{8 << 20}",
    "MALLOC_PERTURB_": "85",
}  # fmt: skip
#: Lock of the process that compiles kernels.
_compiling = threading.Lock()
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
    """A decoder process and its socket. It runs one task at a time.

    Parameters
    ----------
    program : name of the module that the process runs
    more_bytes : maximum memory that the process may allocate for its work, bytes; 0 for no limit
    compiled : whether the process loads kernels
    files : descriptors of files that the process inherits, passed as arguments to the program
    more : further arguments of the program
    """

    def __init__(
        self, program: str, more_bytes: int, *, compiled: bool, files: tuple[int, ...] = (),
        more: tuple[str, ...] = (),
    ) -> None:  # fmt: skip
        self.compiled, self._more_bytes, self._until = compiled, more_bytes, 0.0
        #: Whether the process is confined by seccomp; see `close_process`.
        self.seccomp = False
        self._socket, theirs = socket.socketpair()
        kind = "kernels" if compiled else "plain"
        arguments = (theirs.fileno(), os.getpid(), more_bytes, kind, *files, *more)
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", program, *map(str, arguments)],
                env={name: os.environ[name] for name in _ENVIRONMENT if name in os.environ}
                | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
                | _MALLOC,
                pass_fds=(theirs.fileno(), *files), stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            )  # fmt: skip
        except BaseException:
            self._socket.close()
            raise
        finally:
            theirs.close()

    @property
    def pid(self) -> int:
        """Return the id of the process."""
        return self._process.pid

    def await_ready(self) -> None:
        """Wait until the process is confined; raise DecoderEnded if it fails."""
        reply = self._receive(_BEGIN_S)
        if "seccomp" not in reply:
            raise DecoderEnded(str(reply.get("broke", reply))[-2000:])
        self.seccomp = reply["seccomp"] is True

    def run(self, request: dict[str, Any], data: bytes, seconds: float, check: Check) -> Any:
        """Run a task on an upload, and return its checked result; see `ConfinedDecoder.run`.

        Parameters
        ----------
        seconds : maximum processor time, and maximum idle time

        Raises
        ------
        DecoderEnded : If the process ends, or its reply is invalid.
        """
        reply = self.ask(request, data, seconds)
        if reply.get("memory") is True:
            raise DecoderFailure(
                f"it needs more than {self._more_bytes >> 20} MiB of memory to decode"
            )
        if "broke" in reply:
            text = str(reply["broke"])
            log.error("decoder failed", extra={"pid": self.pid, "traceback": text})
            raise RuntimeError(f"A decoder failed: {text.strip().rpartition(chr(10))[2][:200]}")
        if "error" in reply:
            raise _reported_error(reply)
        try:
            return check(self, reply)
        except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
            raise DecoderEnded(f"its reply is invalid: {str(error)[:80]}") from error

    def ask(self, request: dict[str, Any], data: bytes, seconds: float) -> dict[str, Any]:
        """Send a task; return the reply, an object with unchecked content."""
        self._socket.settimeout(seconds * _PATIENCE)
        try:
            self._socket.sendall(json.dumps({**request, "bytes": len(data)}).encode() + b"\n")
            self._socket.sendall(data)
        except OSError as error:
            raise DecoderEnded(self._cause()) from error
        return self._receive(seconds * _PATIENCE, seconds)

    def array_of(self, kind: str, shape: tuple[int, ...]) -> NDArray[Any]:
        """Receive the next array of a reply."""
        return np.frombuffer(self._read(math.prod(shape) * np.dtype(kind).itemsize), kind).reshape(
            shape
        )

    def end(self) -> None:
        """Kill the process."""
        self._process.kill()
        self._process.wait()
        self._socket.close()

    def _receive(self, longest_s: float, cpu_s: float = math.inf) -> dict[str, Any]:
        """Wait for a reply; raise DecoderFailure after a timeout, or DecoderEnded."""
        begun, self._until = self._cpu_s(), time.monotonic() + longest_s
        waiting = select.poll()
        waiting.register(self._socket, select.POLLIN)
        asleep_s = 0.0
        while not waiting.poll(1e3 * _LOOK_S):
            asleep_s = asleep_s + _LOOK_S if self._is_asleep() else 0.0
            if asleep_s > cpu_s:
                raise DecoderFailure(f"its decoder has been idle for {cpu_s:g} s")
            if self._cpu_s() - begun > cpu_s or time.monotonic() > self._until:
                raise DecoderFailure(f"it takes longer than {cpu_s:g} s to decode")
        (size,) = struct.unpack("<I", self._read(4))
        if size > MESSAGE_BYTES:
            raise DecoderEnded("its reply is too long")
        try:
            reply = json.loads(self._read(size))
        except (ValueError, RecursionError) as error:
            raise DecoderEnded("its reply is not JSON") from error
        if not isinstance(reply, dict):
            raise DecoderEnded("its reply is not an object")
        return reply

    def _read(self, size: int) -> bytearray:
        """Receive `size` bytes before the time limit of the task; raise DecoderEnded."""
        data = bytearray(size)
        rest = memoryview(data)
        try:
            while rest:
                self._socket.settimeout(max(self._until - time.monotonic(), _LOOK_S))
                length = self._socket.recv_into(rest)
                if length == 0:
                    raise DecoderEnded(self._cause())
                rest = rest[length:]
        except OSError as error:
            raise DecoderEnded(self._cause()) from error
        return data

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
        self._process.kill()  # it may have closed only the socket; an earlier exit code remains
        code = self._process.wait()
        if code < 0:
            return f"signal {-code}, {signal.strsignal(-code)}"
        return f"exit code {code}"


#: Function that checks a reply, and returns its result. It raises an error for an invalid reply.
Check = Callable[[DecoderProcess, dict[str, Any]], Any]


class ConfinedDecoder:
    """A decoder whose process starts with its first task, and is replaced after a failure.

    Parameters
    ----------
    program, more_bytes, files, more : see `DecoderProcess`
    seconds : maximum processor time of a task
    starter : executor that starts processes; a process is killed when the thread that started it
        ends. None uses the calling thread
    """

    def __init__(
        self, program: str, more_bytes: int, seconds: float, *, files: tuple[int, ...] = (),
        more: tuple[str, ...] = (), starter: ThreadPoolExecutor | None = None,
    ) -> None:  # fmt: skip
        self._spawn = partial(DecoderProcess, program, more_bytes, files=files, more=more)
        self._seconds, self._starter = seconds, starter
        self.process: DecoderProcess | None = None

    def run(
        self, request: dict[str, Any], data: bytes, check: Check, *, compiled: bool = False,
        again: bool = True,
    ) -> Any:  # fmt: skip
        """Run a task; if its process ends, retry once in a new process. Return the checked result.

        Parameters
        ----------
        request : name of the task and its parameters
        data : bytes of the upload
        check : function that checks the reply
        compiled : whether the task needs kernels
        again : whether to retry

        Raises
        ------
        DecoderFailure : If the task crashes twice, takes too long, or needs too much memory.
        FrameError, MissingDependency : If the decoder reports an error of the upload.
        RuntimeError : If the task failed with another exception, which is logged.
        Busy : If no process can be started.
        """
        process = self.process
        if process is None or (compiled and not process.compiled):
            process = self.start(compiled=compiled)
        try:
            return process.run(request, data, self._seconds, check)
        except (DecoderEnded, DecoderFailure) as error:
            about = {"pid": process.pid, "error": str(error), "tenant": current_tenant()}
            log.warning("decoder replaced", extra=about)
            self.end()
            if isinstance(error, DecoderFailure):
                raise
            if not again:
                raise DecoderFailure(f"it crashes the decoder ({error})") from error
        return self.run(request, data, check, compiled=compiled, again=False)

    def start(self, *, compiled: bool) -> DecoderProcess:
        """Start the process and wait until it is ready; raise Busy if it fails."""
        self.end()
        try:
            spawn = partial(self._spawn, compiled=compiled)
            process = spawn() if self._starter is None else self._starter.submit(spawn).result()
            self.process = process
            # the first process compiles kernels, and later processes load them
            with _compiling if compiled else nullcontext():
                process.await_ready()
        except (DecoderEnded, DecoderFailure, OSError, RuntimeError) as error:
            self.end()
            log.error("decoder cannot be started", extra={"error": str(error)})
            raise errors.Busy(
                "No decoder can be started for this upload. Nothing was stored. Retry in a minute. "
                "The log of the service shows the cause."
            ) from error
        level = logging.INFO if process.seccomp else logging.WARNING
        log.log(level, "decoder started", extra={"pid": process.pid, "seccomp": process.seccomp})
        return process

    def end(self) -> None:
        """Kill the process if one is running."""
        process, self.process = self.process, None
        if process is not None:
            process.end()

    def samples(self, data: bytes) -> Samples:
        """Return the samples of a depth image; see `decode_samples`."""
        if len(data) > MAXIMUM_IMAGE_BYTES:  # `decode_samples` rejects it without decoding
            return decode_samples(data)

        def check(process: DecoderProcess, reply: dict[str, Any]) -> Samples:
            kind, shape = reply["type"], _checked_shape(reply, MAXIMUM_SAMPLES)
            if kind not in ("<u2", "<f4"):
                raise ValueError(f"type {kind!r:.40}")
            return process.array_of(kind, shape)

        samples: Samples = self.run({"task": "samples"}, data, check)
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

        def check(process: DecoderProcess, reply: dict[str, Any]) -> ReadPoints:
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

        read: ReadPoints = self.run(request, data, check, compiled=file_format in _COMPILED)
        return read


class DecoderPool:
    """Decoders in confined processes, shared fairly among tenants (`sceneprint.turns`).

    Parameters
    ----------
    count : maximum number of processes
    more_bytes : maximum memory that each process may allocate for its work, bytes; 0 for no limit
    seconds : maximum processor time per upload
    program : name of the module that the processes run
    """

    def __init__(self, count: int, more_bytes: int, seconds: float, program: str = PROGRAM) -> None:
        self._turns = ThreadTurns(count)
        self._starter = ThreadPoolExecutor(1, "decoder-starter")
        self._decoders = tuple(
            ConfinedDecoder(program, more_bytes, seconds, starter=self._starter)
            for _ in range(count)
        )
        self._free = list(self._decoders)

    @contextmanager
    def place(self) -> Iterator[ConfinedDecoder]:
        """Reserve a free decoder; raise Busy if none becomes free in time."""
        tenant = current_tenant()
        if not self._turns.acquire(tenant, _WAIT_S):
            raise errors.Busy(
                f"No decoder became free within {_WAIT_S:g} s. Nothing was stored. Retry in a "
                "minute."
            )
        decoder = self._free.pop()  # last in, first out: a lightly loaded pool uses few processes
        try:
            yield decoder
        finally:
            self._free.append(decoder)
            self._turns.release(tenant)

    def start(self) -> None:
        """Start a process in advance."""
        with self.place() as decoder, suppress(errors.Busy):
            if decoder.process is None:
                decoder.start(compiled=False)

    def processes(self) -> list[DecoderProcess]:
        """Return the running processes."""
        return [each.process for each in self._decoders if each.process is not None]

    def close(self) -> None:
        """Kill all processes; uploads in progress fail."""
        self._starter.shutdown()  # no process starts after this
        self._turns.close()
        for decoder in self._decoders:
            decoder.end()


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
