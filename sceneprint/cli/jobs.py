"""`sceneprint jobs`: the jobs of a service, given up or tried again."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING, Any

from sceneprint.cli.connection import add_service_options, one_line, open_client
from sceneprint.errors import CannotRetry, InvalidRequest
from sceneprint.schemas.states import JobState

if TYPE_CHECKING:
    from collections.abc import Iterable

    from sceneprint.client import Client
    from sceneprint.schemas import Job


def add_to(commands: Any) -> None:
    """Describe the command to the parser."""
    command = commands.add_parser(
        "jobs",
        help="list the jobs of a service, cancel them or try them again",
        description="List the jobs of a service, the newest first, or cancel or retry some.",
    )
    choice = command.add_mutually_exclusive_group()
    choice.add_argument("--retry", metavar="ID", help="try a job again that was given up")
    choice.add_argument(
        "--retry-dead",
        action="store_true",
        help="try all again that broke down too often and were not tried since",
    )
    choice.add_argument("--cancel", metavar="ID", help="give up a job that is not over")
    command.add_argument(
        "--state", choices=[str(state) for state in JobState], help="list only jobs in this state"
    )
    command.add_argument("--json", action="store_true", help="print JSON, tracebacks included")
    add_service_options(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """List, cancel or retry."""
    asked = options.retry is not None or options.retry_dead or options.cancel is not None
    if asked and options.state is not None:
        raise InvalidRequest("--state is for listing. Leave it out with --retry or --cancel.")
    with open_client(options) as client:
        if options.retry is not None:
            _say(client.retry_job(options.retry), as_json=options.json)
        elif options.cancel is not None:
            _say(client.cancel_job(options.cancel), as_json=options.json)
        elif options.retry_dead:
            return _retry_dead(client, as_json=options.json)
        else:
            state = None if options.state is None else JobState(options.state)
            _list(client.jobs(state), as_json=options.json)
    return 0


def _retry_dead(client: Client, *, as_json: bool) -> int:
    """Retry the dead; a job that was followed by another of its frame is history, and stays.

    Returns
    -------
    code : 2 where one cannot be tried again
    """
    again, refused = 0, 0
    for job in list(client.jobs(JobState.DEAD)):  # all before the first: pages would shift
        of_frame = job.map is not None and job.frame_id is not None and job.kind == "sign"
        if of_frame and client.frame(str(job.map), str(job.frame_id)).job_id != job.job_id:
            continue
        try:
            retried = client.retry_job(job.job_id)
        except CannotRetry as error:
            refused += 1
            print(f"sceneprint jobs: {one_line(str(error))}", file=sys.stderr)
            continue
        again += 1
        _say(retried, as_json=as_json)
    if not as_json:
        print(f"{again} jobs are tried again, {refused} cannot be")
    return 2 if refused else 0


def _say(job: Job, *, as_json: bool) -> None:
    print(job.model_dump_json() if as_json else f"job {job.job_id} of map {job.map}, {job.state}")


def _list(jobs: Iterable[Job], *, as_json: bool) -> None:
    if as_json:
        for job in jobs:
            print(job.model_dump_json())
        return
    any_yet = False
    for job in jobs:
        if not any_yet:
            print(f"{'job':32}  state      prio  tries  created              map  error")
            any_yet = True
        print(
            f"{job.job_id:32}  {job.state:9}  {job.priority:4}  {job.attempts:5}  "
            f"{job.created_at:%Y-%m-%d %H:%M:%S}  {job.map}  {one_line(job.error or '')}".rstrip()
        )
    if not any_yet:
        print("no such jobs")
