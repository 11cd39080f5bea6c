"""`make soak`: kill and crowd the service, shift its clocks, and print what was lost.

`python -m benchmarks.soak --page docs/reliability.md` puts the figures into the page.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from datetime import UTC, datetime
from pathlib import Path

from benchmarks.machine import describe_machine
from benchmarks.pages import put_between
from benchmarks.soak.clocks import ClockFigures, find_library, jump_clocks
from benchmarks.soak.crowd import STABLE, crowd
from benchmarks.soak.crowd_audit import CrowdFigures
from benchmarks.soak.kills import KillFigures, kill
from benchmarks.soak.load import Shot, shots

BEGIN, END = "<!-- soak:begin -->", "<!-- soak:end -->"


def table(kills: KillFigures, crowded: CrowdFigures) -> list[str]:
    """The figures as lines of Markdown."""
    victims = ", ".join(f"{n} of {name}" for name, n in sorted(kills.kills.items()))
    return [
        f"### {sum(kills.kills.values())} kills within {kills.seconds:.0f} s",
        "",
        f"SIGKILL of {victims}, under load.",
        "",
        "| | |",
        "|---|--:|",
        f"| uploads acknowledged, of them deleted again | {kills.acknowledged}, {kills.deleted} |",
        f"| **lost** | **{kills.lost}** |",
        f"| **signed or stored twice with effect** | **{kills.doubled}** |",
        f"| **changes without their event or audit line** | **{kills.separated}** |",
        f"| **half-written, by `sceneprint fsck`** | **{kills.half_written}** |",
        f"| files that nothing refers to (fsck removes them) | {kills.leftovers} |",
        f"| signatures other than those of the undisturbed run | {kills.differing} |",
        f"| answers other than those of the undisturbed run, of {kills.queries} | {kills.wrong} |",
        f"| uploads and deletions that had to be sent again | {kills.retries} |",
        f"| most tries of a job | {kills.tries} |",
        "",
        f"### {crowded.writers} writers and {crowded.readers} readers for {crowded.seconds:.0f} s",
        "",
        "| | |",
        "|---|--:|",
        f"| uploads, deletions, answers | {crowded.uploads}, {crowded.deletions}, "
        f"{crowded.answers} |",
        f'| **"database is locked"** | **{crowded.locked}** |',
        f"| **errors of any process** | **{len(crowded.errors)}** |",
        f"| **wrong answers** | **{len(crowded.wrong)}** |",
        "",
    ]


def clock_table(clocks: ClockFigures | None) -> list[str]:
    """The figures of clocks as lines of Markdown; None: not tried."""
    if clocks is None:
        return ["### Clocks that jump", "", "Not tried: libfaketime is not installed.", ""]
    held = clocks.held
    return [
        f"### {clocks.jumps} jumps of all clocks, by one or two years",
        "",
        "| | |",
        "|---|--:|",
        f"| uploads acknowledged, of them deleted again | {held.acknowledged}, {held.deleted} |",
        f"| jobs that waited or ran at a jump | {clocks.waiting} |",
        f"| longest from a jump until no job waited | {clocks.longest_s:.0f} s |",
        f"| **lost** | **{held.lost}** |",
        f"| **signed or stored twice with effect** | **{held.doubled}** |",
        f"| **half-written, by `sceneprint fsck`** | **{held.half_written}** |",
        f"| signatures, answers other than those of the undisturbed run | {held.differing}, "
        f"{held.wrong} of {held.queries} |",
        f"| **removed before their `retention_days` were over by any clock** | "
        f"**{clocks.removed}** |",
        f"| of 3 kept for 30 days, removed once the clock was a year ahead | {clocks.due} |",
        "",
    ]


def main() -> int:
    """Run all of it; exit code 1 where anything was lost, doubled, locked or wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--frames", type=int, default=800, help="that are uploaded meanwhile")
    parser.add_argument("--seconds", type=float, default=120, help="of writers and readers")
    parser.add_argument("--crowd", type=int, default=8, help="writers, and as many readers")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--clock-frames", type=int, default=147, help="uploaded while clocks jump")
    parser.add_argument(
        "--faketime", type=Path, default=find_library(), help="libfaketimeMT.so.1, where not found"
    )
    parser.add_argument("--only-clocks", action="store_true", help="print their table alone")
    parser.add_argument("--page", type=Path, help="whose figures to replace")
    options = parser.parse_args()
    every = shots(max(options.frames, STABLE + 40 * options.crowd, options.clock_frames))
    if options.only_clocks:
        of_clocks = _clocks(every[: options.clock_frames], options.faketime)
        print("\n".join(clock_table(of_clocks)))
        return int(of_clocks is None or not of_clocks.sound)
    of_clocks = _clocks(every[: options.clock_frames], options.faketime)
    with tempfile.TemporaryDirectory(prefix="sceneprint-soak-") as folder:
        kills, crowded = Path(folder) / "kills", Path(folder) / "crowd"
        kills.mkdir()
        crowded.mkdir()
        of_kills = kill(kills, every[: options.frames], options.kills, options.seed)
        print(of_kills)
        of_crowd = crowd(
            crowded, every[: STABLE + 40 * options.crowd], options.crowd, options.crowd,
            options.seconds, options.seed,
        )  # fmt: skip
    for line in (*of_crowd.errors[:20], *of_crowd.wrong[:20]):
        print(line, file=sys.stderr)
    machine = describe_machine()
    when = (
        f"Measured {datetime.now(UTC):%Y-%m-%d} on {machine.processor}, "
        f"{machine.cores} processors; `make soak`."
    )
    lines = ["", when, "", *table(of_kills, of_crowd), *clock_table(of_clocks)]
    print("\n".join(lines))
    if options.page is not None:
        put_between(options.page, BEGIN, END, lines)
    lost = of_kills.lost + of_kills.doubled + of_kills.separated + of_kills.half_written
    wrong = of_kills.differing + of_kills.wrong + len(of_crowd.wrong) + len(of_crowd.errors)
    wrong += of_clocks is not None and not of_clocks.sound
    idle = 0 in (of_crowd.uploads, of_crowd.deletions, of_crowd.answers)  # nothing was tried
    return int(bool(lost + wrong + of_crowd.locked) or idle)


def _clocks(shots: list[Shot], library: Path | None) -> ClockFigures | None:
    if library is None:
        print("clocks are not shifted: install libfaketime, or name it by --faketime")
        return None
    with tempfile.TemporaryDirectory(prefix="sceneprint-soak-") as folder:
        found = jump_clocks(Path(folder), shots, library)
    print(found)
    return found


if __name__ == "__main__":
    sys.exit(main())
