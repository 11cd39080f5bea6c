"""Model files, and the cache of the pair tables computed from models.

A model file is a safetensors file with a JSON header; it contains no pickle or code. Its pair table
is built once per machine; all processes then map it into memory.
"""

from __future__ import annotations

import json
import math
import re
import zlib
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs

from sceneprint.atomic_files import write_whole
from sceneprint.errors import UnreadableModel
from sceneprint.geometry.registration.patch_descriptors import Compression
from sceneprint.geometry.signature.fisher_vector import Whitening
from sceneprint.geometry.signature.mixture import Mixture
from sceneprint.geometry.signature.pair_features import (
    FEATURE_DIMENSION,
    PROPERTY_DIMENSION,
    WIDTH,
    PairTable,
    Projection,
    compute_bins,
)
from sceneprint.geometry.surface.cloud import CloudParameters
from sceneprint.models.model import (
    PSI_SCHEMA_VERSION,
    SCHEMA_VERSION,
    AnswerParameters,
    Model,
    ModelParameters,
    apply_changes,
    differences,
    parse_parameters,
)
from sceneprint.types import Floats32
from sceneprint_client.api.maps import PRESETS

#: Maximum number of components, because the pair table stores 16-bit indices.
MAXIMUM_COMPONENTS = 2**15 - 1
#: Minimum and maximum of each number that determines the memory and time per frame.
BOUNDS = {
    "pair-table bins": (1, 4_000_000),
    "levels": (1, 16),
    "patches": (1, 10_000),
    "pixels": (64, 1 << 20),
    "iterations": (0, 1000),
    "window": (1, 16),
    "patches for validation": (1, 2_000),
    "iterations for validation": (0, 1000),
    "bins per descriptor histogram": (1, 10_000),
    "bytes per descriptor": (1, 1024),
    "pixels per cloud": (64, 1 << 20),
    "minimum points per cloud": (1, 1_000_000),
    "window for clouds": (1, 16),
    "patches per cloud": (1, 10_000),
    "patches per cloud for validation": (1, 2_000),
    "gap for clouds": (0, 1000),
    "neighbours per cloud": (1, 1 << 27),
    "hypotheses": (1, 1000),
    "correspondences": (1, 10_000),
    "rivals": (0, 100),
    "iterations per refinement": (0, 1000),
    "stride": (1, 1000),
    "edge pixels": (0, 100),
    "rounds per hypothesis": (0, 1000),
    "neighbours per sequence": (1, 1000),
    "correspondences from sequences": (1, 10_000),
    "cells per side of a plan": (16, 512),
    "yaws per plan": (1, 720),
    "heights per plan": (1, 10_000),
    "hypotheses from plans": (1, 1000),
    "views per pose": (1, 100),
    "compared poses": (1, 1000),
}


#: Maximum length of a whitened signature, bytes.
MAXIMUM_DIMENSION = 1024


def check_whitening(levels: tuple[object, ...], n_levels: int, dimension: int) -> None:
    """Validate the levels of a whitening and the length of its signatures.

    Raises
    ------
    ValueError : If a level does not exist or the length is out of bounds
    """
    valid = [level for level in range(n_levels) if level in levels]
    if not valid or list(levels) != valid or any(isinstance(level, bool) for level in levels):
        raise ValueError(
            f"a whitening cannot use the levels {list(levels)} of a hierarchy of {n_levels}"
        )
    if not 1 <= dimension <= MAXIMUM_DIMENSION:
        raise ValueError(
            f"a signature of {dimension} bytes is not in the range 1 to {MAXIMUM_DIMENSION}"
        )


