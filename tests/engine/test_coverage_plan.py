"""Tests of coverage plans: axes, cell widths, counts, changes and colours."""

import numpy as np
import pytest

from sceneprint.engine.maps.map_plans import (
    MOST_CELLS,
    QueriedPosition,
    coverage_plans,
    localisability,
    plan_changes,
)
from sceneprint.engine.search.up_vectors import PlanAxes, plan_axes, upright
from sceneprint_client.api.coverage import CoverageCell, CoveragePlan

LEVEL = PlanAxes(np.eye(3)[:2], "map")


def cell(column, row, frames=0, **counts):
    known = {"found": 0, "wrong": 0, "ambiguous": 0, "not_found": 0} | counts
    return CoverageCell(column=column, row=row, frames=frames, **known)


def plan(*cells, parent="map"):
    return CoveragePlan(
        parent_frame=parent, x_axis=[1, 0, 0], y_axis=[0, 1, 0], up_from="map", cells=list(cells)
    )


def queried(*given):
    return [QueriedPosition(np.array([x, y, 7.0]), outcome) for x, y, outcome in given]


@pytest.mark.parametrize(
    ("up", "right", "top"),
    [
        ((0, 0, 1), (1, 0, 0), (0, 1, 0)),
        ((0, -1, 0), (1, 0, 0), (0, 0, 1)),  # of a world whose y points down
        ((0, 1, 0), (1, 0, 0), (0, 0, -1)),
        ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    ],
)
def test_a_plan_is_seen_from_above(up, right, top):
    axes = plan_axes(np.array(up, float))
    np.testing.assert_allclose(axes, [right, top], atol=1e-12)
    np.testing.assert_allclose(np.cross(*axes), up, atol=1e-12)  # and is no mirror image


def test_sensors_are_held_upright():
    camera = np.eye(4)  # x right, y down, z ahead, in a world whose z is up
    camera[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    down = np.eye(4)  # looking at the floor: its -y points ahead
    down[:3, :3] = [[1, 0, 0], [0, -1, 0], [0, 0, -1]]
    np.testing.assert_array_equal(upright(np.stack([camera, camera, down]), [False] * 3), [0, 0, 1])
    np.testing.assert_array_equal(upright(np.eye(4)[None], [False]), [0, -1, 0])
    np.testing.assert_array_equal(upright(np.eye(4)[None], [True]), [0, 0, 1])


def test_frames_are_counted_by_cell():
    taken = {"map": np.array([[0.1, 0.1, 0.0], [0.9, 0.2, 9.0], [-0.1, 0.1, 0.0], [5.0, 5.0, 0.0]])}
    asked = {
        "map": queried((0.1, 0.1, "found"), (0.9, 0.2, "wrong"), (-0.1, 0.1, "ambiguous")),
        "odom": queried((3.5, -0.5, "not_found")),
    }
    plans, cell_m = coverage_plans(asked, taken, {"map": LEVEL, "odom": LEVEL}, 1.0)
    assert cell_m == 1.0
    assert [one.parent_frame for one in plans] == ["map", "odom"]
    assert plans[0].cells == [
        cell(-1, 0, 1, ambiguous=1), cell(0, 0, 2, found=1, wrong=1), cell(5, 5, 1)
    ]  # fmt: skip
    assert plans[1].cells == [cell(3, -1, 0, not_found=1)]  # its frame was deleted meanwhile
    assert coverage_plans({}, taken, {}, None)[0] == []


def test_cells_widen_where_there_would_be_too_many():
    side = np.arange(150.0)
    grid = np.stack(np.meshgrid(side, side, [0.0]), axis=-1).reshape(-1, 3)
    asked = {"map": queried((0.0, 0.0, "found"))}
    (one,), cell_m = coverage_plans(asked, {"map": grid}, {"map": LEVEL}, 1.0)
    assert cell_m == 2.0
    assert len(one.cells) == 75 * 75 <= MOST_CELLS
    assert {cell.frames for cell in one.cells} == {4}


def test_two_results_are_compared_cell_by_cell():
    before = [
        plan(
            cell(0, 0, 9, found=1, not_found=1), cell(1, 0, 9, found=2), cell(2, 0, 9, ambiguous=3),
            cell(3, 0, 9, found=2, wrong=1), cell(4, 0, 9, found=1), cell(5, 0, 9),
            cell(0, 1, 9, not_found=2),
        ),
        plan(cell(0, 0, 1, found=1), parent="gone"),
    ]  # fmt: skip
    after = [
        plan(
            cell(0, 0, 12, found=3, not_found=1),  # 1/2 of 2, now 3/4 of 4
            cell(1, 0, 9, found=1, ambiguous=1),  # all of 2, now half
            cell(2, 0, 9, not_found=3),  # not found is no better than ambiguous
            cell(3, 0, 9, found=1, not_found=2),  # (2 - 1) / 3 as (1 - 0) / 3
            cell(5, 0, 9, found=1),  # not queried before
            cell(6, 0, 9),  # queried in neither
            cell(0, 1, 9, wrong=1, not_found=1),  # wrong is worse than not found
        )
    ]  # fmt: skip
    told, gone = plan_changes(before, after)
    trends = {(one.column, one.row): one.trend for one in told.cells}
    assert trends == {
        (0, 0): "better", (1, 0): "worse", (2, 0): "same", (3, 0): "same", (4, 0): "gone",
        (5, 0): "new", (0, 1): "worse",
    }  # fmt: skip
    assert [(one.column, one.row) for one in told.cells] == list(trends)  # by row, then by column
    assert (told.cells[0].before, told.cells[0].after) == (before[0].cells[0], after[0].cells[0])
    assert told.cells[4].after is None
    assert (gone.parent_frame, [one.trend for one in gone.cells]) == ("gone", ["gone"])
    assert localisability(before[0].cells[3]) == pytest.approx(1 / 3)
    assert localisability(cell(0, 0, 3, found=1, wrong=0, not_found=1, unchecked=1)) == 0.5
