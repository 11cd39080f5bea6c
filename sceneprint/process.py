"""What a process sets up when it starts, and what it says of its work.

Log lines, limits, stop signals, and secrets out of files: a log line is one JSON object on standard
error, and container engines hand secrets over in files, in place of the environment.

What is known of the current request goes with it into threads: its id, its tenant and its actor.

Times are counted in histograms, which add up over processes.
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

#: What every record has; the rest was given with `extra` and is written as it is.
_OWN = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime", "color_message"}


_request: ContextVar[str | None] = ContextVar("request", default=None)


def name_request(request_id: str | None) -> None:
    """Name the request in all that this task, and the threads it begins, log from now on."""
    _request.set(request_id)


@contextmanager
def of_request(request_id: str | None) -> Iterator[None]:
    """Name the request in all that is logged meanwhile, here and in threads begun here."""
    before = _request.set(request_id)
    try:
        yield
    finally:
        _request.reset(before)


def request_id() -> str | None:
    """Id of the request that is worked on, if there is any."""
    return _request.get()


class JsonFormatter(logging.Formatter):
    """A record as one line: time, level, logger, message, request, and what `extra` gave."""

    def format(self, record: logging.LogRecord) -> str:
        """The line."""
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
    """Let all loggers of this process write JSON lines to standard error."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter())
    logging.basicConfig(level=level, handlers=[handler], force=True)
    logging.captureWarnings(True)
    for name in ("httpx", "httpcore", "alembic", "numba"):
        logging.getLogger(name).setLevel(logging.WARNING)


# Open files.

#: Enough for any number of maps; some systems allow a billion, and programs that close them all
#: one by one then take minutes to start.
MOST = 1 << 20