def check_bounds(p: ModelParameters, n_components: int, n_compressed: int) -> None:
    """Validate that parameters from a file bound the memory and time per frame.

    Parameters
    ----------
    n_compressed : number of bytes per descriptor

    Raises
    ------
    ValueError : If a number is out of bounds
    """
    if n_components > MAXIMUM_COMPONENTS:
        raise ValueError(f"{n_components} components exceed the maximum of {MAXIMUM_COMPONENTS}")
    t = p.table
    if min(t.distance_bins, t.angle_bins, t.dihedral_bins) < 1:
        raise ValueError("every axis of the pair table must have bins")
    if not (p.surroundings.scales >= 1e-3).all():
        raise ValueError("every scale of the descriptor histograms must have a radius and bins")
    _check_cloud(p.cloud)
    alignment, rivals = p.validation.alignment, p.validation.rivals
    sequence = alignment.sequence
    refinements = (alignment.coarse, alignment.fine, rivals.first, rivals.then)
    strides = [p.validation.agreement.stride, *(refinement.stride for refinement in refinements)]
    strides += [alignment.fine_stride, alignment.score_stride]
    plan = alignment.plan
    if not (plan.cell > 0 and plan.voxel > 0 and 0 < plan.height_step <= plan.height_range < 1e6):
        raise ValueError("cells, voxels and heights of a plan must have a positive size")
    counts = {
        "pair-table bins": t.n_bins,
        "levels": p.hierarchy.n_levels,
        "patches": p.segmentation.n_patches,
        "pixels": p.depth.maximum_pixels,
        "iterations": max(p.segmentation.iterations, p.hierarchy.iterations),
        "window": p.normals.radius_px,
        "patches for validation": p.validation_segmentation.n_patches,
        "iterations for validation": p.validation_segmentation.iterations,
        "bins per descriptor histogram": p.surroundings.dimension,
        "bytes per descriptor": n_compressed,
        "pixels per cloud": p.cloud.maximum_pixels,
        "minimum points per cloud": p.cloud.minimum_points,
        "window for clouds": max(p.cloud.radius_px, p.cloud.image_radius_px),
        "patches per cloud": p.cloud.maximum_patches,
        "patches per cloud for validation": p.cloud.maximum_validation_patches,
        "gap for clouds": p.cloud.gap_px,
        "neighbours per cloud": p.cloud.maximum_pixels * (2 * p.cloud.radius_px + 1) ** 2,
        "hypotheses": max(alignment.n_refined, alignment.n_fine, alignment.consensus.n_seeds),
        "correspondences": alignment.matching.n_sources * alignment.matching.n_nearest,
        "rivals": max(rivals.n_axes, rivals.n_planes, rivals.n_shifts, rivals.n_proposed),
        "iterations per refinement": max(refinement.iterations for refinement in refinements),
        "stride": min(strides),
        "edge pixels": p.validation.agreement.edge_px,
        "rounds per hypothesis": alignment.consensus.rounds,
        "neighbours per sequence": sequence.n_neighbours,
        "correspondences from sequences": sequence.n_sources * sequence.n_nearest,
        "cells per side of a plan": plan.side,
        "yaws per plan": max(plan.n_yaws, plan.kept_yaws, 2 * plan.sliced_yaws),
        "heights per plan": round(plan.height_range / plan.height_step),
        "hypotheses from plans": max(
            max(plan.n_kept, plan.n_sliced) * plan.n_heights,
            max(plan.kept_yaws, 2 * plan.sliced_yaws) * plan.n_peaks,
        ),
    }
    _check_counts(counts)


def _check_cloud(p: CloudParameters) -> None:
    if not 1e-4 <= p.minimum_range < p.maximum_range <= 1e6:
        raise ValueError("the range for clouds must start above 0 and must not be empty")
    if not (p.voxel_size > 0 and min(p.voxel_angle, p.image_angle) >= 1e-4):
        raise ValueError("the sizes of voxels and pixels for clouds must be positive")
    if not max(p.voxel_angle, p.image_angle) <= 0.1 or not p.same_surface > 0:
        raise ValueError("voxel and pixel angles and same_surface for clouds are out of bounds")
    if not min(p.seed_px, p.validation_seed_px) >= 1:
        raise ValueError("the distance between seeds for clouds must be at least one voxel")
    if not 0 < p.range_gate <= 1:  # a gate of 1 admits neighbours at e times the range
        raise ValueError("the range gate for clouds must be above 0 and at most 1")


#: Maximum size of a model file, bytes; it suffices for the maximum number of components.
MAXIMUM_BYTES = 16 << 20


def write_model(model: Model) -> bytes:
    """Serialize a model as the bytes of its file."""
    from safetensors.numpy import save

    header = model.header | {
        "id": model.id,
        "name": model.name,
        "provenance": dict(model.provenance),
        "answer": differences(model.answer),
    }
    return bytes(save(model.tensors, {"sceneprint": json.dumps(header, sort_keys=True)}))


def save_model(model: Model, path: Path) -> None:
    """Write a model to a file atomically; the folder must exist."""
    data = write_model(model)
    parse_model(data, str(path))  # raise an error instead of writing an unreadable file
    write_whole(path, data)


