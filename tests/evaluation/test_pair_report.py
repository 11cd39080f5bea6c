"""Tests of the figures of pairs against manual results."""

import math
from dataclasses import replace

import numpy as np
import pytest

from sceneprint.geometry.validation.acceptance import AcceptanceParameters
from sceneprint_lab.evaluation.pair_report import (
    pair_figures,
)
from sceneprint_lab.evaluation.pair_run import BINS, Drawn, PairEvaluation, Tried
from sceneprint_lab.evaluation.protocol import RIGHT, Error, SignedFrame

ACCEPTANCE = AcceptanceParameters()
CM3, CM7, CM15, AWAY = Error(0.03, 0.0), Error(0.07, 0.0), Error(0.15, 0.0), Error(2.0, 1.0)


def member(number, scene):
    return SignedFrame(number, f"{scene}/{number}", scene, np.eye(4), np.empty(0, np.uint8))


MEMBERS = [member(0, "here"), member(1, "here"), member(2, "there")]


def overlapping(name, pair, bound=CM3):
    drawn = Drawn(1, 0, "overlapping", name, 0.4, int(name.split("-")[0]) / 100, planar=False)
    return Tried(drawn, replace(pair, overlap_least=drawn.overlap_least, bound=bound), None, None)


def negative(pair, *, planar=False, cross=True):
    kind = "cross_scene" if cross else "same_scene"
    drawn = Drawn(0, 2 if cross else 1, kind, None, 0.0, 0.0, planar)
    return Tried(drawn, replace(pair, overlap_least=0.0), None, None)


@pytest.fixture
def tried(make_pair):
    """Two pairs of the first bin and three of the second, five negatives, one of them accepted."""
    strange = {"scene": "there"}
    return [
        overlapping("10-30", make_pair(0, "rejected", off=AWAY), CM7),
        overlapping("10-30", make_pair(0, "rejected", off=CM15)),
        overlapping("30-50", make_pair(0, off=CM3)),
        overlapping("30-50", make_pair(0, off=CM7)),
        overlapping("30-50", make_pair(0, "ambiguous", off=CM7)),
        negative(make_pair(2, "rejected", **strange)),
        negative(make_pair(2, "rejected", **strange), planar=True),
        negative(make_pair(2, "rejected", **strange), planar=True),
        negative(make_pair(2, strength="weak", **strange)),
        negative(make_pair(1, "rejected", off=AWAY), cross=False),
    ]


def evaluation(tried):
    planes = np.array([0.2, 0.7, 0.6])
    return PairEvaluation(MEMBERS, RIGHT, ACCEPTANCE, planes, tried, [("here/9", "empty")], 5.0)


@pytest.fixture
def found(tried):
    return pair_figures(evaluation(tried), {"seed": 0, "right": RIGHT})


def test_precision_is_null_where_none_was_accepted(found):
    first, second, third, _ = (found["bins"][name]["validation"] for name in BINS)
    assert (first["precision"], first["recall"], first["accepted"]) == (None, None, 0)
    assert (second["precision"], second["accepted"]) == (1.0, 2)
    assert second["recall"] == pytest.approx(2 / 3)
    assert (third["precision"], third["pairs"]) == (None, 0)
    overall = found["validation"]
    assert overall["accepted"] == 3
    assert overall["precision"] == pytest.approx(2 / 3)
    assert overall["recall_overlap_30"] == pytest.approx(2 / 3)


def test_negatives_and_how_many_may_be(found):
    of = found["negatives"]
    counts = [of["cross_scene"][k] for k in ("pairs", "planar", "accepted", "accepted_strong")]
    assert counts == [4, 2, 1, 0]
    assert of["cross_scene_planar"]["upper"] == pytest.approx(1 - math.sqrt(0.05))
    assert of["same_scene"]["pairs"] == 1
    assert of["by_scenes"] == {"here | there": of["cross_scene"]}
    assert found["scenes"]["here"]["validation"]["accepted"] == 2
    assert found["scenes"]["there"]["validation"]["precision"] is None
    assert found["counts"]["planar"] == {"here": 1, "there": 1}
