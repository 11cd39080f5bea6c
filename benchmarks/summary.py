"""The first table of `make bench`: a query stage by stage beside references, and by version."""

from __future__ import annotations

from dataclasses import dataclass

from benchmarks.encode import EncodeFigures
from benchmarks.search import SearchFigures
from benchmarks.service import ServiceFigures

#: Where the rows of all versions stand in docs/performance.md.
BEGIN, END = "<!-- history:begin -->", "<!-- history:end -->"
HEAD = [
    "| version | measured | signing / FPFH | with artifact | query / FPFH | HTTP, ms "
    "| its processors, ms | eight clients / one |",
    "|---|---|--:|--:|--:|--:|--:|--:|",
]  # fmt: skip
#: What one core of an early machine could reach, milliseconds: estimates from the number of
#: operations and the bytes that have to be read.
LIMITS = {"sign, with geometry": "18.5", "retrieve": "1.5", "diversify": "0.2", "validate": "16"}


@dataclass(frozen=True)
class Version:
    """A row of the history."""

    name: str
    measured: str
    signing: float | None
    with_artifact: float | None
    query: float | None
    http: float
    processors: float | None
    crowd: float | None

    def row(self) -> str:
        """As a line of Markdown."""
        ratios = (self.signing, self.with_artifact, self.query)
        cells = [
            self.name, self.measured, *(_cell(one, 2) for one in ratios), _cell(self.http, 0),
            _cell(self.processors, 0), _cell(self.crowd, 2),
        ]  # fmt: skip
        return f"| {' | '.join(cells)} |"


def version_of(name: str, measured: str, encode: EncodeFigures, service: ServiceFigures) -> Version:
    """What a run says of the version that it measured.

    Parameters
    ----------
    name, measured : of the version, and the day
    encode : of the preset `depth`
    service : of the same run
    """
    query = None if encode.fpfh is None else service.library / encode.fpfh
    return Version(
        name, measured, encode.ratio, encode.ratio_with_artifact, query, service.http[1],
        service.cpu[1], service.gain,
    )  # fmt: skip


def with_version(page: str, version: Version) -> str:
    """A page whose history has the row of a version, in the place of an earlier one of its name.

    Raises
    ------
    ValueError : the page has no history.
    """
    before, found, rest = page.partition(BEGIN)
    history, ended, after = rest.partition(END)
    if not found or not ended:
        raise ValueError(f"the page has no section from {BEGIN} to {END}")
    rows = [line for line in history.splitlines() if line.startswith("| ")][1:]
    rows = [row for row in rows if not row.startswith(f"| {version.name} |")]
    lines = [BEGIN, *HEAD, *rows, version.row(), END]
    return before + "\n".join(lines) + after


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
