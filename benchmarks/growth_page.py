"""What `benchmarks.growth` measured, as tables, and carried on paper to ten million frames."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime

from benchmarks.curves import MEMORY, TIMES, Line, Point, fit
from benchmarks.disk import DiskFigures
from benchmarks.recall import NEAREST, RANKING, RecallFigures
from sceneprint.index import SHORTLIST

#: Sizes that are measured by nobody.
ON_PAPER = (1_000_000, 10_000_000)
#: How far a line is carried, of the largest map that was measured.
FARTHEST = 100
#: Frames below which a map fits into the processor's caches, and says little of a larger one.
LARGE = 10_000


@dataclass(frozen=True)
class GrowthFigures:
    """What one run measured.

    Parameters
    ----------
    recall : of every kind of map
    curves : by the bytes of a signature
    disk : of a frame, with each preset; empty in the small version
    noise : by the bytes of a signature: median distance of two takes of one pose, of that of
        unrelated frames
    """

    recall: list[RecallFigures]
    curves: dict[int, list[Point]]
    disk: list[DiskFigures]
    noise: dict[int, float]


def lines_of(points: list[Point]) -> dict[str, Line]:
    """A line through every curve: TIMES in milliseconds, MEMORY and "disk" in megabytes.

    Of maps of LARGE frames and more, where there are two. A map no larger than the shortlist is
    compared whole: its search says nothing of larger ones.
    """
    large = [p for p in points if p.frames >= LARGE]
    points = large if len(large) > 1 else points
    rows = {name: [(p.frames, p.milliseconds[name]) for p in points] for name in TIMES}
    rows["search"] = [row for row in rows["search"] if row[0] > SHORTLIST]
    rows |= {name: [(p.frames, max(p.megabytes[name], 0.1)) for p in points] for name in MEMORY}
    rows["disk"] = [(p.frames, p.disk * p.frames / 1e6) for p in points]
    return {name: fit(*zip(*row, strict=True)) for name, row in rows.items()}


def table(figures: GrowthFigures) -> list[str]:
    """Recall and curves as lines of Markdown."""
    lines = _recall(figures.recall)
    for length, points in figures.curves.items():
        lines += _curves(length, points)
    return lines + (_disk(figures.disk) if figures.disk else [])


def section(figures: GrowthFigures, picture: str) -> list[str]:
    """The whole section of docs/performance.md, whose picture lies beside it."""
    apart = ", ".join(f"{share:.2f} ({length:,} bytes)" for length, share in figures.noise.items())
    return [
        f"Measured {datetime.now(UTC):%Y-%m-%d}. The machine is shared: compare ratios, not "
        "milliseconds.",
        "",
        f"![Time, memory and disk against the number of frames]({picture})",
        "",
        *table(figures),
        f"Two takes from one pose differ by {apart} of the median distance of unrelated frames.",
        "",
    ]


def _recall(found: list[RecallFigures]) -> list[str]:
    lengths = list(found[0].recall)
    lines = [
        f"### recall@{NEAREST} of a shortlist, beside the exact scan",
        "",
        "| map | frames | bytes | queries | d10 / d1 | d100 / d10 (quartiles) |"
        + "".join(f" {s} |" for s in lengths),
        "|---|--:|--:|--:|--:|--:|" + "--:|" * len(lengths),
    ]
    for f in found:
        low, high = f.quartiles
        shares = "".join(f" {_share(*f.recall[s])} |" for s in lengths)
        lines.append(
            f"| {f.name} | {f.frames:,} | {f.signature_bytes:,} | {f.queries} | {f.tenth:.2f} "
            f"| {f.hundredth:.2f} ({low:.2f}-{high:.2f}) |{shares}"
        )
        if f.appended:
            own = "".join(f" {f.appended[s]:.4f} |" for s in lengths)
            lines.append(f"| - grown by 1,000 frames at a time | | | | | |{own}")
    lines += [
        "",
        "Medians over the queries, means with their standard error. "
        f"Share of the {RANKING} nearest that is found, which is the longest ranking:",
        "",
        "| map | frames | bytes |" + "".join(f" {s} |" for s in lengths if s >= RANKING),
        "|---|--:|--:|" + "--:|" * sum(s >= RANKING for s in lengths),
    ]
    for f in found:
        own = "".join(f" {share:.3f} |" for share in f.coverage.values())
        lines.append(f"| {f.name} | {f.frames:,} | {f.signature_bytes:,} |{own}")
    return [*lines, ""]


def _share(mean: float, error: float) -> str:
    return f"{mean:.4f} ± {error:.4f}" if error > 0 else f"{mean:.4f}"


def _curves(length: int, points: list[Point]) -> list[str]:
    fitted = lines_of(points)
    lines = [
        f"### Growth, signatures of {length:,} bytes: one thread, warm; memory of a process of "
        "its own",
        "",
        "| frames | " + " | ".join(f"{name}, ms" for name in TIMES) + " | held, MB | mapped, MB "
        "| index, bytes a frame |",
        "|--:|" + "--:|" * (len(TIMES) + 3),
    ]
    lines += [
        f"| {p.frames:,} | "
        + " | ".join(f"{p.milliseconds[name]:,.1f}" for name in TIMES)
        + f" | {p.megabytes['held']:,.0f} | {p.megabytes['mapped']:,.0f} | {p.disk:,.0f} |"
        for p in points
    ]
    for n in (n for n in ON_PAPER if n <= FARTHEST * points[-1].frames):
        times = " | ".join(f"*{fitted[name].at(n):,.0f}*" for name in TIMES)
        lines.append(
            f"| *{n:,}* | {times} | *{fitted['held'].at(n):,.0f}* | | "
            f"*{1e6 * fitted['disk'].at(n) / n:,.0f}* |"
        )
    return [*lines, ""]


def _disk(found: list[DiskFigures]) -> list[str]:
    return [
        "### Disk a frame, beside the index; bytes",
        "",
        "| signature | rows of the database | upload | geometry artifact |",
        "|--:|--:|--:|--:|",
        *(
            f"| {f.signature_bytes:,} | {f.database:,.0f} | {f.uploads:,.0f} | {f.artifacts:,.0f} |"
            for f in found
        ),
        "",
    ]
