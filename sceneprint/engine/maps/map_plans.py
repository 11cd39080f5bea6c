"""Maps seen from above: plans of their coverage, compared and drawn, and pictures of their surface.

positions, queried frames  --coverage_plans-->  CoveragePlan of each parent frame
plans before, plans after  --plan_changes-->  cells that became better or worse
CoveragePlan, DrawnFrame, points  --coverage_picture-->  PNG
axes, box  --plan_frame-->  PlanFrame
PlanFrame, points  --surface_picture-->  PNG, transparent where nothing is
"""

from __future__ import annotations

import io
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sceneprint.engine.search.up_vectors import PlanAxes
from sceneprint.types import Bytes, Floats
from sceneprint_client.api.coverage import (
    COVERAGE_OUTCOMES,
    CellChange,
    CellTrend,
    CoverageCell,
    CoverageOutcome,
    CoveragePlan,
    CoverageResult,
    PlanChanges,
)

if TYPE_CHECKING:
    from PIL import ImageDraw

#: Cells along the longer side of a plan, about.
_CELLS_ALONG = 20
#: Least width of cells that nobody asked for, metres.
_LEAST_CELL_M = 0.25
#: Most cells of all plans together: wider ones are taken where there would be more.
MOST_CELLS = 10_000

#: Farthest column and row: JSON has numbers beyond that no longer exactly.
_FARTHEST_CELL = 2**52

#: Column and row of a cell.
Place = tuple[int, int]


@dataclass(frozen=True, eq=False)
class QueriedPosition:
    """Where a queried frame was taken, (3,) in its parent frame, and what became of it."""

    at: Floats
    outcome: CoverageOutcome


def cell_width(extent_m: float) -> float:
    """Width of cells for a plan whose longer side is that long, metres: 0.25, 0.5, 1, 2, 5, 10."""
    wanted = max(extent_m / _CELLS_ALONG, _LEAST_CELL_M)
    steps = [
        _LEAST_CELL_M,
        0.5,
        *(digit * 10.0**power for power in range(6) for digit in (1, 2, 5)),
    ]
    return min(steps, key=lambda step: abs(math.log(step / wanted)))


def coverage_plans(
    queried: Mapping[str, Sequence[QueriedPosition]], taken: Mapping[str, Floats],
    axes: Mapping[str, PlanAxes], cell_m: float | None,
) -> tuple[list[CoveragePlan], float]:  # fmt: skip
    """Count frames by cell.

    Parameters
    ----------
    queried : frames by parent frame
    taken : (n, 3) where all frames of the map were taken, by parent frame
    axes : of each parent frame of `queried`
    cell_m : width of the cells; None for one that fits

    Returns
    -------
    plans : in the order of `queried`
    cell_m : width of their cells; a multiple of what was asked for where that gives too many
    """
    flat_taken = {name: taken.get(name, np.empty((0, 3))) @ axes[name].axes.T for name in queried}
    flat_queried = {
        name: np.array([one.at for one in some]) @ axes[name].axes.T
        for name, some in queried.items()
    }
    if cell_m is None:
        every = [np.concatenate([flat_taken[name], flat_queried[name]]) for name in queried]
        cell_m = cell_width(max((float(np.ptp(flat, axis=0).max()) for flat in every), default=0.0))
    while True:
        counted = {
            name: (_places(flat_taken[name], cell_m), _places(flat_queried[name], cell_m))
            for name in queried
        }
        if sum(len({*all_of, *some}) for all_of, some in counted.values()) <= MOST_CELLS:
            break
        cell_m *= 2
    plans = [
        CoveragePlan(
            parent_frame=name,
            x_axis=axes[name].axes[0].tolist(),
            y_axis=axes[name].axes[1].tolist(),
            up_from=axes[name].up_from,
            cells=_cells(Counter(all_of), some, [one.outcome for one in queried[name]]),
        )
        for name, (all_of, some) in counted.items()
    ]
    return plans, cell_m


