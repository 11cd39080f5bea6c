"""Tests of the fusion of cells against manual results and a loop over points."""

import numpy as np
import pytest

from sceneprint.geometry.cells import (
    CELL_SUM,
    MOST_TILES,
    TimeScale,
    ViewStamp,
    coarsen_cells,
    encode_cells,
    fuse_cells,
    merge_cells,
    remove_tile,
    time_scale,
    view_cells,
)
from sceneprint_client.surface_encoding import NO_SESSION, NO_TIME

CELL_M = 0.05
#: A tile is 3.2 m wide.
TILE_M = 64 * CELL_M


def row(key, at, views=1, taken=0.0, session=0):
    rows = np.zeros(1, CELL_SUM)
    rows["key"], rows["views"], rows["sums"] = key, views, at
    rows["taken"], rows["session"] = taken, session
    return rows


def test_points_go_to_their_cells():
    points = np.array(
        [
            [0.01, 0.02, 0.03], [0.03, 0.02, 0.03],  # one cell: the mean at 0.02
            [-0.01, 0.0, 0.0],  # the last column of the tile before
            [3.2, 0.0, 3.19],  # the next tile, its last floor but none
            [np.nan, 0.0, 0.0], [1e300, 0.0, 0.0],
        ]
    )  # fmt: skip
    result = view_cells(points, CELL_M, ViewStamp(7, 5.0, 2))
    assert set(result) == {(0, 0, 0), (-1, 0, 0), (1, 0, 0)}
    (first,) = result[0, 0, 0]
    assert (first["key"], first["views"], first["number"], first["session"]) == (0, 1, 7, 2)
    # in 256ths of a cell: (51 + 153) // 2, 102, 153
    np.testing.assert_array_equal(first["sums"], [102, 102, 153])
    assert result[-1, 0, 0]["key"].tolist() == [63]
    assert result[1, 0, 0]["key"].tolist() == [63 * 64**2]


def test_a_view_of_points_all_over_fills_few_tiles():
    far = (np.arange(2000.0)[:, None] + 0.5) * [TILE_M, 0.0, 0.0]
    twice = far[700:800] + np.array([0.0, 0.1, 0.0])
    result = view_cells(np.concatenate([far, twice]), CELL_M, ViewStamp(1, 0.0, 0))
    assert len(result) == MOST_TILES
    assert sum(len(rows) for rows in result.values()) == MOST_TILES + 100  # the fullest are kept


def test_views_fuse_in_any_order():
    rng = np.random.default_rng(5)
    views = []
    for number, taken in enumerate([5.0, None, 9.0, 9.0, None]):
        points = rng.uniform(0.0, 1.0, (3000, 3))
        views.append(view_cells(points, CELL_M, ViewStamp(number, taken, number))[0, 0, 0])
    whole = fuse_cells(views)
    assert fuse_cells([views[i] for i in (3, 1, 4, 0, 2)]).tobytes() == whole.tobytes()
    parts = [fuse_cells(views[:2]), fuse_cells(views[2:])]
    assert fuse_cells(parts).tobytes() == whole.tobytes()
    keys = [set(view["key"].tolist()) for view in views]
    assert set(whole["key"].tolist()) == set.union(*keys)
    for one in whole:
        seen = [i for i in range(5) if int(one["key"]) in keys[i]]
        assert one["views"] == len(seen)
        # the last by time, then by number; one without a time counts before all others
        assert one["session"] == max(seen, key=lambda i: ((0, -1, 1, 1, -1)[i], i))
    assert len(fuse_cells([])) == 0


def test_a_tile_as_it_is_given_out():
    rows = np.concatenate(
        [
            row(0, (0, 0, 0), 1, -np.inf, NO_SESSION),
            row(64**2 + 64 + 63, (3 * 255, 3 * 128, 3 * 64), 3, 100.0, 4),
            row(64**3 - 1, (0, 0, 0), 10**6, 1e9, 5),
        ]
    )
    cells = encode_cells(rows, TimeScale(80.0, 8.0))
    assert cells["at"].tolist() == [[0, 0, 0], [255, 6, 5], [252, 252, 252]]
    assert cells["seen"].tolist() == [16, 32, 255]  # 16 log2 of 2, 4, and more than 16 bits
    assert cells["session"].tolist() == [NO_SESSION, 4, 5]
    assert cells["taken"].tolist() == [NO_TIME, 2, NO_TIME - 1]
    assert cells.tobytes()[8:16] == bytes([255, 6, 5, 32, 4, 0, 2, 0])
    assert set(encode_cells(rows, None)["taken"].tolist()) == {NO_TIME}


def test_the_next_level_by_hand():
    """Cells 0 to 3 along x are one coarser cell, and cell 4 the next."""
    rows = np.concatenate(
        [
            row(0, (0, 0, 0), 3, 50.0, 1), row(3, (0, 0, 0), 1, 60.0, 2),
            row(4, (128, 0, 0), 7, -np.inf, 3),
        ]
    )  # fmt: skip
    fine = encode_cells(rows, TimeScale(0.0, 1.0))
    result = coarsen_cells({(5, 0, 0): fine})  # the second quarter of its tile
    # places 0 and 12 of 256 in the tile are 64 and 67 of the next level's; 18 is 68
    assert result["at"].tolist() == [[65, 0, 0], [68, 0, 0]]
    assert result["seen"].tolist() == [32, 48]
    assert result["session"].tolist() == [2, 3]
    assert result["taken"].tolist() == [60, NO_TIME]
    assert len(remove_tile(result, (5, 0, 0))) == 0
    assert remove_tile(result, (6, 0, 0)).tobytes() == result.tobytes()
    other = coarsen_cells({(4, 0, 0): fine})
    both = coarsen_cells({(4, 0, 0): fine, (5, 0, 0): fine})
    assert merge_cells(result, other).tobytes() == both.tobytes()
    assert merge_cells(remove_tile(both, (4, 0, 0)), other).tobytes() == both.tobytes()


@pytest.mark.parametrize(("first", "last"), [(1000.0, 1000.0), (0.0, 1e6), (-5.0, 3e9)])
def test_a_scale_of_times_has_room_on_both_sides(first, last):
    scale = time_scale(first, last)
    span = last - first
    assert scale.holds(first, last + 2 * span)
    assert scale.start < first
    assert not scale.holds(scale.start - 1, last)
    assert not scale.holds(first, scale.start + 65535 * scale.step_s)
    assert np.log2(scale.step_s) == np.round(np.log2(scale.step_s))
