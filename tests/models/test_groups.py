"""Tests of optional parameter groups, which leave the id unchanged at their defaults."""

import math
from dataclasses import replace

import pytest

from sceneprint.errors import UnreadableModel
from sceneprint.geometry.surface.cloud import CloudParameters
from sceneprint.geometry.validation.validation import ValidationParameters
from sceneprint.models import ModelParameters, parse_model, read_model, write_model
from sceneprint.models.model import parse_parameters, to_mapping


@pytest.mark.parametrize(
    ("preset", "start"), [("paper", "c8883ac257b4"), ("depth", "da1ec0e37999")]
)
def test_ids_of_shipped_models_stay(preset, start):
    """Signatures of another id are never compared, so a change of them changes the id."""
    model = read_model(preset)
    assert model.without_whitening.id.startswith(start)
    assert not {"cloud", "validation"} & set(model.header["parameters"])
    assert model.parameters.cloud == CloudParameters()
    assert model.parameters.validation == ValidationParameters()


def changed(model):
    p = model.parameters
    coarse = replace(p.validation.alignment.coarse, stride=9, first_gate=0.5)
    alignment = replace(p.validation.alignment, coarse=coarse)
    validation = replace(p.validation, minimum_patches=7, alignment=alignment)
    cloud = replace(p.cloud, maximum_range=60.0)
    return replace(model, parameters=replace(p, cloud=cloud, validation=validation))


def test_only_what_differs_is_written(small_model):
    model = changed(small_model)
    written = model.header["parameters"]
    assert written["cloud"] == {"maximum_range": 60.0}
    assert written["validation"] == {
        "minimum_patches": 7,
        "alignment": {"coarse": {"first_gate": 0.5, "stride": 9}},
    }
    assert model.id != small_model.id
    read = parse_model(write_model(model), "a file")
    assert (read.id, read.parameters) == (model.id, model.parameters)


@pytest.mark.parametrize(
    ("group", "value"),
    [
        ("cloud", {"maximum_reach": 3.0}),
        ("cloud", {"maximum_range": "far"}),
        ("cloud", {"maximum_pixels": True}),
        ("cloud", None),
        ("validation", {"alignment": {"coarse": {"strides": 2}}}),
        ("validation", {"alignment": 3}),
    ],
)
def test_what_is_not_known_is_refused(group, value):
    with pytest.raises(UnreadableModel, match=f"parameters.{group}"):
        parse_parameters(to_mapping(ModelParameters()) | {group: value})


@pytest.mark.parametrize(
    "cloud",
    [
        CloudParameters(maximum_pixels=1 << 21),
        CloudParameters(radius_px=40),
        CloudParameters(minimum_range=0.0),
        CloudParameters(maximum_range=0.2),
        CloudParameters(image_angle=1e-9),
        CloudParameters(range_gate=0.0),
        CloudParameters(maximum_range=math.inf),
        CloudParameters(maximum_pixels=1 << 20, radius_px=16),
    ],
)
def test_what_would_take_for_ever_is_refused(small_model, cloud):
    model = replace(small_model, parameters=replace(small_model.parameters, cloud=cloud))
    with pytest.raises(UnreadableModel):
        parse_model(write_model(model), "a file")


@pytest.mark.parametrize(
    ("where", "value"),
    [
        ("agreement.edge_px", 1_000_000_000),
        ("alignment.consensus.rounds", 1_000_000_000),
        ("alignment.sequence.n_sources", 1_000_000_000),
        ("rivals.n_proposed", 1_000_000_000),
        ("alignment.plan.side", 1_000_000_000),
        ("alignment.plan.height_step", 1e-9),
        ("alignment.fine_stride", 0),
    ],
)
def test_validation_that_would_take_for_ever_is_refused(small_model, where, value):
    def changed(record, names):
        first, *rest = names
        return replace(record, **{first: changed(getattr(record, first), rest) if rest else value})

    parameters = changed(small_model.parameters, ["validation", *where.split(".")])
    with pytest.raises(UnreadableModel, match="is not in the range"):
        parse_model(write_model(replace(small_model, parameters=parameters)), "a file")
