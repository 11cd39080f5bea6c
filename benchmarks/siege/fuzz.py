"""Two fuzzers that we did not write, for as long as you say; exit code 1 where one finds anything.

`python -m benchmarks.siege.fuzz http --seconds 3600` runs schemathesis against services with a
worker, keys, and maps that hold frames. `python -m benchmarks.siege.fuzz decoders --seconds 3600`
runs atheris on what reads files of strangers; it is in no lock: `.venv/bin/pip install atheris`.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.pages import put_between
from benchmarks.siege.__main__ import besieged, known_of
from benchmarks.siege.contract import CHECKS, read_report
from benchmarks.siege.decoders import TARGETS
from benchmarks.soak.load import shots
from sceneprint.engine import Engine
from sceneprint.settings import Settings

#: Besides what the siege checks: keys that are not asked for, methods and headers that are not
#: declared, and what can still be had after its deletion.
MORE_CHECKS = (
    "ignored_auth", "unsupported_method", "allow_header_conformance", "missing_required_header",
    "use_after_free",
)  # fmt: skip
#: Of what libFuzzer leaves: slow inputs, which `replay` judges with compiled kernels.
_JUDGED = ("timeout-", "slow-unit-")
_EVENTS = 2
_WALLS: dict[str, object] = {"host": "0.0.0.0", "requests_per_s": 0}
MARKS = {name: (f"<!-- fuzz-{name}:begin -->", f"<!-- fuzz-{name}:end -->") for name in
         ("http", "decoders")}  # fmt: skip


@dataclass(frozen=True)
class Fuzzed:
    """What a fuzzer did.

    Parameters
    ----------
    of : what it was let loose on
    inputs : requests or files
    seconds : it ran for
    findings : what it found, in words
    more : further figures: edges of the code that were reached, inputs that reached them, and of
        one input with compiled kernels most seconds and most bytes
    """

    of: str
    inputs: int
    seconds: float
    findings: list[str]
    more: dict[str, float] = field(default_factory=dict)

    @property
    def sound(self) -> bool:
        """Whether something was tried, and nothing was found."""
        return self.inputs > 0 and not self.findings


def fuzz_requests(
    of: str, url: str, folder: Path, key: str, seconds: int, seed: int,
    known: dict[str, str] | None = None, phases: str = "examples,coverage,fuzzing,stateful",
) -> Fuzzed:  # fmt: skip
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
    counted = read_report(report.read_text(), done.returncode)
    findings = [] if counted.sound else [counted.report]
    return Fuzzed(of, counted.requests, time.monotonic() - start, findings)


def fuzz_http(folder: Path, seconds: int, seed: int) -> list[Fuzzed]:
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


def fuzz_decoder(name: str, folder: Path, seconds: float, seed: int) -> Fuzzed:
    """Let atheris loose on a decoder for a time, and run all it found interesting once more.

    Parameters
    ----------
    name : of the target
    folder : its corpus, which later runs go on with, findings and logs
    seconds : for how long; a process that ended early begins again
    seed : of the mutations
    """

    def run(what: str, *options: str, **environment: str) -> str:
        command = [sys.executable, "-m", "benchmarks.siege.decoders", what, name, str(folder)]
        done = subprocess.run(
            [*command, *options], env=os.environ | environment, capture_output=True
        )
        text = (done.stdout + done.stderr).decode(errors="replace")
        with (folder / f"{what}.log").open("a") as log:
            log.write(text)
        return text

    folder.mkdir(parents=True, exist_ok=True)
    run("seeds")
    start, inputs, more = time.monotonic(), 0, dict[str, float]()
    while (left := round(seconds - (time.monotonic() - start))) > 0:
        seed += 1
        options = [f"-max_total_time={left}", "-timeout=60", "-rss_limit_mb=2500", f"-seed={seed}"]
        text = run("fuzz", *options, NUMBA_DISABLE_JIT="1")
        told = re.findall(r"#(\d+)\s+\w+\s+cov: (\d+) ft: \d+ corp: (\d+)", text)
        if not told:
            return Fuzzed(name, inputs, time.monotonic() - start, [text[-2000:]])
        inputs += int(told[-1][0])
        more = {"edges": float(told[-1][1]), "corpus": float(told[-1][2])}
    spent = time.monotonic() - start
    last = run("replay").splitlines()[-1:]
    findings = [
        f"{one.name}: {_told(one)}"
        for one in sorted((folder / "findings").iterdir())
        if one.suffix != ".txt" and not one.name.startswith(_JUDGED)
    ]
    try:
        more |= json.loads(last[0])
    except (IndexError, ValueError):
        findings.append(f"replay of {name}: {last}")
    return Fuzzed(name, inputs, spent, findings, more)


def _told(finding: Path) -> str:
    """What was noted with an input; libFuzzer's are explained in fuzz.log."""
    note = finding.with_suffix(".txt")
    return note.read_text() if note.exists() else "see fuzz.log"


def fuzz_decoders(folder: Path, seconds: int, seed: int, jobs: int) -> list[Fuzzed]:
    """All decoders, so many at once; `seconds` are those of all together."""
    each = seconds / len(TARGETS)
    with ThreadPoolExecutor(jobs) as pool:
        runs = [pool.submit(fuzz_decoder, name, folder / name, each, seed) for name in TARGETS]
        return [one.result() for one in runs]


def http_table(found: list[Fuzzed]) -> list[str]:
    """The figures as lines of Markdown."""
    return [
        "| asked of | requests | seconds | findings |",
        "|---|--:|--:|--:|",
        *(
            f"| {one.of} | {one.inputs} | {one.seconds:.0f} | **{len(one.findings)}** |"
            for one in found
        ),
    ]


def decoder_table(found: list[Fuzzed]) -> list[str]:
    """The figures as lines of Markdown."""
    return [
        "| decoder | files | seconds | edges reached | longest, s | most memory, MiB | findings |",
        "|---|--:|--:|--:|--:|--:|--:|",
        *(
            f"| {one.of} | {one.inputs} | {one.seconds:.0f} | {one.more.get('edges', 0):.0f} "
            f"| {one.more.get('s', 0):.2f} | {one.more.get('bytes', 0) / 2**20:.1f} "
            f"| **{len(one.findings)}** |"
            for one in found
        ),
    ]


def main() -> int:
    """Run one of the two; exit code 1 where it found anything, or tried nothing."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("http", "decoders"))
    parser.add_argument("--seconds", type=int, default=3600, help="of decoders: of all together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2, help="decoders at once")
    parser.add_argument("--keep", type=Path, help="folder for reports; default: a temporary one")
    parser.add_argument("--page", type=Path, help="whose figures to replace")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="sceneprint-fuzz-") as name:
        folder = (options.keep or Path(name)).absolute()
        if options.what == "http":
            found = fuzz_http(folder, options.seconds, options.seed)
        else:
            found = fuzz_decoders(folder, options.seconds, options.seed, options.jobs)
    lines = http_table(found) if options.what == "http" else decoder_table(found)
    print("\n".join(lines))
    for one in found:
        for finding in one.findings:
            print(f"{one.of}: {finding}", file=sys.stderr)
    if options.page is not None:
        put_between(options.page, *MARKS[options.what], ["", *lines, ""])
    return int(not all(one.sound for one in found))


if __name__ == "__main__":
    sys.exit(main())
