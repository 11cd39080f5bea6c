"""What two frames cannot tell is not believed; what they can is. Seeded, on whole images."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.lookalikes import (
    box_pairs,
    corridor_pairs,
    not_believed,
    other_rooms,
    outcomes_of,
    overlapping,
)
from sceneprint.datasets import FrameReference, find_sequences
from sceneprint.models import Model, read_model


@pytest.fixture(scope="module")
def model() -> Model:
    return read_model("paper")


@pytest.fixture(scope="module")
def recordings(data_root: Path) -> list[list[FrameReference]]:
    scenes = ("7scenes/redkitchen", "tum/fr1_rpy", "sun3d/studyroom2")
    return [[f for s in find_sequences(data_root / name) for f in s.frames] for name in scenes]


def test_the_sides_of_a_lone_box_are_not_told_apart(model: Model) -> None:
    counted = outcomes_of(box_pairs(24, 31), 24, "box", model)
    assert counted.total() == 24
    assert not_believed(counted) >= 0.95
    assert counted["ambiguous"] >= 20  # and not for want of a transform


def test_the_doors_of_a_corridor_are_not_told_apart(model: Model) -> None:
    counted = outcomes_of(corridor_pairs(24, 31), 24, "corridor", model)
    assert counted.total() == 24
    assert not_believed(counted) >= 0.95
    assert counted["ambiguous"] >= 12


def test_frames_that_overlap_by_half_are_accepted(
    model: Model, recordings: list[list[FrameReference]]
) -> None:
    pairs = overlapping(recordings[0], 40, 31)
    counted = outcomes_of(iter(pairs), 40, "half", model)
    assert counted.total() == 40
    right = sum(n for what, n in counted.items() if what.endswith("right"))
    assert right >= 39
    assert not_believed(counted) == 1.0


def test_frames_of_other_rooms_are_not_accepted(
    model: Model, recordings: list[list[FrameReference]]
) -> None:
    counted = other_rooms(recordings, 150, 31, model)
    assert counted.total() == 150
    assert not_believed(counted) == 1.0
    assert counted["rejected"] >= 145
