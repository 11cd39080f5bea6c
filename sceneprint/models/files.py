"""Model files: safetensors with a JSON header; no pickle, nothing executed."""

from __future__ import annotations

import json
import math
import re
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from sceneprint.errors import UnreadableModel
from sceneprint.geometry.mixture import Mixture
from sceneprint.geometry.projection import DIMENSION, Projection
from sceneprint.geometry.properties import DIMENSION as PROPERTY_DIMENSION
from sceneprint.geometry.surroundings import Compression
from sceneprint.geometry.whitening import Whitening
from sceneprint.models.bounds import check_bounds, check_whitening
from sceneprint.models.model import PSI_SCHEMA_VERSION, SCHEMA_VERSION, Model, parameters_of
from sceneprint.writing import write_whole

#: Names of the models that ship with the package, the default first.
PRESETS = ("depth", "lidar", "paper")
#: Presets of earlier versions, and what takes their place.
FORMER_PRESETS = {"compact": "depth"}
#: A model of the most components fits; a larger file is refused unread.
MAXIMUM_BYTES = 16 << 20


def write_model(model: Model) -> bytes:
    """A model as the bytes of its file."""
    from safetensors.numpy import save

    header = model.header | {
        "id": model.id,
        "name": model.name,
        "provenance": dict(model.provenance),
    }
    return bytes(save(model.tensors, {"sceneprint": json.dumps(header, sort_keys=True)}))


def save_model(model: Model, path: Path) -> None:
    """Write a model to a file, whole or not at all.

    Parameters
    ----------
    model : see Model
    path : of the file; its folder must exist
    """
    data = write_model(model)
    parse_model(data, str(path))  # what cannot be read back is not written
    write_whole(path, data)


def read_model(model: str | Path) -> Model:
    """Read a preset by its name, or a model file by its path.

    Parameters
    ----------
    model : one of PRESETS, or a path

    Raises
    ------
    UnreadableModel : no such preset or file, not a model, another schema, or content that
        does not give the id in its header.
    """
    if str(model) in PRESETS:
        source = resources.files("sceneprint") / "presets" / f"{model}.safetensors"
        return parse_model(source.read_bytes(), f"preset {model}")
    path = Path(model)
    if str(model) in FORMER_PRESETS and not path.exists():
        raise UnreadableModel(
            f"There is no preset {model!r} any more. Use {FORMER_PRESETS[str(model)]!r} instead. "
            "Maps made with it are still served, and `sceneprint reencode` moves them."
        )
    try:
        if path.stat().st_size > MAXIMUM_BYTES:
            raise UnreadableModel(
                f"{path}: {path.stat().st_size} bytes are more than any model has. "
                "Give the path of a file that `sceneprint train` wrote."
            )
        data = path.read_bytes()
    except OSError as error:
        raise UnreadableModel(
            f"{path}: cannot be read ({error.strerror or error}). Give one of the presets "
            f"({', '.join(PRESETS)}), or the path of a file that `sceneprint train` wrote."
        ) from error
    return parse_model(data, str(path))


def parse_model(data: bytes, name: str) -> Model:
    """Read a model from the bytes of its file.

    Parameters
    ----------
    data : the file
    name : of the file, for errors

    Raises
    ------
    UnreadableModel : see `read_model`.
    """
    from safetensors.numpy import load

    try:
        length = int.from_bytes(data[:8], "little")
        metadata = json.loads(data[8 : 8 + length])["__metadata__"]
        header: dict[str, Any] = dict(json.loads(metadata["sceneprint"]))
        tensors = load(data)
    except Exception as error:  # safetensors raises its own, json and Python theirs
        raise UnreadableModel(
            f"{name}: not a model file ({type(error).__name__}: {error}). "
            "Give the path of a file that `sceneprint train` wrote."
        ) from error
    schema = SCHEMA_VERSION if "whitening" in header else PSI_SCHEMA_VERSION
    if header.get("schema_version") != schema:
        raise UnreadableModel(
            f"{name}: schema {header.get('schema_version')} is not {schema}, the one this version "
            "of sceneprint reads. Train it again, or use the version that wrote it."
        )
    try:
        model, given = _assemble(header, tensors), str(header["id"])
    except UnreadableModel as error:
        raise UnreadableModel(f"{name}: {error}") from error
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
        raise UnreadableModel(
            f"{name}: a part of the model is missing or misshapen ({error}). "
            "Fetch or train it again."
        ) from error
    if model.id != given:
        raise UnreadableModel(
            f"{name}: its content gives the id {model.id[:12]}, its header says "
            f"{given[:12]}: the file was damaged. Fetch or train it again."
        )
    return model


