"""Tests of model files and pair tables: round trips, optional groups of parameters, damage."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from safetensors.numpy import load, save

from sceneprint.errors import UnreadableModel
from sceneprint.geometry.registration.patch_descriptors import PatchDescriptorParameters
from sceneprint.geometry.signature.segmentation import SegmentationParameters
from sceneprint.geometry.surface.cloud import CloudParameters
from sceneprint.geometry.surface.depth_image import DepthParameters
from sceneprint.geometry.validation.validation import ValidationParameters
from sceneprint.models import (
    PRESETS,
    ModelParameters,
    build_table,
    open_table,
    parse_model,
    read_model,
    save_model,
    write_model,
)
from sceneprint.models.model import parse_parameters, to_mapping


def test_round_trip(small_model, tmp_path):
    path = tmp_path / "small.safetensors"
    save_model(small_model, path)
    read = read_model(path)
    assert read.id == small_model.id
    assert read.parameters == small_model.parameters
    assert (read.name, read.provenance) == ("small", {"made": "by a test"})
    for name, tensor in small_model.tensors.items():
        np.testing.assert_array_equal(read.tensors[name], tensor)
    assert [p.name for p in tmp_path.iterdir()] == ["small.safetensors"]


def test_id_is_the_content_not_the_name(small_model):
    assert len(small_model.id) == 64
    assert replace(small_model, name="other", provenance={}).id == small_model.id
    depth = replace(small_model.parameters, depth=DepthParameters(maximum_depth=8.99))
    bent = replace(small_model.mixture, means=small_model.mixture.means + 1e-12)
    reach = replace(
        small_model.parameters, surroundings=replace(PatchDescriptorParameters(), far_radius=1.5)
    )
    own = replace(
        small_model.parameters, validation_segmentation=SegmentationParameters(n_patches=399)
    )
    kept = small_model.compression
    others = [
        replace(small_model, parameters=reach),
        replace(small_model, parameters=own),
        replace(small_model, compression=replace(kept, mean=kept.mean + np.float32(1e-6))),
        replace(small_model, compression=replace(kept, matrix=-kept.matrix)),
        replace(small_model, parameters=depth),
        replace(small_model, mixture=bent),
        replace(small_model, quantiser_step=0.003),
        replace(small_model, psi_unrelated_distance=1001.0),
    ]
    assert len({small_model.id, *(other.id for other in others)}) == 9


def test_a_whitening_is_part_of_the_content(small_model, small_whitened):
    own = small_whitened.whitening
    others = [
        replace(small_whitened, whitening=changed)
        for changed in (
            replace(own, levels=(0,)),
            replace(own, basis=-own.basis),
            replace(own, scales=2 * own.scales),
            replace(own, offsets=own.offsets + 1),
            replace(own, unrelated_distance=499_999.0),
        )
    ]
    assert len({small_model.id, small_whitened.id, *(other.id for other in others)}) == 7
    assert small_whitened.without_whitening.id == small_model.id


def test_round_trip_of_a_whitening(small_whitened, tmp_path):
    save_model(small_whitened, tmp_path / "m")
    read = read_model(tmp_path / "m")
    assert read.id == small_whitened.id
    assert (read.metric, read.levels, read.signature_bytes) == ("l2", (1,), 24)
    assert (read.unrelated_distance, read.psi_unrelated_distance) == (500_000.0, 1000.0)


def test_whitenings_that_are_none(small_whitened, tmp_path):
    save_model(small_whitened, tmp_path / "m")
    good = (tmp_path / "m").read_bytes()

    def put(**values):
        def change(header):
            result = header["whitening"]
            assert isinstance(result, dict)
            result.update(values)

        return with_header(good, change)

    files = [
        put(levels=[]), put(levels=[2]), put(levels=[1, 0]), put(levels=[1, 1]), put(levels=[True]),
        put(levels=[0, 1]),  # the basis is of one level
        put(unrelated_distance=0), put(unrelated_distance="x"),
        with_tensors(good, whitening_basis=np.zeros((24, 199), np.int8)),
        with_tensors(good, whitening_basis=np.zeros((24, 200), np.int16)),
        with_tensors(good, whitening_basis=np.zeros((1025, 200), np.int8)),
        with_tensors(good, whitening_scales=np.full(24, np.nan)),
        with_tensors(good, whitening_offsets=np.zeros(23)),
    ]  # fmt: skip
    for file in files:
        with pytest.raises(UnreadableModel, match="missing or malformed"):
            parse_model(file, "a file")
    with pytest.raises(UnreadableModel, match=r"schema 2, but .* reads schema 3"):
        parse_model(with_header(good, lambda header: header.update(schema_version=2)), "a file")


@pytest.mark.parametrize(
    ("preset", "g", "size", "metric"), [("depth", 256, 448, "l2"), ("paper", 1250, 125_000, "l1")]
)
def test_presets_ship(preset, g, size, metric):
    model = read_model(preset)
    assert model.name == preset
    assert (len(model.mixture), model.signature_bytes, model.metric) == (g, size, metric)
    assert model.mixture.weights.sum() == pytest.approx(1.0, abs=1e-12)
    assert model.parameters.properties.radius == 3.0
    # descriptors of 128 bytes, by axes at right angles to each other
    axes = model.compression.matrix.astype(float)
    assert axes.shape == (128, model.parameters.surroundings.dimension)
    np.testing.assert_allclose(axes @ axes.T, np.eye(128), atol=1e-5)
    assert preset in PRESETS


def header_of(data):
    length = int.from_bytes(data[:8], "little")
    return json.loads(json.loads(data[8 : 8 + length])["__metadata__"]["sceneprint"])


def with_header(data, change):
    header = header_of(data)
    change(header)
    return save(load(data), {"sceneprint": json.dumps(header)})


def with_tensors(data, **changed):
    tensors = load(data) | {name.replace("_", "."): t for name, t in changed.items()}
    return save(tensors, {"sceneprint": json.dumps(header_of(data))})


def without_tensor(data, name):
    tensors = {key: tensor for key, tensor in load(data).items() if key != name}
    return save(tensors, {"sceneprint": json.dumps(header_of(data))})


@pytest.fixture
def data(small_model, tmp_path):
    save_model(small_model, tmp_path / "m")
    return (tmp_path / "m").read_bytes()


def test_damage_is_noticed(data):
    def drop(key):
        return lambda header: header.pop(key) and None

    def put(key, value):
        return lambda header: header.update({key: value})

    cases = {
        "not a model file": [b"", b"x" * 100, data[:40], data[:-5], save({"a": np.zeros(1)})],
        "schema 9, but .* reads schema 2": [with_header(data, put("schema_version", 9))],
        "schema 1, but .* reads schema 2": [with_header(data, put("schema_version", 1))],
        "missing or malformed": [
            with_header(data, drop("quantiser_step")),
            with_header(data, put("quantiser_step", 0.0)),
            with_header(data, put("unrelated_distance", float("nan"))),
            with_tensors(data, mixture_weights=np.zeros(8)),
            with_tensors(data, mixture_means=np.zeros((8, 11))),
            with_tensors(data, projection_mean=np.full(13, np.nan)),
            with_tensors(data, compression_mean=np.zeros(927)),
            with_tensors(data, compression_matrix=np.zeros((16, 926), np.float32)),
            with_tensors(data, compression_matrix=np.full((16, 927), np.inf, np.float32)),
            with_tensors(data, compression_matrix=np.zeros((1025, 927), np.float32)),
            without_tensor(data, "compression.mean"),
        ],
        "must have the fields": [with_header(data, put("parameters", {"depth": {}}))],
        "is damaged": [
            with_header(data, put("quantiser_step", 0.5)),
            with_tensors(data, projection_mean=np.zeros(13)),
            with_tensors(data, compression_matrix=np.zeros((16, 927), np.float32)),
        ],
    }
    for message, files in cases.items():
        for file in files:
            with pytest.raises(UnreadableModel, match=message):
                parse_model(file, "a file")


@pytest.mark.parametrize("header", ["[1]", '"s"', "{}", '{"schema_version": 1}', "null"])
def test_headers_that_are_no_headers(data, header):
    with pytest.raises(UnreadableModel, match=r"^a file: "):
        parse_model(save(load(data), {"sceneprint": header}), "a file")


def test_a_name_that_would_drive_a_terminal(data):
    escape = with_header(data, lambda header: header.update(name="a\x1b[2J"))
    with pytest.raises(UnreadableModel, match="letters, digits, dots and dashes"):
        parse_model(escape, "a file")


def test_components_beyond_what_the_table_can_name(data):
    g = 2**15
    tensors = {
        "mixture_weights": np.full(g, 1 / g),
        "mixture_means": np.zeros((g, 12)),
        "mixture_variances": np.ones((g, 12)),
    }
    with pytest.raises(UnreadableModel, match="32768 components exceed the maximum of 32767"):
        parse_model(with_tensors(data, **tensors), "a file")


def test_a_parameter_that_is_no_number(data):
    def break_it(header):
        parameters = header["parameters"]
        assert isinstance(parameters, dict)
        parameters["properties"]["radius"] = "three"

    with pytest.raises(UnreadableModel, match=r"parameters\.properties\.radius is 'three'"):
        parse_model(with_header(data, break_it), "a file")


def test_paths_that_hold_no_model(tmp_path):
    with pytest.raises(UnreadableModel, match=r"cannot be read .*presets \(depth, lidar, paper\)"):
        read_model(tmp_path / "none")
    with pytest.raises(UnreadableModel, match="cannot be read"):
        read_model(tmp_path)
    large = tmp_path / "large"
    with large.open("wb") as file:
        file.truncate(17 << 20)
    with pytest.raises(UnreadableModel, match="exceed the maximum size"):
        read_model(large)


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
    "changes",
    [
        {"table": {"distance_bins": 100_000}}, {"hierarchy": {"n_levels": 0}},
        {"segmentation": {"iterations": 10**9}}, {"depth": {"maximum_pixels": 10**9}},
        {"normals": {"radius_px": math.inf}}, {"validation_segmentation": {"n_patches": 2001}},
        {"surroundings": {"far_distances": 10**6}}, {"surroundings": {"middle_radius": math.nan}},
        {"cloud": {"maximum_pixels": 1 << 21}}, {"cloud": {"radius_px": 40}},
        {"cloud": {"minimum_range": 0.0}}, {"cloud": {"maximum_range": 0.2}},
        {"cloud": {"image_angle": 1e-9}}, {"cloud": {"range_gate": 0.0}},
        {"cloud": {"maximum_range": math.inf}},
        {"cloud": {"maximum_pixels": 1 << 20, "radius_px": 16}},
        {"validation": {"agreement": {"edge_px": 10**9}}},
        {"validation": {"alignment": {"consensus": {"rounds": 10**9}}}},
        {"validation": {"alignment": {"sequence": {"n_sources": 10**9}}}},
        {"validation": {"rivals": {"n_proposed": 10**9}}},
        {"validation": {"alignment": {"plan": {"side": 10**9}}}},
        {"validation": {"alignment": {"plan": {"height_step": 1e-9}}}},
        {"validation": {"alignment": {"fine_stride": 0}}},
    ],
)  # fmt: skip
def test_parameters_that_would_take_all_memory_or_time_are_refused(data, changes):
    def merge(parameters, changes):
        for name, value in changes.items():
            if isinstance(value, dict):
                merge(parameters.setdefault(name, {}), value)
            else:
                parameters[name] = value

    with pytest.raises(UnreadableModel, match="missing or malformed"):
        parse_model(
            with_header(data, lambda header: merge(header["parameters"], changes)), "a file"
        )


def same(a, b):
    return (
        np.array_equal(a.features, b.features)
        and np.array_equal(a.components, b.components)
        and np.array_equal(a.posteriors, b.posteriors)
    )


def test_built_once_and_mapped(small_model, tmp_path):
    steps = []
    first = open_table(small_model, tmp_path / "cache", lambda done, n: steps.append((done, n)))
    (file,) = (tmp_path / "cache").iterdir()
    assert small_model.id in file.name
    assert steps[-1] == (small_model.parameters.table.n_bins,) * 2
    steps.clear()
    again = open_table(small_model, tmp_path / "cache", lambda done, n: steps.append((done, n)))
    assert steps == []
    assert same(first, again)
    assert same(first, build_table(small_model))
    base = again.features
    while isinstance(base, np.ndarray) and not isinstance(base, np.memmap):
        base = base.base
    assert isinstance(base, np.memmap)


def test_a_damaged_file_is_built_anew(small_model, tmp_path):
    right = build_table(small_model)
    open_table(small_model, tmp_path)
    (file,) = tmp_path.iterdir()
    whole = file.read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 1
    for damage in (b"", whole[: len(whole) // 2], b"x" * len(whole), bytes(flipped), whole + b"x"):
        file.unlink()  # a file that is mapped somewhere must not be written over
        file.write_bytes(damage)
        assert same(open_table(small_model, tmp_path), right)
        assert file.read_bytes() == whole


def test_without_a_cache_folder_the_table_is_held(small_model, tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    assert same(open_table(small_model, blocked), build_table(small_model))
    assert blocked.read_text() == "not a folder"
