"""Maps seen from above: plans of their coverage, compared, and pictures of their surface.

positions, queried frames  --coverage_plans-->  CoveragePlan of each parent frame
plans before, plans after  --plan_changes-->  cells that became better or worse
axes, box  --plan_frame-->  PlanFrame
PlanFrame, points  --surface_picture-->  PNG, transparent where nothing is
"""

from __future__ import annotations

import io
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sceneprint.engine.search.up_vectors import PlanAxes
from sceneprint.types import Floats
from sceneprint_client.api.coverage import (
    COVERAGE_OUTCOMES,
    CellChange,
    CellTrend,
    CoverageCell,
    CoverageOutcome,
    CoveragePlan,
    PlanChanges,
)

if TYPE_CHECKING:
    pass

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
    """Mean over the checked frames of a cell: 1 for found, -1 for wrong, 0 otherwise."""
    return (cell.found - cell.wrong) / max(queried_in(cell) - cell.unchecked, 1)


def plan_changes(
    before: Sequence[CoveragePlan], after: Sequence[CoveragePlan]
) -> list[PlanChanges]:
    """Return cells with queried frames in either of two results, whose plans have the same cells
    and axes.
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