def _assemble(header: dict[str, Any], tensors: dict[str, np.ndarray]) -> Model:
    g = len(tensors["mixture.weights"])
    shapes = {
        "projection.mean": (PROPERTY_DIMENSION,),
        "projection.matrix": (DIMENSION, PROPERTY_DIMENSION),
        "mixture.weights": (g,),
        "mixture.means": (g, DIMENSION),
        "mixture.variances": (g, DIMENSION),
    }
    parameters = parameters_of(header["parameters"])
    check_bounds(parameters, g, len(tensors["compression.matrix"]))
    bins = parameters.surroundings.dimension
    shapes["compression.mean"] = (bins,)
    shapes["compression.matrix"] = (len(tensors["compression.matrix"]), bins)
    for name, shape in shapes.items():
        tensor, kind = tensors[name], "float32" if name.startswith("compression") else "float64"
        if tensor.shape != shape or tensor.dtype != kind or not np.isfinite(tensor).all():
            raise ValueError(f"{name} should be finite {kind} {shape}")
    if (
        g < 1
        or (tensors["mixture.weights"] <= 0).any()
        or (tensors["mixture.variances"] <= 0).any()
    ):
        raise ValueError("weights and variances should be positive")
    step, d0 = float(header["quantiser_step"]), float(header["unrelated_distance"])
    if not (math.isfinite(step) and step > 0 and math.isfinite(d0) and d0 > 0):
        raise ValueError("quantiser step and unrelated distance should be positive")
    if not re.fullmatch(r"[\w.-]{1,64}", str(header["name"]), re.ASCII):
        raise ValueError("a name is up to 64 letters, digits, dots and dashes")
    return Model(
        name=str(header["name"]),
        parameters=parameters,
        projection=Projection(tensors["projection.mean"], tensors["projection.matrix"]),
        mixture=Mixture(
            tensors["mixture.weights"], tensors["mixture.means"], tensors["mixture.variances"]
        ),
        compression=Compression(tensors["compression.mean"], tensors["compression.matrix"]),
        quantiser_step=step,
        psi_unrelated_distance=d0,
        provenance=dict(header["provenance"]),
        whitening=_whitening(header, tensors, 25 * g, parameters.hierarchy.n_levels),
    )


def _whitening(
    header: dict[str, Any], tensors: dict[str, np.ndarray], level_length: int, n_levels: int
) -> Whitening | None:
    """The whitening of a file; None of a model that has none."""
    if "whitening" not in header:
        return None
    told, basis = header["whitening"], tensors["whitening.basis"]
    levels, d0 = tuple(told["levels"]), float(told["unrelated_distance"])
    check_whitening(levels, n_levels, len(basis))
    shapes = {
        "basis": ("int8", (len(basis), level_length * len(levels))),
        "scales": ("float64", (len(basis),)),
        "offsets": ("float64", (len(basis),)),
    }
    for name, (kind, shape) in shapes.items():
        tensor = tensors[f"whitening.{name}"]
        if tensor.shape != shape or tensor.dtype != kind or not np.isfinite(tensor).all():
            raise ValueError(f"whitening.{name} should be finite {kind} {shape}")
    if not (math.isfinite(d0) and d0 > 0):
        raise ValueError("the unrelated distance of the whitening should be positive")
    scales, offsets = tensors["whitening.scales"], tensors["whitening.offsets"]
    return Whitening(levels, basis, scales, offsets, d0)
