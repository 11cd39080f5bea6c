"""Pictures of what is out of the ordinary."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sceneprint.lab.evaluation.pair_report import some_of_each
from sceneprint.lab.evaluation.plots import cloud_figure, contact_sheet, merged, save_figure
from sceneprint.lab.evaluation.protocol import QueryOutcome, ValidatedPair
from sceneprint.types import DepthFrame, Intrinsics


def wall(depth: float) -> DepthFrame:
    k = Intrinsics(32, 24, 30.0, 30.0, 16.0, 12.0)
    return DepthFrame(np.full((24, 32), depth, np.float32), k, "wall", np.eye(4))


@pytest.mark.parametrize("name", [r"a$\frac$b", "one $ alone", "a_{b}^c"])
def test_a_name_is_no_formula(
    name: str,
    tmp_path: Path,
    make_outcome: Callable[..., QueryOutcome],
    make_pair: Callable[..., ValidatedPair],
) -> None:
    pairs = [make_pair(0), make_pair(1)]
    one = replace(make_outcome([0, 1], [0, 1], pairs), name=name)
    sheet = contact_sheet([one], lambda _: wall(2.0), lambda _: wall(2.0), None)
    save_figure(sheet, tmp_path / "contact.png", 30)
    cloud = merged(wall(2.0), pairs, lambda _: wall(2.0))
    save_figure(cloud_figure(name, cloud, cloud, 1.0), tmp_path / "cloud.png", 30)
    assert len(list(tmp_path.iterdir())) == 2


def test_failures_of_every_kind_are_drawn_evenly_spread() -> None:
    """Two wrong ones, ten that were not believed, five not found: of eight places 2, 3 and 3."""
    kinds = ["wrong"] * 2 + ["not believed"] * 10 + ["not found"] * 5
    listed = [{"number": i, "what": what} for i, what in enumerate(kinds)]
    drawn = [one["number"] for one in some_of_each(listed, 8)]
    assert drawn == [0, 1, 2, 5, 8, 12, 13, 15]
    assert some_of_each(listed[:3], 8) == listed[:3]
    assert some_of_each([], 8) == []