def _places(flat: Floats, cell_m: float) -> list[Place]:
    # a pose may be of any size: those beyond lie in the outermost cell
    places = np.clip(np.floor(flat / cell_m), -_FARTHEST_CELL, _FARTHEST_CELL)
    return [(column, row) for column, row in places.astype(np.int64).tolist()]


def _cells(
    taken: Mapping[Place, int], queried: Sequence[Place], outcomes: Sequence[CoverageOutcome]
) -> list[CoverageCell]:
    counted: dict[Place, Counter[str]] = {}
    for place, outcome in zip(queried, outcomes, strict=True):
        counted.setdefault(place, Counter())[outcome] += 1
    return [
        CoverageCell(
            column=column, row=row, frames=taken.get((column, row), 0),
            **{name: counted.get((column, row), Counter())[name] for name in COVERAGE_OUTCOMES},
        )
        for column, row in sorted({*taken, *counted}, key=lambda place: place[::-1])
    ]  # fmt: skip


# Two results of a map compared, cell by cell.


def queried_in(cell: CoverageCell) -> int:
    """How many frames of a cell were queried."""
    return sum(getattr(cell, name) for name in COVERAGE_OUTCOMES)


def localisability(cell: CoverageCell) -> float:
    """Mean over the queried frames of a cell: 1 for found, -1 for wrong, 0 otherwise."""
    return (cell.found - cell.wrong) / queried_in(cell)


def plan_changes(
    before: Sequence[CoveragePlan], after: Sequence[CoveragePlan]
) -> list[PlanChanges]:
    """Cells that have queried frames in either of two results, by parent frame.

    Parameters
    ----------
    before, after : plans with cells of one width and, of one parent frame, the same axes
    """
    names = dict.fromkeys(plan.parent_frame for plan in (*after, *before))
    told = []
    for name in names:
        earlier, later = _by_place(before, name), _by_place(after, name)
        places = sorted({*earlier, *later}, key=lambda place: place[::-1])
        changes = [_change(place, earlier.get(place), later.get(place)) for place in places]
        known = [one for one in changes if one is not None]
        told.append(PlanChanges(parent_frame=name, cells=known))
    return told


def _by_place(plans: Sequence[CoveragePlan], name: str) -> dict[Place, CoverageCell]:
    return {
        (cell.column, cell.row): cell
        for plan in plans
        if plan.parent_frame == name
        for cell in plan.cells
    }


def _change(
    place: Place, before: CoverageCell | None, after: CoverageCell | None
) -> CellChange | None:
    was = before is not None and queried_in(before) > 0
    is_now = after is not None and queried_in(after) > 0
    trend: CellTrend
    if before is not None and after is not None and was and is_now:
        change = localisability(after) - localisability(before)
        trend = "better" if change > 0 else "worse" if change < 0 else "same"
    elif was or is_now:
        trend = "new" if is_now else "gone"
    else:
        return None
    return CellChange(column=place[0], row=place[1], trend=trend, before=before, after=after)


# A plan as a picture: what its frames see, cells coloured by outcome, dots.

#: A point or a size: on the plan in metres, of the picture in pixels.
Pair = tuple[float, float]

#: Of dots; cells have the same, paler. Told apart without red and green, and by their shapes.
COLOURS: dict[CoverageOutcome, tuple[int, int, int]] = {
    "found": (27, 158, 119), "wrong": (117, 30, 140), "ambiguous": (230, 159, 0),
    "not_found": (200, 40, 40),
}  # fmt: skip
_LABELS: dict[CoverageOutcome, str] = {
    "found": "found",
    "wrong": "wrong place",
    "ambiguous": "ambiguous",
    "not_found": "not found",
}
_NOT_QUERIED = (226, 229, 233)
_INK, _FAINT, _PAPER = (34, 38, 46), (116, 122, 132), (255, 255, 255)
#: How opaque cells are: what frames see shows through.
_CELL_OPACITY = 110
#: Of surfaces seen, where most of them stand upright; pixels of a dot of them; percentiles of
#: their points that are shown.
_SURFACE, _SURFACE_PIXELS, _SHOWN = (96, 102, 112), 2, (1.0, 99.0)
#: Samples along each edge of a pixel.
_FINER = 2
#: Of the picture, pixels: width, and height of the footer with the legend.
WIDTH, FOOTER = 1400, 84
#: Most and least height of the plan, margins, header.
_TALLEST, _LOWEST, _MARGIN, _HEADER = 1400, 240, 44, 92
#: Widest cell, pixels: a plan of few cells does not fill the picture.
_WIDEST_CELL = 96.0
#: Most lines to look-alikes; more would hide the plan.
_MOST_LINKS = 400


