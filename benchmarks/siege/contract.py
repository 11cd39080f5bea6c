"""Every operation of the OpenAPI document, asked in ways that it allows, and in others.

schemathesis generates the requests; no answer may be 5xx, or other than the document declares.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

CHECKS = (
    "not_a_server_error", "status_code_conformance", "content_type_conformance",
    "response_schema_conformance", "response_headers_conformance",
)  # fmt: skip
#: Streams of events have no end: so many are read.
_EVENTS = 2
_COUNTED = re.compile(r"(\d+) generated(?:, (\d+) found \d+ unique failures?)?(?:, (\d+) passed)?")


@dataclass(frozen=True)
class ContractFigures:
    """What came of it.

    Parameters
    ----------
    operations : that were tried
    requests, passed : sent, and answered as the document says
    report : what schemathesis printed, for who looks into a failure
    """

    operations: int
    requests: int
    passed: int
    report: str

    @property
    def sound(self) -> bool:
        """Whether something was tried, and nothing failed."""
        return self.requests > 0 and self.requests == self.passed


def try_contract(
    url: str, folder: Path, *, key: str | None = None, known: Mapping[str, str] | None = None,
    examples: int = 20, seed: int = 1, phases: str = "examples,coverage,fuzzing,stateful",
) -> ContractFigures:  # fmt: skip
    """Try every operation of a service.

    Parameters
    ----------
    url : of the service
    folder : for the configuration
    key : to show
    known : parameters of paths and queries, such as map_name: what is there, so that more than
        404 comes back. Nothing is deleted then
    examples : requests of each operation, besides those of the edges of its schema
    seed : of what is generated
    phases : of schemathesis
    """
    lines = [f"max-stream-events = {_EVENTS}", "request-timeout = 30.0"]
    if known:
        lines += ["[parameters]", *(f"{json.dumps(n)} = {json.dumps(v)}" for n, v in known.items())]
    config = folder / "schemathesis.toml"
    config.write_text("\n".join(lines) + "\n")
    command = [
        str(Path(sys.executable).parent / "schemathesis"), "--config-file", str(config),
        "run", f"{url}/openapi.json", "--checks", ",".join(CHECKS), "--phases", phases,
        "--max-examples", str(examples), "--seed", str(seed), "--generation-database", "none",
        "--suppress-health-check", "all", "--no-color", "--warnings", "off", "--workers", "1",
        "--continue-on-failure", "--no-shrink",
    ]  # fmt: skip
    if key is not None:
        command += ["--header", f"Authorization: Bearer {key}"]
    if known:
        command += ["--exclude-method", "DELETE"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    return read_report(done.stdout + done.stderr, done.returncode)


def read_report(report: str, code: int) -> ContractFigures:
    """What schemathesis counted; with an exit code that it does not explain, nothing passed."""
    counted, tested = _COUNTED.search(report), re.search(r"Tested: (\d+)", report)
    if counted is None or tested is None:
        return ContractFigures(0, 0, 0, report)
    requests, failed, passed = (int(one or 0) for one in counted.groups())
    if failed:
        passed = requests - failed
    elif code != 0:
        passed = 0
    return ContractFigures(int(tested[1]), requests, passed, report)
