"""Log lines as JSON, one object a line on standard error."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import UTC, datetime

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