@dataclass(frozen=True)
class DrawnFrame:
    """A queried frame on a plan.

    Parameters
    ----------
    at : where it was taken, metres along the axes of the plan
    outcome : what became of it
    look_alikes : where frames were taken that it is mistaken for
    """

    at: Pair
    outcome: CoverageOutcome
    look_alikes: tuple[Pair, ...]


@dataclass(frozen=True)
class _Sheet:
    """Where metres of a plan are in the picture, in fine pixels.

    Parameters
    ----------
    left, top : metres at the plan's upper left corner, which is at `origin`
    scale : fine pixels of a metre
    """

    left: float
    top: float
    scale: float
    origin: Pair
    size: tuple[int, int]

    @property
    def plan_rows(self) -> tuple[int, int]:
        """First and last row of the picture between header and footer."""
        return _FINER * _HEADER, self.size[1] - _FINER * FOOTER

    def pixel(self, at: Pair) -> Pair:
        x, y = self.origin
        return x + (at[0] - self.left) * self.scale, y + (self.top - at[1]) * self.scale


def coverage_picture(
    plan: CoveragePlan, result: CoverageResult, drawn: Sequence[DrawnFrame], points: Floats,
    title: str,
) -> bytes:  # fmt: skip
    """A plan as a PNG on white, seen from above.

    Parameters
    ----------
    plan : its cells
    result : of the whole map, told in the header
    drawn : queried frames of the plan
    points : (n, 2) of surfaces that frames see, metres along the axes of the plan
    title : over the picture
    """
    from PIL import Image, ImageDraw

    sheet = _sheet(plan, result.cell_m, points)
    image = Image.fromarray(_surfaces(sheet, points))
    draw = ImageDraw.Draw(image, "RGBA")
    for cell in plan.cells:
        _draw_cell(draw, sheet, cell, result.cell_m)
    links = [(one.at, there) for one in drawn for there in one.look_alikes]
    for here, there in links[:: -(-len(links) // _MOST_LINKS) or 1]:
        draw.line([sheet.pixel(here), sheet.pixel(there)], fill=(*_INK, 90), width=_FINER)
    radius = _FINER * min(max(0.11 * result.cell_m * sheet.scale / _FINER, 3.0), 7.0)
    # what is found last of all lies undermost: failures must be seen
    for outcome in ("found", "not_found", "ambiguous", "wrong"):
        for one in drawn:
            if one.outcome == outcome:
                _draw_dot(draw, sheet.pixel(one.at), outcome, radius)
    for cell in plan.cells:
        _draw_count(draw, sheet, cell, result.cell_m)
    _draw_header(draw, result, drawn, title)
    _draw_footer(draw, sheet, with_links=bool(links))
    small = image.resize((sheet.size[0] // _FINER, sheet.size[1] // _FINER), Image.Resampling.BOX)
    buffer = io.BytesIO()
    small.save(buffer, "PNG")
    return buffer.getvalue()


def cell_outcome(cell: CoverageCell) -> CoverageOutcome | None:
    """What colours a cell: `wrong` where any frame is, else what most queried frames have, of
    equally many the worse; None where none was queried.
    """
    if not queried_in(cell):
        return None
    if cell.wrong:
        return "wrong"
    worst_first: tuple[CoverageOutcome, ...] = ("not_found", "ambiguous", "found")
    return max(worst_first, key=lambda name: getattr(cell, name))


def _sheet(plan: CoveragePlan, cell_m: float, points: Floats) -> _Sheet:
    """Room for all cells, and for the surfaces but for a few stray points."""
    places = np.array([(cell.column, cell.row) for cell in plan.cells])
    low, high = places.min(axis=0), places.max(axis=0) + 1
    if len(points):
        first, last = np.percentile(points / cell_m, _SHOWN, axis=0)
        low = np.minimum(low, np.floor(first)).astype(np.int64)
        high = np.maximum(high, np.ceil(last)).astype(np.int64)
    columns, rows = (high - low).tolist()
    cell = min((WIDTH - 2 * _MARGIN) / columns, _TALLEST / rows, _WIDEST_CELL)
    height = max(round(rows * cell), _LOWEST)
    left = (WIDTH - columns * cell) / 2
    top = _HEADER + (height - rows * cell) / 2
    return _Sheet(
        float(low[0] * cell_m), float(high[1] * cell_m), _FINER * cell / cell_m,
        (_FINER * left, _FINER * top),
        (_FINER * WIDTH, _FINER * (_HEADER + height + FOOTER)),
    )  # fmt: skip


def _surfaces(sheet: _Sheet, points: Floats) -> Bytes:
    """(h, w, 3) picture of what frames see, the darker the more of it stands upright there."""
    width, height = sheet.size
    picture = np.full((height, width, 3), 255, np.uint8)
    if not len(points):
        return picture
    step = _SURFACE_PIXELS * _FINER
    x = (sheet.origin[0] + (points[:, 0] - sheet.left) * sheet.scale) // step
    y = (sheet.origin[1] + (sheet.top - points[:, 1]) * sheet.scale) // step
    low, high = sheet.plan_rows
    counts, _, _ = np.histogram2d(
        y, x, bins=(height // step, width // step),
        range=((0, height // step), (0, width // step)),
    )  # fmt: skip
    most = np.percentile(counts[counts > 0], 98) if counts.any() else 1.0
    shade = np.minimum(np.sqrt(counts / most), 1.0)[..., None]
    grey = np.rint(255 - shade * (255 - np.array(_SURFACE))).astype(np.uint8)
    large = grey.repeat(step, axis=0).repeat(step, axis=1)
    picture[low:high, : large.shape[1]] = large[low:high]
    return picture


def _draw_cell(draw: ImageDraw.ImageDraw, sheet: _Sheet, cell: CoverageCell, cell_m: float) -> None:
    corners = (
        sheet.pixel((cell.column * cell_m, (cell.row + 1) * cell_m)),
        sheet.pixel(((cell.column + 1) * cell_m, cell.row * cell_m)),
    )
    outcome = cell_outcome(cell)
    fill = (*(_NOT_QUERIED if outcome is None else COLOURS[outcome]), _CELL_OPACITY)
    draw.rectangle(corners, fill=fill, outline=_PAPER, width=_FINER)


def _draw_count(
    draw: ImageDraw.ImageDraw, sheet: _Sheet, cell: CoverageCell, cell_m: float
) -> None:
    """How many frames a cell has, where there is room."""
    if cell_m * sheet.scale < 26 * _FINER:
        return
    x, y = sheet.pixel((cell.column * cell_m, (cell.row + 1) * cell_m))
    place = (x + 4 * _FINER, y + 2 * _FINER)
    draw.text(place, str(cell.frames), _INK, _font(11), stroke_width=_FINER, stroke_fill=_PAPER)


def _draw_dot(draw: ImageDraw.ImageDraw, at: Pair, outcome: CoverageOutcome, r: float) -> None:
    """A disc, a square, a triangle or a diamond, by outcome."""
    x, y = at
    colour, edge = COLOURS[outcome], _PAPER
    if outcome == "found":
        draw.ellipse((x - r, y - r, x + r, y + r), colour, edge, _FINER)
    elif outcome == "not_found":
        draw.rectangle((x - r, y - r, x + r, y + r), colour, edge, _FINER)
    else:
        far = 1.35 * r
        shape = [(x, y - far), (x + far, y), (x, y + far), (x - far, y)]
        if outcome == "ambiguous":
            shape = [(x, y - far), (x + far, y + r), (x - far, y + r)]
        draw.polygon(shape, colour, edge, _FINER)


def _draw_header(
    draw: ImageDraw.ImageDraw, result: CoverageResult, drawn: Sequence[DrawnFrame], title: str
) -> None:
    left = _MARGIN * _FINER
    draw.text((left, 20 * _FINER), _fitting(draw, title, 22), _INK, _font(22))
    shares = ", ".join(
        f"{_LABELS[name]} {getattr(result, name) / max(result.frames, 1):.0%}"
        for name in COVERAGE_OUTCOMES
    )
    text = (
        f"{result.frames} frames queried against the rest of {result.map_frames}: {shares}. "
        f"{len(drawn)} on this plan. Map revision {result.last_revision}."
    )
    draw.text((left, 54 * _FINER), _fitting(draw, text, 15), _FAINT, _font(15))


def _draw_footer(draw: ImageDraw.ImageDraw, sheet: _Sheet, *, with_links: bool) -> None:
    """Legend, and a scale bar at the right."""
    middle = sheet.size[1] - 0.5 * FOOTER * _FINER
    x = float(_MARGIN * _FINER)
    font = _font(15)

    def label(text: str) -> None:
        nonlocal x
        draw.text((x, middle), text, _INK, font, anchor="lm")
        x += draw.textlength(text, font) + 22 * _FINER

    for name in COVERAGE_OUTCOMES:
        _draw_dot(draw, (x + 6 * _FINER, middle), name, 6 * _FINER)
        x += 18 * _FINER
        label(_LABELS[name])
    side = 7 * _FINER
    box = (x, middle - side, x + 2 * side, middle + side)
    draw.rectangle(box, (*_NOT_QUERIED, _CELL_OPACITY), _FAINT)
    x += 2 * side + 6 * _FINER
    label("not queried")
    draw.rectangle((x, middle - side, x + 2 * side, middle + side), _SURFACE)
    x += 2 * side + 6 * _FINER
    label("surfaces")
    if with_links:
        draw.line([(x, middle), (x + 18 * _FINER, middle)], (*_INK, 120), _FINER)
        x += 24 * _FINER
        label("look-alike")
    label("number: frames in the cell")
    length = _bar_m((sheet.size[0] / 6) / sheet.scale)
    right = sheet.size[0] - _MARGIN * _FINER
    start = right - length * sheet.scale
    for end in (start, right):
        draw.line([(end, middle - 5 * _FINER), (end, middle + 5 * _FINER)], _INK, 2 * _FINER)
    draw.line([(start, middle), (right, middle)], _INK, 2 * _FINER)
    draw.text(((start + right) / 2, middle - 8 * _FINER), f"{length:g} m", _INK, font, anchor="mb")


def _bar_m(most: float) -> float:
    """The longest of 1, 2, 5, 10 and so on that is no longer than that, metres."""
    power = 10.0 ** np.floor(np.log10(most))
    return float(max(step * power for step in (1, 2, 5) if step * power <= most))


def _fitting(draw: ImageDraw.ImageDraw, text: str, size: int) -> str:
    """A text that fits the picture's width; its end is left out where it does not."""
    room, font = (WIDTH - 2 * _MARGIN) * _FINER, _font(size)
    if draw.textlength(text, font) <= room:
        return text
    while text and draw.textlength(f"{text}…", font) > room:
        text = text[:-1]
    return f"{text}…"


def _font(size: int) -> Any:
    from PIL import ImageFont

    return ImageFont.load_default(size * _FINER)


# A surface as a picture: the darker the more of it stands upright there.

#: Read on white and on black alike; how opaque a single cell is, and a wall.
_COLOUR, _OPACITIES = (122, 130, 143), (90.0, 255.0)
#: Percentile of the counts of pixels that is fully opaque.
_FULL = 97.0


@dataclass(frozen=True)
class PlanFrame:
    """Where a picture lies on a plan.

    Parameters
    ----------
    m_per_pixel : metres
    width, height : pixels
    left, top : of the upper left corner along the axes, metres
    """

    m_per_pixel: float
    width: int
    height: int
    left: float
    top: float


def plan_frame(
    axes: Floats, low: Sequence[float], high: Sequence[float], cell_m: float, longer: int
) -> PlanFrame:
    """Room for a box.

    Parameters
    ----------
    axes : (2, 3) to the right and to the top
    low, high : (3,) corners of the box, metres
    cell_m : no side is shorter
    longer : pixels of the longer side
    """
    ends = np.stack([low, high])
    corners = np.array([[ends[i, 0], ends[j, 1], ends[k, 2]]
                        for i in (0, 1) for j in (0, 1) for k in (0, 1)]) @ axes.T  # fmt: skip
    first, last = corners.min(axis=0), corners.max(axis=0)
    width, height = np.maximum(last - first, cell_m).tolist()
    pixel = max(width, height) / longer
    sizes = [min(max(math.ceil(side / pixel - 1e-9), 1), longer) for side in (width, height)]
    return PlanFrame(pixel, sizes[0], sizes[1], float(first[0]), float(last[1]))


def surface_picture(
    plan: PlanFrame, axes: Floats, points: Iterable[Floats], cell_m: float,
    heights: tuple[float | None, float | None],
) -> bytes:  # fmt: skip
    """A picture as a PNG.

    Parameters
    ----------
    plan : where it lies
    axes : (2, 3) of the plan
    points : (N, 3) of each tile, metres
    cell_m : width of their cells
    heights : only what lies between these, metres along up; None for no limit
    """
    from PIL import Image

    # no finer than the cells: there would be gaps between them
    step = max(plan.m_per_pixel, cell_m)
    columns, rows = (
        max(math.ceil(side * plan.m_per_pixel / step), 1) for side in (plan.width, plan.height)
    )
    counts = np.zeros((rows, columns))
    up = np.cross(axes[0], axes[1])
    for some in points:
        height = some @ up
        inside = np.ones(len(some), bool)
        if heights[0] is not None:
            inside &= height >= heights[0]
        if heights[1] is not None:
            inside &= height <= heights[1]
        flat = some[inside] @ axes.T
        x = np.floor((flat[:, 0] - plan.left) / step).astype(np.int64).clip(0, columns - 1)
        y = np.floor((plan.top - flat[:, 1]) / step).astype(np.int64).clip(0, rows - 1)
        np.add.at(counts, (y, x), 1.0)
    shown = counts > 0
    most = max(float(np.percentile(counts[shown], _FULL)), 2.0) if shown.any() else 2.0
    share = np.minimum(np.log2(1.0 + counts) / math.log2(1.0 + most), 1.0)
    picture = np.zeros((rows, columns, 4), np.uint8)
    picture[..., :3] = _COLOUR
    least, full = _OPACITIES
    picture[..., 3] = np.where(shown, np.rint(least + share * (full - least)), 0)
    large = Image.fromarray(picture)
    if (columns, rows) != (plan.width, plan.height):
        # the picture may reach a little beyond the plan at the right and at the bottom
        box = (0.0, 0.0, plan.width * plan.m_per_pixel / step,
               plan.height * plan.m_per_pixel / step)  # fmt: skip
        large = large.resize((plan.width, plan.height), Image.Resampling.NEAREST, box=box)
    buffer = io.BytesIO()
    large.save(buffer, "PNG")
    return buffer.getvalue()
