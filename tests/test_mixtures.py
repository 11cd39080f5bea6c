"""What the mixture was learnt from: figures by hand, and that a source decides the model."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.mixtures import SIZES, SOURCES, WANTED, Learnt, Trial, figures, learn, show

A, B = WANTED[:2]


def test_figures_of_the_nearest() -> None:
    """By A both queries find the second frame, by B each its own, of the other scene once."""
    database = np.array([[0, 0], [4, 4], [9, 9]], np.uint8)
    queries = {
        A: np.array([[5, 5], [4, 3]], np.uint8),
        B: np.array([[0, 1], [8, 9]], np.uint8),
    }
    same = np.array([[True, True, False], [False, False, True]])
    shared = np.array([[0.8, 0.5, 0.0], [0.0, 0.0, 0.4]])
    found = figures(Trial(queries, dict.fromkeys((A, B), database), same, shared))
    assert found[A] == {"right scene": 0.5, "mean overlap": 0.25, "overlap >= 0.5": 0.5}
    assert found[B] == {
        "right scene": 1.0,
        "mean overlap": pytest.approx(0.6),
        "overlap >= 0.5": 0.5,
    }


def test_every_source_and_every_size_is_compared_once(capsys: pytest.CaptureFixture[str]) -> None:
    assert len(set(WANTED)) == len(WANTED) == len(SOURCES) + len(SIZES) - 1
    show({"t": {one: {"mean overlap": i / 10} for i, one in enumerate(WANTED)}})
    rows = capsys.readouterr().out.splitlines()[3:]
    assert [row.split("|")[-2].strip() for row in rows] == [f"0.{i}00" for i in range(len(WANTED))]


def test_a_model_has_the_components_that_are_wanted() -> None:
    signer = learn(Path("/nowhere"), Learnt("synthetic rooms", 8), jobs=1, rooms=2)
    assert signer.model.signature_bytes == 25 * 8 * 4
    assert signer.model.provenance["frames_used"] == 12
