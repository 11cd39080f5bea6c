"""Two fuzzers that we did not write, for as long as you say; exit code 1 where one finds anything.

`python -m benchmarks.siege.fuzz http --seconds 3600` runs schemathesis: sequences of requests that
follow from each other, against a service with a worker, keys, and maps that hold frames.
`python -m benchmarks.siege.fuzz decoders --seconds 3600` runs atheris, guided by coverage, on what
reads files of strangers; see `decoders.py`.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.siege.__main__ import besieged, known_of
from benchmarks.siege.contract import CHECKS
from benchmarks.soak.load import shots
from sceneprint.engine import Engine
from sceneprint.settings import Settings

#: Besides what the siege checks: keys that are not asked for, methods and headers that are not
#: declared, and what can still be had after its deletion.
MORE_CHECKS = (
    "ignored_auth", "unsupported_method", "allow_header_conformance", "missing_required_header",
    "use_after_free",
)  # fmt: skip
_EVENTS = 2
_WALLS: dict[str, object] = {"host": "0.0.0.0", "requests_per_s": 0}


@dataclass(frozen=True)
class Sequences:
    """What schemathesis did.

    Parameters
    ----------
    of : what was asked
    cases : requests that it counted
    seconds : it ran for
    report : what it printed
    code : its exit code: 0 where nothing was found
    """

    of: str
    cases: int
    seconds: float
    report: str
    code: int


def fuzz_requests(
    of: str, url: str, folder: Path, key: str, seconds: int, seed: int,
    known: dict[str, str] | None = None, phases: str = "examples,coverage,fuzzing,stateful",
) -> Sequences:  # fmt: skip
    """Let schemathesis ask a service for a time.

    Parameters
    ----------
    of : name of this run, and of its folder
    url : of the service
    folder : for configuration and report
    key : to show
    seconds : for how long
    seed : of what is generated
    known : parameters of paths, such as path.map_name: what is there. Nothing is deleted then;
        without, everything that the key may do is done
    phases : of schemathesis; those with no end are repeated until the time is over
    """
    place = folder / of
    place.mkdir(parents=True)
    lines = [f"max-stream-events = {_EVENTS}", "request-timeout = 120.0"]
    if known:
        lines += ["[parameters]", *(f"{json.dumps(n)} = {json.dumps(v)}" for n, v in known.items())]
    (place / "schemathesis.toml").write_text("\n".join(lines) + "\n")
    command = [
        str(Path(sys.executable).parent / "schemathesis"), "--config-file", "schemathesis.toml",
        "run", f"{url}/openapi.json", "--max-time", str(seconds), "--seed", str(seed),
        "--phases", phases, "--max-examples", "50", "--no-shrink",
        "--checks", ",".join((*CHECKS, *MORE_CHECKS)), "--continue-on-failure",
        "--generation-database", "none", "--suppress-health-check", "all", "--no-color",
        "--warnings", "off", "--workers", "1", "--header", f"Authorization: Bearer {key}",
    ]  # fmt: skip
    if known:
        command += ["--exclude-method", "DELETE"]
    report, start = place / "report.txt", time.monotonic()
    with report.open("w") as out:
        done = subprocess.run(command, cwd=place, stdout=out, stderr=subprocess.STDOUT)
    text = report.read_text()
    cases = re.search(r"(\d+) generated", text)
    return Sequences(
        of, int(cases[1]) if cases else 0, time.monotonic() - start, text, done.returncode
    )


def fuzz_http(folder: Path, seconds: int, seed: int) -> list[Sequences]:
    """Three services at once: one where everything may happen, one whose frames stay, and one that
    gets sequences of requests alone, each made of answers to those before it.
    """
    every, maps = shots(8), ("siege", "other")
    with ExitStack() as stack:
        urls, keys = {}, {}
        for of in ("everything", "what is there", "sequences"):
            data = folder / f"data of {of}"
            data.mkdir(parents=True)
            with Engine(Settings(data_dir=data, database_url=None)) as engine:
                keys[of] = engine.create_key("fuzzer").secret
            urls[of], _ = stack.enter_context(besieged(data, every, maps, keys[of], **_WALLS))
        more: dict[str, dict[str, Any]] = {
            "what is there": {"known": known_of(urls["what is there"], key=keys["what is there"])},
            "sequences": {"phases": "stateful"},
        }
        pool = stack.enter_context(ThreadPoolExecutor(len(urls)))
        runs = [
            pool.submit(
                fuzz_requests, of, url, folder, keys[of], seconds, seed + i, **more.get(of, {})
            )
            for i, (of, url) in enumerate(urls.items())
        ]
        return [one.result() for one in runs]


def main() -> int:
    """Run one of the two; exit code 1 where it found anything, or tried nothing."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("http",))
    parser.add_argument("--seconds", type=int, default=3600)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="folder for reports; default: a temporary one")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="sceneprint-fuzz-") as name:
        found = fuzz_http(options.keep or Path(name), options.seconds, options.seed)
    for one in found:
        print(f"{one.of}: {one.cases} requests in {one.seconds:.0f} s, exit code {one.code}")
        if one.code or not one.cases:
            print(one.report, file=sys.stderr)
    return int(any(one.code or not one.cases for one in found))


if __name__ == "__main__":
    sys.exit(main())
