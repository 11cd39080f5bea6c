"""Process set-up: logs, limits, stop signals, secrets, context variables and latency histograms.

A log line is one JSON object on standard error. Secrets may be in files instead of the environment.
The id, tenant and actor of the current request are context variables, which threads inherit.
Latency histograms of several processes can be added.
"""

from __future__ import annotations

import json
import logging
import math
import os
import re
import resource
import select
import signal
import sys
from collections import Counter
from collections.abc import Iterator, Mapping, MutableMapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import FrameType

from sceneprint.errors import InvalidRequest

#: Attributes that every log record has. Others come from `extra` and are written as they are.
_OWN = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime", "color_message"}


_request: ContextVar[str | None] = ContextVar("request", default=None)


def name_request(request_id: str | None) -> None:
    """Set the request id for the log lines of this task and of the threads that it starts."""
    _request.set(request_id)


@contextmanager
def of_request(request_id: str | None) -> Iterator[None]:
    """Set the request id within a `with` block; see `name_request`."""
    before = _request.set(request_id)
    try:
        yield
    finally:
        _request.reset(before)


def request_id() -> str | None:
    """Return the id of the current request; None outside requests."""
    return _request.get()


class JsonFormatter(logging.Formatter):
    """Formats log records as JSON: time, level, logger, message, request, and `extra`."""

    def format(self, record: logging.LogRecord) -> str:
        """Return a record as a line of JSON."""
        line = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            **{key: value for key, value in vars(record).items() if key not in _OWN},
        }
        if request_id() is not None:
            line.setdefault("request_id", request_id())
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)


def log_as_json(level: int = logging.INFO) -> None:
    """Configure all loggers of this process to write JSON lines to standard error."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter())
    logging.basicConfig(level=level, handlers=[handler], force=True)
    logging.captureWarnings(True)
    for name in ("httpx", "httpcore", "alembic", "numba"):
        logging.getLogger(name).setLevel(logging.WARNING)


#: Maximum limit of open files that a process sets for itself; it suffices for any number of maps.
#: Some systems allow a billion, but then programs that close all descriptors one by one start
#: slowly.
MOST = 1 << 20


def raise_descriptors() -> int:
    """Raise the limit of open files to the system's maximum, but at most to MOST; return it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MOST if hard == resource.RLIM_INFINITY else min(hard, MOST)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
        return wanted
    return MOST if soft == resource.RLIM_INFINITY else soft


def limit_memory(more: int) -> None:
    """Limit the memory that this process may allocate from now on; exceeding it raises MemoryError.

    The limit applies to private writable memory, but not to files that are mapped into memory, such
    as tables and indexes.

    Parameters
    ----------
    more : number of bytes; 0 sets no limit
    """
    if more == 0:
        return
    data = re.search(r"^VmData:\s+(\d+) kB", Path("/proc/self/status").read_text(), re.MULTILINE)
    if data is None:
        return
    wanted, (_, most) = int(data[1]) * 1024 + more, resource.getrlimit(resource.RLIMIT_DATA)
    if most != resource.RLIM_INFINITY:
        wanted = min(wanted, most)
    resource.setrlimit(resource.RLIMIT_DATA, (wanted, most))


class StopSignal:
    """A handler for SIGTERM and SIGINT; create a single instance, in the main thread.

    Attributes
    ----------
    requested : whether a signal has arrived
    descriptor : file descriptor that becomes readable when a signal arrives
    """

    def __init__(self) -> None:
        self.requested = False
        self.descriptor, wakeup = os.pipe()
        os.set_blocking(wakeup, False)
        signal.set_wakeup_fd(wakeup, warn_on_full_buffer=False)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._request)

    def wait(self, seconds: float) -> None:
        """Wait until a signal arrives or `seconds` have passed."""
        select.select([self.descriptor], [], [], seconds)

    def _request(self, _number: int, _frame: FrameType | None) -> None:
        self.requested = True


#: Variables that contain secrets. Instead, `NAME_FILE` may contain the path of a file with the
#: secret.
SECRETS = (
    "SCENEPRINT_DATABASE_URL", "PGPASSWORD", "AWS_ACCESS_KEY_ID",
    "AWS_SECRET_ACCESS_KEY", "AZURE_STORAGE_ACCOUNT_KEY",
)  # fmt: skip
#: Maximum size of a file with a secret, bytes.
MOST_BYTES = 16 << 10