def read_model(model: str | Path) -> Model:
    """Read a preset by its name or a model file by its path.

    Raises
    ------
    UnreadableModel : If the preset or file does not exist, is not a model, has another schema, or
        its content does not match the id in its header
    """
    if str(model) in PRESETS:
        source = resources.files("sceneprint") / "presets" / f"{model}.safetensors"
        return parse_model(source.read_bytes(), f"preset {model}")
    path = Path(model)
    try:
        if path.stat().st_size > MAXIMUM_BYTES:
            raise UnreadableModel(
                f"{path}: {path.stat().st_size} bytes exceed the maximum size of a model. "
                "Specify the path of a file that `sceneprint train` wrote."
            )
        data = path.read_bytes()
    except OSError as error:
        raise UnreadableModel(
            f"{path}: cannot be read ({error.strerror or error}). Specify one of the presets "
            f"({', '.join(PRESETS)}), or the path of a file that `sceneprint train` wrote."
        ) from error
    return parse_model(data, str(path))


def parse_model(data: bytes, name: str) -> Model:
    """Parse a model from the bytes of its file.

    Parameters
    ----------
    name : name of the file, for errors

    Raises
    ------
    UnreadableModel : If the bytes are not a valid model; see `read_model`
    """
    from safetensors.numpy import load

    try:
        length = int.from_bytes(data[:8], "little")
        metadata = json.loads(data[8 : 8 + length])["__metadata__"]
        header: dict[str, Any] = dict(json.loads(metadata["sceneprint"]))
        tensors = load(data)
    except Exception as error:  # safetensors and json raise various exceptions
        raise UnreadableModel(
            f"{name}: not a model file ({type(error).__name__}: {error}). "
            "Specify the path of a file that `sceneprint train` wrote."
        ) from error
    schema = SCHEMA_VERSION if "whitening" in header else PSI_SCHEMA_VERSION
    if header.get("schema_version") != schema:
        raise UnreadableModel(
            f"{name}: the model has schema {header.get('schema_version')}, but this version of "
            f"sceneprint reads schema {schema}. Train the model again, or use the version that "
            "wrote it."
        )
    try:
        model, expected = _assemble_model(header, tensors), str(header["id"])
    except UnreadableModel as error:
        raise UnreadableModel(f"{name}: {error}") from error
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
        raise UnreadableModel(
            f"{name}: a part of the model is missing or malformed ({error}). Download the model "
            "again, or train it again."
        ) from error
    if model.id != expected:
        raise UnreadableModel(
            f"{name}: the content has the id {model.id[:12]}, but the header has {expected[:12]}: "
            "the file is damaged. Download the model again, or train it again."
        )
    return model


def _assemble_model(header: dict[str, Any], tensors: dict[str, np.ndarray]) -> Model:
    g = len(tensors["mixture.weights"])
    shapes = {
        "projection.mean": (PROPERTY_DIMENSION,),
        "projection.matrix": (FEATURE_DIMENSION, PROPERTY_DIMENSION),
        "mixture.weights": (g,),
        "mixture.means": (g, FEATURE_DIMENSION),
        "mixture.variances": (g, FEATURE_DIMENSION),
    }
    parameters = parse_parameters(header["parameters"])
    check_bounds(parameters, g, len(tensors["compression.matrix"]))
    bins = parameters.surroundings.dimension
    shapes["compression.mean"] = (bins,)
    shapes["compression.matrix"] = (len(tensors["compression.matrix"]), bins)
    for name, shape in shapes.items():
        tensor, kind = tensors[name], "float32" if name.startswith("compression") else "float64"
        if tensor.shape != shape or tensor.dtype != kind or not np.isfinite(tensor).all():
            raise ValueError(f"{name} must be finite {kind} {shape}")
    if (
        g < 1
        or (tensors["mixture.weights"] <= 0).any()
        or (tensors["mixture.variances"] <= 0).any()
    ):
        raise ValueError("weights and variances must be positive")
    step, d0 = float(header["quantiser_step"]), float(header["unrelated_distance"])
    if not (math.isfinite(step) and step > 0 and math.isfinite(d0) and d0 > 0):
        raise ValueError("quantiser step and unrelated distance must be positive")
    if not re.fullmatch(r"[\w.-]{1,64}", str(header["name"]), re.ASCII):
        raise ValueError("a name must have 1 to 64 letters, digits, dots and dashes")
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
        whitening=_parse_whitening(header, tensors, 25 * g, parameters.hierarchy.n_levels),
        answer=_parse_answer(header.get("answer", {})),
    )


def _parse_answer(values: Any) -> AnswerParameters:
    """Parse the answer parameters; raise ValueError or UnreadableModel if they are invalid."""
    answer = apply_changes(AnswerParameters(), values, "answer")
    refinement, views = answer.map.refinement, answer.map
    counts = {
        "iterations per refinement": refinement.iterations,
        "stride": refinement.stride,
        "views per pose": max(views.n_views, views.n_refining, views.n_noise),
        "compared poses": max(views.n_poses, views.n_places, views.n_refined),
    }
    _check_counts(counts)
    if not (views.cell > 0 and views.reach > 0 and views.around_reach > 0):
        raise ValueError("the reaches and the cell of the map verification must be positive")
    return answer


