"""Plans of a map's coverage: frames by the cell they were taken in, and two results compared.

positions, queried frames  --coverage_plans-->  CoveragePlan of each parent frame
plans before, plans after  --plan_changes-->  cells that became better or worse
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sceneprint.engine.maps.plan_axes import PlanAxes
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