def read_secret_files(environment: MutableMapping[str, str]) -> None:
    """Replace each `NAME_FILE` variable with `NAME`, the content of the file without line ends.

    With secrets in files, the initial environment of a process, which other users may see (`docker
    inspect`, `/proc`), contains no secret.

    Raises
    ------
    InvalidRequest : If a file cannot be read or contains no secret, or if both `NAME` and
        `NAME_FILE` are set
    """
    for name in SECRETS:
        path = environment.get(f"{name}_FILE")
        if not path:
            continue
        if environment.get(name):
            raise InvalidRequest(f"{name} and {name}_FILE are both set. Unset one of them.")
        try:
            with Path(path).open("rb") as file:
                data = file.read(MOST_BYTES + 1)
            text = data.decode().rstrip("\r\n")
        except (OSError, UnicodeDecodeError) as error:
            reason = getattr(error, "strerror", None) or "not UTF-8"
            raise InvalidRequest(
                f"{name}_FILE: {path!r:.200} cannot be read ({reason}). Check the path and its "
                "permissions."
            ) from None
        if not text or len(data) > MOST_BYTES or "\n" in text or "\0" in text:
            raise InvalidRequest(
                f"{name}_FILE: {path!r:.200} does not contain a secret. Write one line of text to "
                "the file."
            )
        environment[name] = text
        del environment[f"{name}_FILE"]  # child processes inherit the secret itself


# Histograms of times have the same bins in all processes, so that they can be added. Bin i
# counts times from FIRST_S * STEP^i to FIRST_S * STEP^(i + 1). The error of a quantile is at most 9
# %, half the width of a bin.

#: Lower bound of bin 0, seconds, and ratio of successive bounds.
FIRST_S, STEP = 1e-4, 2.0**0.25
#: Number of bins. The last bin counts all times above FIRST_S * STEP^91, 12 minutes.
BINS = 92


def bin_of(seconds: float) -> int:
    """Return the index of the bin that counts a time."""
    if seconds <= FIRST_S:
        return 0
    return min(int(math.log(seconds / FIRST_S, STEP)), BINS - 1)


def quantile(histogram: Mapping[int, int], share: float) -> float | None:
    """Estimate a quantile of the times in a histogram.

    Parameters
    ----------
    histogram : number of times by bin; empty bins may be missing
    share : order of the quantile: share of the times that do not exceed it, from 0 to 1

    Returns
    -------
    seconds : geometric mean of the bounds of the bin that contains the quantile; None if the
        histogram is empty
    """
    total = sum(histogram.values())
    if total == 0:
        return None
    rank, seen = max(math.ceil(share * total), 1), 0
    for place in sorted(histogram):
        seen += histogram[place]
        if seen >= rank:
            return float(FIRST_S * STEP ** (place + 0.5))
    raise AssertionError("not reached: the sum of all bins reaches every rank")


class Latencies:
    """A histogram of times."""

    def __init__(self) -> None:
        self._bins: Counter[int] = Counter()

    def add(self, seconds: float) -> None:
        """Count a time, seconds."""
        self._bins[bin_of(seconds)] += 1

    def as_json(self) -> dict[str, int]:
        """Return the counts by bin index, for storage as JSON."""
        return {str(place): number for place, number in sorted(self._bins.items())}


def merged(parts: list[Mapping[str, int]]) -> dict[int, int]:
    """Return the sum of stored histograms."""
    total: Counter[int] = Counter()
    for part in parts:
        for place, number in part.items():
            total[int(place)] += int(number)
    return dict(total)


# Each entry of the audit log names the actor of the request or command.

#: Actor of commands that work directly on the data folder. No key may have this name.
COMMAND = "command"


@dataclass(frozen=True)
class Actor:
    """The originator of changes.

    Parameters
    ----------
    name : name of the key; "" if the service requires no keys; COMMAND for a command
    address : address of the client; None for a command
    """

    name: str
    address: str | None = None


_actor: ContextVar[Actor | None] = ContextVar("actor", default=None)


def set_actor(actor: Actor | None) -> None:
    """Set the actor of this task and of the threads that it starts."""
    _actor.set(actor)


@contextmanager
def acting_as(name: str) -> Iterator[None]:
    """Set the actor within a `with` block."""
    before = _actor.set(Actor(name))
    try:
        yield
    finally:
        _actor.reset(before)


def current_actor() -> Actor | None:
    """Return the current actor; None in a worker, which acts for others."""
    return _actor.get()


# The work of a request or job counts towards the limits of a tenant.

#: Tenant of work without a key: commands, upkeep, and requests to a service that requires no keys.
NOBODY = ""

_current: ContextVar[str] = ContextVar("tenant", default=NOBODY)


def set_tenant(name: str) -> None:
    """Set the tenant of this task and of the threads that it starts."""
    _current.set(name)


@contextmanager
def work_of(name: str) -> Iterator[None]:
    """Set the tenant within a `with` block; see `set_tenant`."""
    before = _current.set(name)
    try:
        yield
    finally:
        _current.reset(before)


def current_tenant() -> str:
    """Return the name of the current tenant; NOBODY for work without a key."""
    return _current.get()
