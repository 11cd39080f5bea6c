"""What a process sets up when it starts: log lines, limits, stop signals, and secrets out of files.

A log line is one JSON object on standard error. Each mapped segment of an index takes a descriptor.
Container engines hand secrets over in files, in place of the environment.
"""

from __future__ import annotations

import json
import logging
import os
import re
import resource
import select
import signal
import sys
from collections.abc import Iterator, MutableMapping
from contextlib import contextmanager
from contextvars import ContextVar
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
    "SCENEPRINT_DATABASE_URL", "SCENEPRINT_REPLICA_URL", "PGPASSWORD", "AWS_ACCESS_KEY_ID",
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
