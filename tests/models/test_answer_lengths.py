"""Tests that the model holds all lengths of answers, and the code none."""

import ast
import inspect

import pytest

from sceneprint import localization, places
from sceneprint.engine.search import verification
from sceneprint.geometry.validation import map_verification
from sceneprint.geometry.validation.map_verification import MapParameters
from sceneprint.models import read_model
from sceneprint.models.model import POWERS, AnswerParameters, scale_lengths

#: Numbers that are not lengths: shares, tiny divisors, a chi-square, and how a score is weighed.
FREE = {0.0, 1.0, 1e-9, 1e-12, 22.458}


@pytest.mark.parametrize("module", [localization, places, map_verification, verification])
def test_no_bare_length_is_left(module):
    tree = ast.parse(inspect.getsource(module))
    records = {
        node
        for record in ast.walk(tree)
        if isinstance(record, ast.ClassDef) and record.name.endswith("Parameters")
        for node in ast.walk(record)
    }
    bare = {
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, float) and node not in records
    }
    assert bare <= FREE


def test_every_length_of_the_map_is_a_multiple_of_the_scale():
    """Those are the fields whose comment speaks of metres."""
    source = inspect.getsource(MapParameters)
    lengths = {line.split(":")[0].strip() for line in source.splitlines() if "metres" in line}
    assert lengths == set(POWERS[MapParameters])
    twice = scale_lengths(AnswerParameters(), 2.0).map
    for name in lengths:
        assert getattr(twice, name) == 2.0 * getattr(MapParameters(), name)
    assert twice.refinement.first_gate == 2.0 * MapParameters().refinement.first_gate
    assert twice.planes.same_plane == 2.0 * MapParameters().planes.same_plane


def test_the_presets_scale_the_lengths_of_the_answer():
    depth, lidar = read_model("depth").answer.map, read_model("lidar").answer.map
    assert depth == MapParameters()
    for name in POWERS[MapParameters]:
        assert getattr(lidar, name) == pytest.approx(5.0 * getattr(depth, name))
    assert read_model("lidar").parameters.validation.guided_m == pytest.approx(0.75)
