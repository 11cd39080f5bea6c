"""Disturb a service while robots use it, and count the frames that it loses.

`python -m benchmarks.soak soak --page docs/fault_injection.md` runs a plan and writes its figures
to the page. Options such as `--store` and `--faults` change the plan:
`python -m benchmarks.soak fleet --faults kill=50 failover=5 --seconds 300`.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import fields, replace
from pathlib import Path

from benchmarks.machine import measured_on
from benchmarks.soak.attacks import ATTACKS, attack_table
from benchmarks.soak.broken_uploads import broken_table
from benchmarks.soak.faults import CUT_OFF, CUT_OFF_S, FROZEN, FROZEN_S, FULL, FULL_S
from benchmarks.soak.operations import operation_table
from benchmarks.soak.plan import FAULTS, PLANS, Plan
from benchmarks.soak.processes import DATABASE_S, STORE_S
from benchmarks.soak.run import SoakFigures, drive
from sceneprint.cli.options import ended_by_signals

_TIMES = {1: "once", 2: "twice"}


def title(plan: Plan) -> str:
    """Return a short description of a plan."""
    standby = "an asynchronous" if plan.asynchronous else "a synchronous"
    store = "SQLite" if plan.store == "sqlite" else f"PostgreSQL with {standby} standby"
    return f"{plan.robots:,} robots for {plan.seconds:.0f} s, {store}"


def description(figures: SoakFigures) -> Iterator[str]:
    """Yield sentences about a run."""
    plan, kills = figures.plan, figures.kills
    blobs = "an object store" if plan.objects else "a shared folder"
    delayed = ""
    if plan.delays:
        delayed = (
            f" (a message to the database takes {1e3 * DATABASE_S:g} ms, one to the store "
            f"{1e3 * STORE_S:g} ms)"
        )
    yield (
        f"{plan.services} services, {plan.workers} workers, blobs in {blobs}{delayed}; each robot "
        f"sends {plan.rate:g} frames a second, and {plan.readers} readers search."
    )
    killed = sorted((name, n) for name, n in kills.items() if name not in _UNKILLED)
    if killed:
        yield "SIGKILL of " + ", ".join(f"{n} of {name}" for name, n in killed) + "."
    for victim, sentence in _UNKILLED.items():
        if kills[victim]:
            yield sentence.format(_TIMES.get(kills[victim], f"{kills[victim]} times"))
    if plan.retention_s is not None:
        yield (
            f"The maps of three in four robots delete frames after {plan.retention_s:g} s, as fast "
            "as new frames arrive."
        )
    if plan.count("offline-hour"):
        yield (
            "Another robot was offline for a simulated hour with a frame every ten seconds; its "
            f"{figures.spooled} frames were spooled at the start."
        )


#: Sentences for faults that do not end a process.
_UNKILLED = {
    FROZEN: f"The primary was frozen {{}} for {FROZEN_S:g} s (SIGSTOP).",
    CUT_OFF: f"A host was cut off {{}} from its servers for {CUT_OFF_S:g} s.",
    FULL: f"The disk was full {{}}, for {FULL_S:g} s each time.",
}


def rows(figures: SoakFigures) -> dict[str, str]:
    """Return the rows of the table: labels and figures."""
    plan, counts = figures.plan, figures.found
    figure_of = {
        "acknowledged frames, and frames that robots deleted":
            f"{counts.acknowledged + figures.deleted}, {figures.deleted}",
        "of the others: indexed, not indexed for a stated reason":
            f"{counts.indexed}, {counts.stated}",
        "of the indexed: queried with their own content, found":
            f"{counts.looked_up}, {counts.found}",
        "**lost**": f"**{figures.lost}**",
    }  # fmt: skip
    if plan.retention_s is not None:
        figure_of["deleted by retention, with an event"] = f"{counts.aged}"
    if plan.count("offline-hour"):
        sent = f"{figures.spooled}, {figures.spooled_twice}"
        figure_of["frames of the offline robot, frames sent again"] = sent
    if plan.asynchronous:
        figure_of[
            "acknowledged frames that the standby had not received: missing, of frames that only "
            "the dead primary has"
        ] = f"{len(counts.missing)}, {figures.window}"
    figure_of |= {
        "**stored twice, stored without acknowledgement, restored after deletion**":
            f"**{counts.doubled}, {counts.strangers}, {counts.returned}**",
        "**changes without their event or audit entry**": f"**{counts.separated}**",
        "**damages found by `sceneprint fsck`**": f"**{figures.damaged}**",
        "unreferenced files (`sceneprint fsck` removes them)": f"{figures.leftovers}",
        "events of frames: not received, received twice":
            f"{counts.unheard}, {counts.heard_twice}",
        "answers and lists that differ between services": f"{counts.disagreeing}",
        "**searches with a wrong distance, order or match**, all searches":
            f"**{len(counts.wrong)}**, {counts.searches:,}",
        "answered queries, repeated requests, errors":
            f"{figures.queries}, {figures.repeated}, {len(figures.faults)}",
    }  # fmt: skip
    for kind, (p50, p99) in figures.waits_ms.items():
        figure_of[f"{kind}: median, p99"] = f"{p50:,.0f}, {p99:,.0f} ms"
    if plan.store == "postgresql":
        turns = "{:.1f}, {:.1f} ms".format(*figures.turn_ms)
        figure_of["time that a frame blocks all writers, writers of its map"] = turns
    else:
        figure_of['**"database is locked"**'] = f"**{figures.locked}**"
    service, worker = (peak / 1e6 for peak in figures.memory)
    figure_of["peak memory of a service process, of a worker process"] = (
        f"{service:,.0f}, {worker:,.0f} MB"
    )
    return figure_of


def table(figures: SoakFigures) -> list[str]:
    """Return the figures as lines of Markdown."""
    lines = [f"### {title(figures.plan)}", "", *description(figures), "", "| | |", "|---|--:|"]
    lines += [f"| {what} | {value} |" for what, value in rows(figures).items()]
    if figures.outages:
        lines += ["", "| fault | longest time without an answer, s |", "|---|--:|"]
    for victim, waits in sorted(figures.outages.items()):
        waited = [f"{wait:.1f}" for wait in sorted(waits) if wait >= 0.05]
        lines.append(f"| {victim}, {len(waits)} | {', '.join(waited) or '0.0'} |")
    lines.append("")
    for promotion in figures.promotions:
        back = ", ".join(f"{seconds:.1f}" for seconds in promotion.resumed.values())
        lines.append(
            f"Primary dead for {promotion.promoted - promotion.killed:.1f} s until the standby was "
            f"promoted; each service answered {back} s after that."
        )
    if figures.broken is not None:
        lines += broken_table(figures.broken)
    if figures.operations:
        lines += operation_table(figures.operations)
    if figures.attacks:
        lines += ["### Attacks by one tenant while others work", "", *attack_table(figures.attacks)]
    return [*lines, ""]


def parse_fault(text: str) -> tuple[str, int]:
    """Return the name and the number of a fault on the command line."""
    name, _, count = text.partition("=")
    if name not in FAULTS or not count.isdigit():
        raise argparse.ArgumentTypeError(f"{text}: write FAULT=N; faults: {', '.join(FAULTS)}")
    return name, int(count)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run plans; return 1 if a frame was lost, duplicated or damaged, or a bound is exceeded."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("plans", nargs="+", choices=list(PLANS), metavar="PLAN",
                        help=", ".join(PLANS))  # fmt: skip
    parser.add_argument("--store", choices=("sqlite", "postgresql"))
    parser.add_argument("--faults", nargs="*", type=parse_fault, metavar="FAULT=N",
                        help=", ".join(FAULTS))  # fmt: skip
    parser.add_argument("--attacks", nargs="+", choices=list(ATTACKS), metavar="ATTACK",
                        help="only these attacks")  # fmt: skip
    for name in ("seconds", "rate", "retention_s", "most_turn_ms", "most_query_ms"):
        parser.add_argument(f"--{name.replace('_', '-')}", type=float)
    for name in ("robots", "readers", "services", "workers", "seed"):
        parser.add_argument(f"--{name}", type=int)
    for name in ("asynchronous", "objects", "delays", "signed"):
        parser.add_argument(f"--{name}", action="store_true", default=None)
    parser.add_argument("--data", type=Path, help="folder of recordings; default: synthetic rooms")
    parser.add_argument("--page", type=Path, help="Markdown file whose marked section is replaced")
    parser.add_argument("--keep", type=Path, help="new folder for data and logs, which is kept")
    options = parser.parse_args(arguments)
    changed = {option.name: getattr(options, option.name) for option in fields(Plan)
               if getattr(options, option.name, None) is not None}  # fmt: skip
    if options.faults is not None:
        changed["faults"] = dict(options.faults)
    return max(
        _run(name, replace(PLANS[name], **changed), options.page, options.keep)
        for name in options.plans
    )


def _run(name: str, plan: Plan, page: Path | None, keep: Path | None) -> int:
    """Run a plan, print its figures, and return the exit code."""
    if plan.count("full-disk") and os.geteuid() != 0:
        print("the disk is not filled: mounting a file system requires root")
        plan = replace(plan, faults={**plan.faults, "full-disk": 0})
    with (
        ended_by_signals(),
        tempfile.TemporaryDirectory(prefix="sceneprint-soak-", ignore_cleanup_errors=True) as new,
    ):
        folder = Path(new) if keep is None else keep / name
        folder.mkdir(parents=True, exist_ok=True)
        figures = drive(folder, plan)
    reports = [operation.report for operation in figures.operations if not operation.sound]
    broken = [] if figures.broken is None else figures.broken.failed
    for line in (
        *figures.faults[:20], *figures.found.wrong[:20], *broken[:20], *reports, *figures.exceeded
    ):  # fmt: skip
        print(line, file=sys.stderr)
    command = f"`python -m benchmarks.soak {name}` in {figures.seconds:.0f} s"
    lines = ["", measured_on(command), "", *table(figures)]
    print("\n".join(lines))
    if page is not None:
        begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
        head, rest = page.read_text().split(begin)
        page.write_text("\n".join([head + begin, *lines, end]) + rest.split(end)[1])
    return 0 if figures.sound else 1


if __name__ == "__main__":
    sys.exit(main())
