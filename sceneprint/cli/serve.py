"""`sceneprint serve`: the service and its workers in one go."""

from __future__ import annotations

import argparse
import logging
import signal
import threading
from pathlib import Path
from typing import Any

from sceneprint.cli.numbers import whole
from sceneprint.settings import Settings


def add_to(commands: Any) -> None:
    """Describe the command to the parser."""
    command = commands.add_parser(
        "serve",
        help="run the HTTP service and workers that sign what it receives",
        description="Run the HTTP service and its workers. Nothing has to be configured; every "
        "option can also be set in the environment (SCENEPRINT_HOST, _PORT, _WORKERS, _DATA_DIR).",
    )
    add_data_option(command)
    command.add_argument("--host", metavar="ADDRESS", help="default: 127.0.0.1, this machine only")
    command.add_argument(
        "--port", type=whole, metavar="N", help="default: 8008; 0 for a free one, which is printed"
    )
    add_workers_option(command)
    command.set_defaults(run=run)


def add_data_option(command: argparse.ArgumentParser) -> None:
    """`--data`."""
    command.add_argument(
        "--data",
        type=Path,
        metavar="DIR",
        help="folder of database and blobs (default: the user's)",
    )


def add_workers_option(command: argparse.ArgumentParser) -> None:
    """`--workers`."""
    command.add_argument(
        "--workers", type=whole, metavar="N", help="processes that sign (default: processors - 1)"
    )


def settings_of(options: argparse.Namespace) -> Settings:
    """Settings of the environment, and what the options say instead.

    Raises
    ------
    InvalidRequest : a value that is none.
    """
    from pydantic import ValidationError

    from sceneprint.errors import InvalidRequest

    names = {"data": "data_dir", "host": "host", "port": "port", "workers": "workers"}
    given = {
        field: getattr(options, name)
        for name, field in names.items()
        if getattr(options, name, None) is not None
    }
    try:
        return Settings(**given)
    except ValidationError as error:
        first = error.errors()[0]
        name = str(first["loc"][0])
        # a URL may hold a password, and the error from pydantic quotes it as well
        secret = name.endswith("_url")
        value = "not usable" if secret else f"{first['input']!r:.60}"
        raise InvalidRequest(
            f"The setting {name} is {value}: {first['msg']}. Correct the option or "
            f"SCENEPRINT_{name.upper()}."
        ) from (None if secret else error)


def run(options: argparse.Namespace) -> int:
    """Serve until told to stop."""
    from sceneprint.cli.signer import prepare_presets
    from sceneprint.logs import log_as_json
    from service.server import run as serve
    from worker.supervisor import Supervisor

    settings = settings_of(options)
    log_as_json()  # from the first line on
    prepare_presets(settings, logging.getLogger(__name__).info)
    supervisor, stop = Supervisor(settings), threading.Event()
    watching = threading.Thread(target=supervisor.watch, args=(stop,), name="supervisor")

    def ready(url: str, read_only: bool) -> None:
        if not read_only:  # there would be nothing for workers to do
            supervisor.start()  # after the service has brought the database to its schema
            watching.start()
        print(f"sceneprint: serving {url}\nsceneprint: dashboard {url}/dashboard", flush=True)

    # uvicorn handles both signals while it runs; before and after, leave by the same way out
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        serve(settings, ready)
    except KeyboardInterrupt:
        pass  # the ordinary end
    finally:
        stop.set()
        if watching.is_alive():
            watching.join()
    return 0