def raise_descriptors() -> int:
    """Let this process have as many files open as the system lets it; returns how many."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MOST if hard == resource.RLIM_INFINITY else min(hard, MOST)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
        return wanted
    return MOST if soft == resource.RLIM_INFINITY else soft


# What a worker process may take, and how it is told to stop.


def limit_memory(more: int) -> None:
    """Let this process take so many bytes more than it has; what needs more raises MemoryError.

    Counted is what it writes to itself, on the heap or not: tables and indexes are mapped from
    files, and cost nobody anything.

    Parameters
    ----------
    more : bytes; 0 for no limit
    """
    if more == 0:
        return
    found = re.search(r"^VmData:\s+(\d+) kB", Path("/proc/self/status").read_text(), re.MULTILINE)
    if found is None:
        return
    wanted, (_, most) = int(found[1]) * 1024 + more, resource.getrlimit(resource.RLIMIT_DATA)
    if most != resource.RLIM_INFINITY:
        wanted = min(wanted, most)
    resource.setrlimit(resource.RLIMIT_DATA, (wanted, most))


class StopSignal:
    """Whether SIGTERM or SIGINT has come; made once, in the main thread.

    Attributes
    ----------
    asked : whether one has
    descriptor : readable from then on
    """

    def __init__(self) -> None:
        self.asked = False
        self.descriptor, told = os.pipe()
        os.set_blocking(told, False)
        signal.set_wakeup_fd(told, warn_on_full_buffer=False)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._ask)

    def wait(self, seconds: float) -> None:
        """Until one has come, or the time is over."""
        select.select([self.descriptor], [], [], seconds)

    def _ask(self, _number: int, _frame: FrameType | None) -> None:
        self.asked = True


#: Variables that hold a secret; the variable with `_FILE` at its end names a file instead.
SECRETS = (
    "SCENEPRINT_DATABASE_URL", "PGPASSWORD", "AWS_ACCESS_KEY_ID",
    "AWS_SECRET_ACCESS_KEY", "AZURE_STORAGE_ACCOUNT_KEY",
)  # fmt: skip
#: A secret is one line; a larger file is another one.
MOST_BYTES = 16 << 10


def read_secret_files(environment: MutableMapping[str, str]) -> None:
    """Set each secret whose file is named; line ends after it do not belong to it.

    The environment that a process was started with, which others may see (`docker inspect`,
    `/proc`), then holds no secret.

    Raises
    ------
    InvalidRequest : a file that cannot be read, is empty or is none of a secret; or both are set.
    """
    for name in SECRETS:
        given = environment.get(f"{name}_FILE")
        if not given:
            continue
        if environment.get(name):
            raise InvalidRequest(f"{name} and {name}_FILE are both set. Unset one of them.")
        try:
            with Path(given).open("rb") as file:
                data = file.read(MOST_BYTES + 1)
            text = data.decode().rstrip("\r\n")
        except (OSError, UnicodeDecodeError) as error:
            reason = getattr(error, "strerror", None) or "it is not UTF-8"
            raise InvalidRequest(
                f"{name}_FILE: {given!r:.200} cannot be read ({reason}). Check the path and its "
                "permissions."
            ) from None
        if not text or len(data) > MOST_BYTES or "\n" in text or "\0" in text:
            raise InvalidRequest(
                f"{name}_FILE: {given!r:.200} does not hold a secret, which is one line of text. "
                "Check its content."
            )
        environment[name] = text
        del environment[f"{name}_FILE"]  # processes that are started from here have it already


# Times of many answers in a few numbers that can be added up: a histogram of fixed bounds.
#
# Bin i holds what took from FIRST_S * STEP^i up to STEP times that. The bounds are the same in
# every
# process, so that the histograms of several add to that of all, and a quantile of the sum is that
# of all answers, but for the width of a bin: it is wrong by 9 % at most.

#: Lower bound of bin 0, seconds, and how much wider each bin reaches than the one before.
FIRST_S, STEP = 1e-4, 2.0**0.25
#: Bins: what takes longer than FIRST_S STEP^91, 12 minutes, is in the last one.
BINS = 92


def bin_of(seconds: float) -> int:
    """The bin of a time."""
    if seconds <= FIRST_S:
        return 0
    return min(int(math.log(seconds / FIRST_S, STEP)), BINS - 1)


def quantile(histogram: Mapping[int, int], share: float) -> float | None:
    """The time that this share of all answers did not take longer than.

    Parameters
    ----------
    histogram : number of answers in each bin that has any
    share : from 0 to 1

    Returns
    -------
    seconds, the geometric middle of the bin; None where there were no answers
    """
    total = sum(histogram.values())
    if total == 0:
        return None
    rank, seen = max(math.ceil(share * total), 1), 0
    for place in sorted(histogram):
        seen += histogram[place]
        if seen >= rank:
            return float(FIRST_S * STEP ** (place + 0.5))
    raise AssertionError("the ranks of all bins are their sum")


class Latencies:
    """A histogram that grows."""

    def __init__(self) -> None:
        self._bins: Counter[int] = Counter()

    def add(self, seconds: float) -> None:
        """Count an answer."""
        self._bins[bin_of(seconds)] += 1

    def as_json(self) -> dict[str, int]:
        """As it is stored."""
        return {str(place): number for place, number in sorted(self._bins.items())}


def merged(parts: list[Mapping[str, int]]) -> dict[int, int]:
    """Several stored histograms as one."""
    total: Counter[int] = Counter()
    for part in parts:
        for place, number in part.items():
            total[int(place)] += int(number)
    return dict(total)


# Who makes changes: set for a request or a command, and written to the audit log with each change.

#: Name of the actor of a command on the data folder; no key may have it.
COMMAND = "command"


@dataclass(frozen=True)
class Actor:
    """Who makes changes.

    Parameters
    ----------
    name : of the key; "" where the service requires none; COMMAND of a command
    address : of the client's connection; None of a command
    """

    name: str
    address: str | None = None


_actor: ContextVar[Actor | None] = ContextVar("actor", default=None)


def set_actor(actor: Actor | None) -> None:
    """Set who makes the changes of this task, and of the threads it begins."""
    _actor.set(actor)


@contextmanager
def acting_as(name: str) -> Iterator[None]:
    """Make the changes of the block as this actor."""
    before = _actor.set(Actor(name))
    try:
        yield
    finally:
        _actor.reset(before)


def current_actor() -> Actor | None:
    """Return who makes changes; None of a worker, which carries out what somebody else started."""
    return _actor.get()


# Whose work this is: set once for a request or a job, known wherever it is charged.

#: The tenant of work that no key asked for: commands, upkeep, a service that asks for no keys.
NOBODY = ""

_current: ContextVar[str] = ContextVar("tenant", default=NOBODY)


def set_tenant(name: str) -> None:
    """Charge what this task, and the threads it begins, does from now on to a tenant."""
    _current.set(name)


@contextmanager
def work_of(name: str) -> Iterator[None]:
    """Charge what is done meanwhile, here and in threads begun here, to a tenant."""
    before = _current.set(name)
    try:
        yield
    finally:
        _current.reset(before)


def current_tenant() -> str:
    """Name of the tenant whose work is being done; NOBODY where no key asked for it."""
    return _current.get()
