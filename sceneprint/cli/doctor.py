"""`sceneprint doctor`: what is fine here, what is not, and what to do."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from sceneprint import __version__
from sceneprint.cli.checks import machine
from sceneprint.cli.connection import add_service_options, one_line, open_client
from sceneprint.cli.findings import Finding
from sceneprint.cli.serve import add_data_option, settings_of
from sceneprint.client.client import DEFAULT_URL
from sceneprint.errors import KeyRequired, SceneprintError, Unreachable

if TYPE_CHECKING:
    from sceneprint.client import Client, Status

#: Age of a frame that nobody signs at which workers are missed, seconds.
LONGEST_S = 60.0


def add_to(commands: Any) -> None:
    """Describe the command to the parser."""
    command = commands.add_parser(
        "doctor",
        help="say what is fine on this machine and with the service, and what to do",
        description="Look at this machine, the data folder and the service. Nothing is changed. "
        "Exit code 2 where something needed is missing; what is optional is noted.",
    )
    add_data_option(command)
    add_service_options(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Look at everything; returns 2 where something needed is wrong."""
    wrong = 0
    for finding in (*_all(options),):
        print(f"{finding.verdict:5}  {finding.subject:16}  {one_line(finding.text)}", flush=True)
        wrong += finding.verdict == "WRONG"
    things = "1 thing is wrong" if wrong == 1 else f"{wrong} things are wrong"
    print(things if wrong else "all that is needed is fine")
    return 2 if wrong else 0


def _all(options: argparse.Namespace) -> Iterator[Finding]:
    yield from machine(settings_of(options))
    yield from _service(options)


def _service(options: argparse.Namespace) -> Iterator[Finding]:
    """Findings about the service; that none runs is wrong only where one was named."""
    url = options.url or DEFAULT_URL
    try:
        with open_client(options) as client:
            if not client.healthy():
                text = f"none answers at {url}; `sceneprint serve` starts one"
                yield Finding("WRONG" if options.url else "note", "service", text)
                return
            status = client.status()
            yield _version(url, status)
            yield _workers(client, status)
    except KeyRequired:
        text = f"{url} asks for a key; give it with --key to see whether workers keep up"
        yield Finding("note", "workers", text)
    except (Unreachable, SceneprintError) as error:
        yield Finding("WRONG", "service", str(error))


def _version(url: str, status: Status) -> Finding:
    text = f"{url} answers, version {status.version}"
    if status.frames is not None:
        text += f", {sum(status.frames.values())} frames"
    if status.version == __version__:
        return Finding("ok", "service", text)
    return Finding("note", "service", f"{text}; this is version {__version__}")


def _workers(client: Client, status: Status) -> Finding:
    if status.jobs is None:
        text = "the service tells of them only to a key for all maps; give one with --key"
        return Finding("note", "workers", text)
    queued, running = status.jobs.get("queued", 0), status.jobs.get("running", 0)
    text = f"{queued} jobs wait, {running} are being done"
    oldest = _oldest_s(client) if queued else 0.0
    if queued:
        text += f", the oldest came {oldest:.0f} s ago"
    if running == 0 and oldest > LONGEST_S:
        text += ". No worker seems to run: `sceneprint work` starts some; see their log."
        return Finding("WRONG", "workers", text)
    dead = status.jobs.get("dead", 0)
    if dead:
        text += f"; {dead} were given up, and `traceback` of these jobs says why"
    return Finding("note" if dead else "ok", "workers", text)


def _oldest_s(client: Client) -> float:
    """Age of the frame that has waited longest, seconds."""
    from sceneprint.schemas import FrameState

    now, ages = datetime.now(UTC), [0.0]
    for one in client.maps():
        first = next(client.frames(one.name, FrameState.RECEIVED), None)
        if first is not None:
            ages.append((now - first.received_at).total_seconds())
    return max(ages)
