"""`sceneprint work`: workers alone, beside a service that runs elsewhere on the same store."""

from __future__ import annotations

import argparse
import logging
from typing import Any

from sceneprint.cli.serve import add_data_option, add_workers_option, settings_of


def add_to(commands: Any) -> None:
    """Describe the command to the parser."""
    command = commands.add_parser(
        "work",
        help="run workers alone",
        description="Run worker processes that sign what a service on the same store receives.",
    )
    add_data_option(command)
    add_workers_option(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Work until told to stop."""
    from sceneprint.cli.signer import prepare_presets
    from sceneprint.engine.opening import open_engine
    from sceneprint.logs import log_as_json
    from worker.supervisor import run as work

    settings = settings_of(options)
    log_as_json()  # from the first line on
    with open_engine(settings) as engine:  # what is wrong is said once, and not by every worker
        engine.store.database.require_writable()
    prepare_presets(settings, logging.getLogger(__name__).info)
    work(settings)
    return 0
