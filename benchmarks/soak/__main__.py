"""`make soak`: kill and crowd the service, and print what was lost.

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
from benchmarks.soak.checking import CrowdFigures
from benchmarks.soak.crowd import STABLE, crowd
from benchmarks.soak.kills import KillFigures, kill
from benchmarks.soak.load import shots

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


def main() -> int:
    """Run all of it; exit code 1 where anything was lost, doubled, locked or wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--frames", type=int, default=800, help="that are uploaded meanwhile")
    parser.add_argument("--seconds", type=float, default=120, help="of writers and readers")
    parser.add_argument("--crowd", type=int, default=8, help="writers, and as many readers")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--page", type=Path, help="whose figures to replace")
    options = parser.parse_args()
    every = shots(max(options.frames, STABLE + 40 * options.crowd))
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
    lines = ["", when, "", *table(of_kills, of_crowd)]
    print("\n".join(lines))
    if options.page is not None:
        put_between(options.page, BEGIN, END, lines)
    lost = of_kills.lost + of_kills.doubled + of_kills.half_written
    wrong = of_kills.differing + of_kills.wrong + len(of_crowd.wrong) + len(of_crowd.errors)
    idle = 0 in (of_crowd.uploads, of_crowd.deletions, of_crowd.answers)  # nothing was tried
    return int(bool(lost + wrong + of_crowd.locked) or idle)


if __name__ == "__main__":
    sys.exit(main())
