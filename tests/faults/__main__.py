"""`python -m tests.faults`: try a fault at every call of every operation, and write the report."""

import argparse
import json
import shlex
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

from tqdm import tqdm

from benchmarks.machine import measured_on
from benchmarks.postgres import Server
from tests.faults.enumeration import Enumeration, report
from tests.faults.injection import FAULTS
from tests.faults.operations import OPERATIONS, small_uploads


def main():
    """Run the command; return 1 if an invariant was broken."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("operation", nargs="*", help=f"of {', '.join(OPERATIONS)} (default: all)")
    parser.add_argument("--fault", action="append", choices=FAULTS, help="only these faults")
    parser.add_argument("--store", action="append", choices=("sqlite", "postgresql"))
    parser.add_argument("--first", type=int, default=1, help="number of the first call that fails")
    parser.add_argument("--step", type=int, default=1, help="calls from one failure to the next")
    parser.add_argument("--json", action="store_true", help="print the counts of calls as JSON")
    parser.add_argument("--page", type=Path, help="Markdown file whose marked section is replaced")
    options = parser.parse_args()
    command = shlex.join(["python", "-m", "tests.faults", *sys.argv[1:]])
    lines, counts, broken = [measured_on(f"`{command}`"), ""], dict[str, dict[str, int]](), 0
    for store in options.store or ("sqlite", "postgresql"):
        start = time.monotonic()
        trials = _enumerate(store, options)
        result = [violation for each in trials.values() for violation in each.violations]
        broken += len(result)
        for (operation, fault), trial in trials.items():
            counts.setdefault(operation, {})[fault] = trial.calls
        lines += [f"**{store}**, {time.monotonic() - start:.0f} s:", "", *report(trials), ""]
        lines += [*(f"* {item}" for item in result), ""] if result else []
    text = "\n".join(lines)
    sys.stdout.write(json.dumps(counts) if options.json and not broken else f"{text}\n")
    if options.page is not None:
        begin, end = "<!-- faults:begin -->", "<!-- faults:end -->"
        head, rest = options.page.read_text().split(begin)
        options.page.write_text(f"{head}{begin}\n{text}{end}" + rest.split(end)[1])
    return 1 if broken else 0


def _enumerate(store, options):
    operations, faults = options.operation or list(OPERATIONS), options.fault or list(FAULTS)
    tqdm.monitor_interval = 0  # without its thread, which forks would lack
    with ExitStack() as stack:
        work = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="sceneprint-faults-")))
        server = None
        if store == "postgresql":
            server = Server(work / "server")
            server.start()
            stack.callback(server.stop)
        enumeration = Enumeration(work / "stores", small_uploads(), server)
        progress = stack.enter_context(tqdm(total=len(operations) * len(faults), unit="run"))
        results = {}
        for operation in operations:
            for fault in faults:
                progress.set_description(f"{store}: {operation}, {fault}")
                results[operation, fault] = enumeration.run(
                    operation, fault, first=options.first, step=options.step
                )
                progress.update()
        return results


if __name__ == "__main__":
    sys.exit(main())