def _check_counts(counts: dict[str, int]) -> None:
    """Raise ValueError if a number is not within its BOUNDS."""
    for name, count in counts.items():
        least, most = BOUNDS[name]
        if not least <= count <= most:
            raise ValueError(f"{name}: {count} is not in the range {least} to {most}")


def _parse_whitening(
    header: dict[str, Any], tensors: dict[str, np.ndarray], level_length: int, n_levels: int
) -> Whitening | None:
    """Parse the whitening of a file; return None if the file has no whitening."""
    if "whitening" not in header:
        return None
    values, basis = header["whitening"], tensors["whitening.basis"]
    levels, d0 = tuple(values["levels"]), float(values["unrelated_distance"])
    check_whitening(levels, n_levels, len(basis))
    shapes = {
        "basis": ("int8", (len(basis), level_length * len(levels))),
        "scales": ("float64", (len(basis),)),
        "offsets": ("float64", (len(basis),)),
    }
    for name, (kind, shape) in shapes.items():
        tensor = tensors[f"whitening.{name}"]
        if tensor.shape != shape or tensor.dtype != kind or not np.isfinite(tensor).all():
            raise ValueError(f"whitening.{name} must be finite {kind} {shape}")
    if not (math.isfinite(d0) and d0 > 0):
        raise ValueError("the unrelated distance of the whitening must be positive")
    scales, offsets = tensors["whitening.scales"], tensors["whitening.offsets"]
    return Whitening(levels, basis, scales, offsets, d0)


#: Version of the layout of cached files, which is part of their names.
CACHE_VERSION = 1
#: Number of bytes before the bins, a multiple of a cache line so that the bins are aligned.
HEAD = 64
#: Number of bins between two progress reports.
CHUNK = 16_384

#: Callback that takes the number of finished bins and the total number of bins.
Progress = Callable[[int, int], None]


def default_cache_dir() -> Path:
    """Return the default folder of cached tables, in the user's cache folder."""
    return Path(platformdirs.user_cache_dir("sceneprint", appauthor=False))


def open_table(
    model: Model, cache_dir: Path | None = None, progress: Progress | None = None
) -> PairTable:
    """Open the pair table of a model from the cache, or build and cache it.

    Processes that build it simultaneously all write complete files with the same bytes. If the
    cache folder is not writable, the table exists only in memory.

    Parameters
    ----------
    cache_dir : folder of cached tables, created if missing; None selects the default
    progress : callback while the table is built; see Progress
    """
    folder = default_cache_dir() if cache_dir is None else cache_dir
    path = folder / f"table-v{CACHE_VERSION}-{model.id}.bin"
    cached = _map_table(path, model)
    if cached is not None:
        return cached
    table = build_table(model, progress)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(path, _file_head(table.packed) + table.packed.tobytes())
    except OSError:  # the cache is optional
        return table
    return _map_table(path, model) or table


def _map_table(path: Path, model: Model) -> PairTable | None:
    try:
        with path.open("rb") as file:
            head = file.read(HEAD)
        shape = (model.parameters.table.n_bins, WIDTH)
        if path.stat().st_size != HEAD + 4 * shape[0] * shape[1]:
            return None
        packed = np.memmap(path, np.float32, "r", offset=HEAD, shape=shape)
    except (OSError, ValueError):
        return None
    # slicing a memmap is slow, so use an ndarray that shares its memory
    return PairTable(np.asarray(packed)) if head == _file_head(packed) else None


def _file_head(packed: Floats32) -> bytes:
    """Return the head of a cached file: kind, version and checksum, which is verified in 20 ms."""
    checksum = zlib.crc32(packed.view(np.uint8).data)
    return f"sceneprint table {CACHE_VERSION} {checksum:08x}".encode().ljust(HEAD)


def build_table(model: Model, progress: Progress | None = None) -> PairTable:
    """Compute the table of a model in memory; `progress` is called after each chunk of bins."""
    p, n = model.parameters, model.parameters.table.n_bins
    packed = np.empty((n, WIDTH), np.float32)
    for first in range(0, n, CHUNK):
        last = min(first + CHUNK, n)
        part = compute_bins(first, last, p.table, p.properties, model.projection, model.mixture)
        packed[first:last] = part.packed
        if progress is not None:
            progress(last, n)
    return PairTable(packed)
