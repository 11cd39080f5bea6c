"""`make fleet`: a fleet on one machine, parts of it killed at random, and what was lost.

`python -m benchmarks.fleet --page docs/reliability.md` puts the figures into the page.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from benchmarks.fleet.faults import CUT_OFF, CUT_OFF_S, FROZEN, FROZEN_S
from benchmarks.fleet.fleet import DATABASE_S, STORE_S
from benchmarks.fleet.run import FleetFigures, Plan, drive
from benchmarks.machine import describe_machine
from benchmarks.pages import put_between
from sceneprint.cli.options import ended_by_signals


def marks(plan: Plan) -> tuple[str, str]:
    """Marks in the page of what such a run found."""
    name = "fleet-asynchronous" if plan.asynchronous else "fleet"
    if plan.delays:
        name = "fleet-delays"
    if plan.is_crowd:
        name = "fleet-crowd"
    return f"<!-- {name}:begin -->", f"<!-- {name}:end -->"


def table(figures: FleetFigures) -> list[str]:
    """The figures as lines of Markdown."""
    plan, found = figures.plan, figures.found
    standby = "an asynchronous" if plan.asynchronous else "a synchronous"
    blobs = "an object store" if plan.objects else "a shared folder"
    delayed = ""
    if plan.delays:
        delayed = (
            f" (a message to the database takes {1e3 * DATABASE_S:g} ms, one to the store "
            f"{1e3 * STORE_S:g} ms)"
        )
    killed = {name: n for name, n in figures.kills.items() if name not in (FROZEN, CUT_OFF)}
    done = "SIGKILL of " + ", ".join(f"{n} of {name}" for name, n in sorted(killed.items()))
    lines = [
        f"### {plan.robots} robots for {plan.seconds:.0f} s, {standby} standby",
        "",
        f"PostgreSQL with {standby} standby, {plan.services} services, {plan.workers} workers, "
        f"blobs in {blobs}{delayed}; {plan.robots:,} robots send {plan.rate:g} frames a second "
        f"each. {done}.",
        *_more(plan),
        "",
        "| | |",
        "|---|--:|",
        f"| frames acknowledged | {found.acknowledged} |",
        f"| of them indexed, or in a state that says why not | {found.indexed}, {found.stated} |",
        f"| of the indexed, looked for by a query of themselves, found | {found.looked_for}, "
        f"{found.found} |",
        f"| **lost** | **{figures.lost}** |",
    ]
    if plan.retention_s is not None:
        lines.append(f"| deleted as they were too old, and told to have been | {found.aged} |")
    if plan.offline:
        lines.append(
            f"| frames spooled by the robot that was offline, sent again, doubled | "
            f"{figures.spooled}, {figures.spooled_twice}, {found.doubled} |"
        )
    if plan.asynchronous:
        lines.append(
            f"| acknowledged, and not received by the standby when its primary died: missing, of "
            f"those that only the dead primary has | {len(found.missing)}, {figures.window} |"
        )
    lines += [
        f"| **stored twice; there, and nobody was told; half-written, by `sceneprint fsck`** | "
        f"**{found.doubled}, {found.strangers}, {figures.damaged}** |",
        f"| files that nothing refers to (fsck removes them) | {figures.leftovers} |",
        f"| events of frames that were not heard, or heard twice | "
        f"{found.unheard}, {found.heard_twice} |",
        f"| answers and lists that differ between the services | {found.disagreeing} |",
        f"| queries answered, requests sent again, errors | {figures.answers.total()}, "
        f"{figures.repeated}, {len(figures.faults)} |",
        *(
            f"| {kind}: median, p99 | {p50:,.0f}, {p99:,.0f} ms |"
            for kind, (p50, p99) in figures.waits_ms.items()
        ),
        f"| of a frame, all writers wait for one; those of its map do | "
        f"{figures.turn_ms[0]:.1f}, {figures.turn_ms[1]:.1f} ms |",
        f"| most memory of a service's process, of a worker's | {figures.memory[0] / 1e6:,.0f}, "
        f"{figures.memory[1] / 1e6:,.0f} MB |",
        "",
    ]
    lines += [
        "| killed | longest that a robot had no answer, s |",
        "|---|--:|",
        *(
            f"| {victim} | {', '.join(f'{one:.1f}' for one in sorted(waits))} |"
            for victim, waits in sorted(figures.outages.items())
        ),
        "",
    ]
    for one in figures.promotions:
        back = ", ".join(f"{seconds:.1f}" for seconds in one.resumed.values())
        lines.append(
            f"Primary dead for {one.promoted - one.killed:.1f} s until the standby was promoted; "
            f"each service answered {back} s after that."
        )
    return [*lines, ""]


def _more(plan: Plan) -> list[str]:
    """What else such a run has, as sentences."""
    found = []
    if plan.freezes:
        often = _often(plan.freezes)
        found.append(f"The primary was frozen {often} for {FROZEN_S:g} s (SIGSTOP).")
    if plan.partitions:
        often = _often(plan.partitions)
        found.append(f"A host was cut off {often} from its servers for {CUT_OFF_S:g} s.")
    if plan.retention_s is not None:
        found.append(
            f"Three of four robots have maps that keep a frame for {plan.retention_s:g} s, so that "
            "frames go as fast as they come."
        )
    if plan.offline:
        found.append(
            "One more robot was offline for a simulated hour, at one frame every ten seconds; its "
            f"{plan.offline} frames were spooled at once."
        )
    return found


def _often(n: int) -> str:
    return {1: "once", 2: "twice"}.get(n, f"{n} times")


def main(arguments: list[str] | None = None) -> int:
    """Run it; exit code 1 where anything was lost, doubled, half there or wrong."""
    plan = Plan()
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=plan.seconds)
    parser.add_argument("--robots", type=int, default=plan.robots)
    parser.add_argument("--rate", type=float, default=plan.rate, help="frames a second of each")
    parser.add_argument("--kills", type=int, default=plan.kills, help="of services and workers")
    parser.add_argument("--promotions", type=int, default=plan.promotions, help="of the standby")
    parser.add_argument("--seed", type=int, default=plan.seed)
    parser.add_argument("--services", type=int, default=plan.services)
    parser.add_argument("--workers", type=int, default=plan.workers)
    parser.add_argument("--freezes", type=int, default=plan.freezes, help="of the primary")
    parser.add_argument("--partitions", type=int, default=plan.partitions, help="of a host")
    parser.add_argument("--offline", type=int, default=plan.offline, help="frames of a spool")
    parser.add_argument("--retention-s", type=float, help="of maps of single robots")
    parser.add_argument("--objects", action="store_true", help="blobs in an object store")
    parser.add_argument("--delays", action="store_true", help="messages to the servers take time")
    parser.add_argument(
        "--asynchronous", action="store_true",
        help="the standby need not have what is acknowledged, and is cut off for a while first",
    )  # fmt: skip
    parser.add_argument("--data", type=Path, help="folder of recordings; default: synthetic rooms")
    parser.add_argument("--page", type=Path, help="whose figures to replace")
    parser.add_argument("--keep", type=Path, help="new folder for data and logs, left there")
    options = vars(parser.parse_args(arguments))
    page, keep = options.pop("page"), options.pop("keep")
    plan = replace(plan, **options)
    with (
        ended_by_signals(),
        tempfile.TemporaryDirectory(prefix="sceneprint-fleet-", ignore_cleanup_errors=True) as made,
    ):
        folder = Path(made)
        if keep is not None:
            keep.mkdir(parents=True)
            folder = keep
        figures = drive(folder, plan)
    for line in [*figures.faults[:20], *figures.exceeded]:
        print(line, file=sys.stderr)
    machine = describe_machine()
    when = (
        f"Measured {datetime.now(UTC):%Y-%m-%d} on {machine.processor}, "
        f"{machine.cores} processors, within {figures.seconds:.0f} s; `make fleet`."
    )
    lines = ["", when, "", *table(figures)]
    print("\n".join(lines))
    if page is not None:
        put_between(page, *marks(plan), lines)
    return 0 if figures.sound else 1


if __name__ == "__main__":
    sys.exit(main())
