"""The first table of `make bench`: a query stage by stage beside references."""

from __future__ import annotations

from benchmarks.encode import EncodeFigures
from benchmarks.search import SearchFigures
from benchmarks.service import ServiceFigures

#: What one core of an early machine could reach, milliseconds: estimates from the number of
#: operations and the bytes that have to be read.
LIMITS = {"sign, with geometry": "18.5", "retrieve": "1.5", "diversify": "0.2", "validate": "16"}


def table(encode: EncodeFigures, search: SearchFigures, service: ServiceFigures) -> list[str]:
    """A query stage by stage, as lines of Markdown."""
    lines = [
        "### A query, stage by stage",
        "",
        "| stage | now, ms | / FPFH of one frame | limit of one core, ms (estimate) |",
        "|---|--:|--:|--:|",
    ]
    for stage, ms in service.stages.items():
        lines.append(f"| {stage} | {ms:.1f} | {_share(ms, encode)} | {LIMITS.get(stage, '')} |")
    lines += [
        f"| **sum** | **{service.library:.1f}** | **{_share(service.library, encode)}** | 40 |",
        f"| search of {search.frames:,} signatures | {search.search:.2f} "
        f"| {_share(search.search, encode)} | |",
        f"| over HTTP, {service.frames:,} frames | {service.http[1]:.1f} "
        f"| {_share(service.http[1], encode)} | |",
        "",
    ]
    return lines


def _share(ms: float, encode: EncodeFigures) -> str:
    return _cell(None if encode.fpfh is None else ms / encode.fpfh, 2)


def _cell(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"
