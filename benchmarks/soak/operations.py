"""Calls of every operation of the OpenAPI document, with and without permission.

schemathesis generates the requests. Answers must not be 5xx and must conform to the document.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.soak.plan import MODEL, Plan
from benchmarks.soak.processes import Fleet
from benchmarks.soak.recordings import Shot
from sceneprint_client import Client

CHECKS = (
    "not_a_server_error", "status_code_conformance", "content_type_conformance",
    "response_schema_conformance", "response_headers_conformance",
)  # fmt: skip
#: Phases of schemathesis.
PHASES = "examples,coverage,fuzzing,stateful"
#: Number of events to read from an endless stream.
_EVENTS = 2
_COUNTED = re.compile(r"(\d+) generated(?:, (\d+) found \d+ unique failures?)?(?:, (\d+) passed)?")


@dataclass(frozen=True)
class OperationFigures:
    """Answers to generated requests.

    Parameters
    ----------
    caller : description of the key and of the requested objects
    operations : number of operations
    requests, passed : number of requests, and of those with an answer as declared
    """

    caller: str
    operations: int
    requests: int
    passed: int
    report: str

    @property
    def sound(self) -> bool:
        """Return whether requests were sent and all passed."""
        return self.requests > 0 and self.requests == self.passed


def call_operations(
    caller: str, url: str, folder: Path, options: Sequence[str], path_values: Mapping[str, str]
) -> OperationFigures:
    """Call every operation of a service.

    Parameters
    ----------
    caller, url : see OperationFigures, and address of the service
    options : further options of schemathesis
    path_values : values of path parameters, such as path.map_name, of existing objects, so that not
        every answer is 404; deletions are then excluded
    """
    lines = [f"max-stream-events = {_EVENTS}", "request-timeout = 30.0"]
    if path_values:
        lines += [
            "[parameters]",
            *(f"{json.dumps(n)} = {json.dumps(v)}" for n, v in path_values.items()),
        ]
    config = folder / "schemathesis.toml"
    config.write_text("\n".join(lines) + "\n")
    command = [
        str(Path(sys.executable).parent / "schemathesis"), "--config-file", str(config),
        "run", f"{url}/openapi.json", "--checks", ",".join(CHECKS), "--seed", "1",
        "--generation-database", "none", "--suppress-health-check", "all", "--no-color",
        "--warnings", "off", "--workers", "1", "--continue-on-failure", "--no-shrink", *options,
        *(("--exclude-method", "DELETE") if path_values else ()),
    ]  # fmt: skip
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    return read_report(caller, done.stdout + done.stderr, done.returncode)


def read_report(caller: str, report: str, code: int) -> OperationFigures:
    """Return the counts of schemathesis; an unexplained exit code counts as a failure."""
    counted, tested = _COUNTED.search(report), re.search(r"Tested: (\d+)", report)
    if counted is None or tested is None:
        return OperationFigures(caller, 0, 0, 0, report)
    requests, failed, passed = (int(number or 0) for number in counted.groups())
    if failed:
        passed = requests - failed
    elif code != 0:
        passed = 0
    return OperationFigures(caller, int(tested[1]), requests, passed, report)


def call_as_everybody(
    folder: Path, frames: Sequence[Shot], examples: int, phases: str = PHASES
) -> list[OperationFigures]:
    """Call every operation with all permissions, with those of one map, and without a key.

    Parameters
    ----------
    folder : empty folder for data and configuration
    examples : number of requests per operation, in addition to the edge cases of its schema
    """
    figures = []
    plan = Plan("sqlite", services=1, workers=1)
    for caller in ("an operator", "an operator, of what is stored", "its own map", "another map"):
        own = folder / caller
        own.mkdir()
        with Fleet(own, plan) as fleet:
            key = fleet.start()
            url = fleet.urls[0]
            with Client(url, key) as client:
                for name in ("siege", "other"):
                    client.create_map(name, model=MODEL)
                    for shot in frames:
                        client.upload(name, shot.png, shot.meta, wait_s=60)
                map_name = "other" if caller == "another map" else "siege"
                frame = next(iter(client.frames(map_name)))
                query = client.query(map_name, frame_id=frame.frame_id)
                if caller.endswith("map"):
                    key = client.create_key("fuzzer", {"siege": "write"}).secret
            path_values = {
                "path.map_name": map_name, "path.frame_id": frame.frame_id,
                "path.job_id": frame.job_id, "path.query_id": query.query_id,
            }  # fmt: skip
            options = ["--phases", phases, "--max-examples", str(examples)]
            options += ["--header", f"Authorization: Bearer {key}"]
            named = {} if caller == "an operator" else path_values
            figures.append(call_operations(caller, url, own, options, named))
            if caller == "another map":
                # All requests are rejected, and edge cases of the schemas would take hours.
                options = ["--phases", "fuzzing", "--max-examples", str(max(examples // 5, 1))]
                figures.append(call_operations("nothing, without a key", url, own, options, {}))
    return figures


def operation_table(figures: Sequence[OperationFigures]) -> list[str]:
    """Return the figures as lines of Markdown."""
    return [
        f"### Every operation of the OpenAPI document ({figures[0].operations})", "",
        "| called by, or for | answered as declared, none with 5xx |", "|---|--:|",
        *(f"| {call.caller} | {call.passed} of {call.requests} |" for call in figures), "",
    ]  # fmt: skip
