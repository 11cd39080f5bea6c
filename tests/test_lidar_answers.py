"""What a first match is worth, on scans whose answers are known."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.lidar_answers import Answered, first_answers
from sceneprint.geometry.validation import Validation
from sceneprint.models import Model
from sceneprint.pipeline import prepare
from sceneprint.signing import Signer
from sceneprint.types import Frame, Geometry


@pytest.fixture(scope="module")
def three(room_frames: tuple[Frame, ...], small_signer: Signer) -> list[Geometry]:
    """The same frame twice, and one of another room."""
    same, strange = (prepare(room_frames[i], small_signer)[1] for i in (0, 3))
    return [same, same, strange]


def test_the_first_accepted_match_answers(three: list[Geometry], small_model: Model) -> None:
    """The stranger is nearest to both, and is passed over; nobody asks what has no answer."""
    rows = np.array([[0.0, 5.0, 1.0], [5.0, 0.0, 1.0], [1.0, 1.0, 0.0]])
    allowed = ~np.eye(3, dtype=bool)
    near = np.array([[1, 1, 0], [1, 1, 0], [0, 0, 1]], bool)
    p = small_model.parameters.validation
    asked: list[tuple[int, int]] = []

    def confirmed(query: int, match: int, said: Validation) -> bool:
        asked.append((query, match))
        return query == 0 and said.status == "accepted"

    found = first_answers(three, rows, near, allowed, p, confirmed)
    assert found == Answered(queries=2, right=2, found=2, found_right=2, placed=1)
    assert asked == [(0, 1), (1, 0)]
    # with the stranger alone in the database nothing is accepted, and the nearest stands
    alone = np.array([[0, 0, 1], [0, 0, 0], [0, 0, 0]], bool)
    said = first_answers(three, rows, alone, alone, p, confirmed)
    assert said == Answered(queries=1, right=1, found=0, found_right=0, placed=0)
