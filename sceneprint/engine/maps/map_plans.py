"""Plans (views from above) of maps: coverage by cell, its changes, and images of surfaces.

positions, queried frames  --coverage_plans-->  CoveragePlan of each parent frame
plans before, plans after  --plan_changes-->  cells with their trends
axes, box  --plan_frame-->  PlanFrame
PlanFrame, points  --surface_picture-->  PNG
"""

from __future__ import annotations

import io
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

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

#: Approximate number of cells along the longer side of a coverage plan.
_CELLS_ALONG = 20
#: Minimum cell width unless the request sets the width, metres.
_LEAST_CELL_M = 0.25
#: Maximum number of cells in all plans of a result; with more, the cells are widened.
MOST_CELLS = 10_000

#: Largest absolute column and row, since JSON does not represent larger integers exactly.
_FARTHEST_CELL = 2**52

#: Column and row of a cell.
Place = tuple[int, int]


@dataclass(frozen=True, eq=False)
class QueriedPosition:
    """The position (3,) of a queried frame in its parent frame, metres, and its outcome."""

    at: Floats
    outcome: CoverageOutcome


def cell_width(extent_m: float) -> float:
    """Return the cell width for a plan with a longer side of `extent_m`: 0.25, 0.5, 1, 2, ... m."""
    target = max(extent_m / _CELLS_ALONG, _LEAST_CELL_M)
    steps = [
        _LEAST_CELL_M,
        0.5,
        *(digit * 10.0**power for power in range(6) for digit in (1, 2, 5)),
    ]
    return min(steps, key=lambda step: abs(math.log(step / target)))


def coverage_plans(
    queried: Mapping[str, Sequence[QueriedPosition]], positions: Mapping[str, Floats],
    axes: Mapping[str, PlanAxes], cell_m: float | None,
) -> tuple[list[CoveragePlan], float]:  # fmt: skip
    """Count the queried frames and all frames in each cell of the plans.

    Parameters
    ----------
    queried : queried frames by parent frame
    positions : (n, 3) positions of all frames of the map, by parent frame, metres
    axes : axes of each plan, by parent frame
    cell_m : cell width, metres; None selects it by `cell_width`

    Returns
    -------
    plans : plans in the order of `queried`
    cell_m : cell width, metres; a multiple of the requested width if that needs too many cells
    """
    flat = {name: positions.get(name, np.empty((0, 3))) @ axes[name].axes.T for name in queried}
    flat_queried = {
        name: np.array([position.at for position in some]) @ axes[name].axes.T
        for name, some in queried.items()
    }
    if cell_m is None:
        every = [np.concatenate([flat[name], flat_queried[name]]) for name in queried]
        cell_m = cell_width(
            max((float(np.ptp(points, axis=0).max()) for points in every), default=0.0)
        )
    while True:
        counted = {
            name: (_places(flat[name], cell_m), _places(flat_queried[name], cell_m))
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
            cells=_cells(Counter(all_of), some, [position.outcome for position in queried[name]]),
        )
        for name, (all_of, some) in counted.items()
    ]
    return plans, cell_m


def _places(flat: Floats, cell_m: float) -> list[Place]:
    # poses are unbounded; distant positions count in the outermost cells
    places = np.clip(np.floor(flat / cell_m), -_FARTHEST_CELL, _FARTHEST_CELL)
    return [(column, row) for column, row in places.astype(np.int64).tolist()]


def _cells(
    frames: Mapping[Place, int], queried: Sequence[Place], outcomes: Sequence[CoverageOutcome]
) -> list[CoverageCell]:
    counted: dict[Place, Counter[str]] = {}
    for place, outcome in zip(queried, outcomes, strict=True):
        counted.setdefault(place, Counter())[outcome] += 1
    return [
        CoverageCell(
            column=column, row=row, frames=frames.get((column, row), 0),
            **{name: counted.get((column, row), Counter())[name] for name in COVERAGE_OUTCOMES},
        )
        for column, row in sorted({*frames, *counted}, key=lambda place: place[::-1])
    ]  # fmt: skip


def queried_in(cell: CoverageCell) -> int:
    """Return the number of queried frames in a cell."""
    return sum(getattr(cell, name) for name in COVERAGE_OUTCOMES)


def localisability(cell: CoverageCell) -> float:
    """Return the mean score of the checked frames of a cell: 1 for found, -1 for wrong, else 0."""
    return (cell.found - cell.wrong) / max(queried_in(cell) - cell.unchecked, 1)


def plan_changes(
    before: Sequence[CoveragePlan], after: Sequence[CoveragePlan]
) -> list[PlanChanges]:
    """Return the trends of the cells that have queried frames before or after, by parent frame."""
    names = dict.fromkeys(plan.parent_frame for plan in (*after, *before))
    changed = []
    for name in names:
        earlier, later = _by_place(before, name), _by_place(after, name)
        places = sorted({*earlier, *later}, key=lambda place: place[::-1])
        changes = [_change(place, earlier.get(place), later.get(place)) for place in places]
        changes_here = [change for change in changes if change is not None]
        changed.append(PlanChanges(parent_frame=name, cells=changes_here))
    return changed


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


#: RGB colour that is legible on white and on black, and opacity of a single cell and of a wall.
_COLOUR, _OPACITIES = (122, 130, 143), (90.0, 255.0)
#: Percentile of the counts per pixel at which a pixel becomes fully opaque.
_FULL = 97.0


@dataclass(frozen=True)
class PlanFrame:
    """Position, size and resolution of an image on a plan.

    Parameters
    ----------
    m_per_pixel : width of a pixel, metres
    width, height : size in pixels
    left, top : coordinates of the upper left corner along the axes, metres
    """

    m_per_pixel: float
    width: int
    height: int
    left: float
    top: float


def plan_frame(
    axes: Floats, low: Sequence[float], high: Sequence[float], cell_m: float, longer: int
) -> PlanFrame:
    """Return the smallest image frame on a plan that contains a box.

    Parameters
    ----------
    axes : (2, 3) unit vectors that point right and up on the plan
    low, high : (3,) opposite corners of the box, metres
    cell_m : minimum length of a side, metres
    longer : length of the longer side, pixels
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
    """Draw the plan of a surface as a PNG; pixels with more points are more opaque.

    Parameters
    ----------
    axes : (2, 3) axes of the plan
    points : points (N, 3) of each tile, metres
    cell_m : cell width of the surface, metres
    heights : minimum and maximum height along the up vector, metres; None for no limit
    """
    from PIL import Image

    # use pixels at least as wide as the cells, since smaller ones would leave gaps
    step = max(plan.m_per_pixel, cell_m)
    columns, rows = (
        max(math.ceil(side * plan.m_per_pixel / step), 1) for side in (plan.width, plan.height)
    )
    counts = np.zeros((rows, columns))
    up = np.cross(axes[0], axes[1])
    for tile in points:
        height = tile @ up
        inside = np.ones(len(tile), bool)
        if heights[0] is not None:
            inside &= height >= heights[0]
        if heights[1] is not None:
            inside &= height <= heights[1]
        flat = tile[inside] @ axes.T
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
        # crop the image, which may extend beyond the plan on the right and at the bottom
        box = (0.0, 0.0, plan.width * plan.m_per_pixel / step,
               plan.height * plan.m_per_pixel / step)  # fmt: skip
        large = large.resize((plan.width, plan.height), Image.Resampling.NEAREST, box=box)
    buffer = io.BytesIO()
    large.save(buffer, "PNG")
    return buffer.getvalue()
