"""Computation of a frame's signature (Sec. III-A and III-B).

Frame  --describe-->  Hierarchy  --encode-->  Signature
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sceneprint.errors import UselessFrame
from sceneprint.geometry.retrieval.ranking import Metric
from sceneprint.geometry.signature.fisher_vector import (
    LevelStatistics,
    fisher_vector,
    quantise,
    signature,
    statistics_of_counts,
    statistics_of_features,
    whiten,
)
from sceneprint.geometry.signature.pair_features import (
    PairTable,
    count_pairs,
    neighbour_pairs,
    pair_properties,
    project,
)
from sceneprint.geometry.signature.segmentation import (
    extract_patches,
    hierarchy,
    patch_weights,
    segment,
    supervoxels,
)
from sceneprint.geometry.surface.depth_image import fit_surface, inverse_depth
from sceneprint.geometry.surface.voxels import Voxels, voxels
from sceneprint.models import (
    PRESETS,
    Model,
    ModelParameters,
    build_table,
    open_table,
    read_model,
)
from sceneprint.types import AnyFrame, Bytes, Cloud, Floats, Hierarchy, Patches, Surface


@dataclass(frozen=True, eq=False)
class Signature:
    """The stored signature of a frame.

    Parameters
    ----------
    vector : uint8; whitened (d,), or quantised psi (25 G H,) for a model without whitening
    model_id : id of the model; signatures of different models cannot be compared
    n_patches : number of patches of each level, finest first
    n_pairs : number of ordered pairs of each level, finest first
    metric : metric that compares vectors of this model
    """

    vector: Bytes
    model_id: str
    n_patches: tuple[int, ...]
    n_pairs: tuple[int, ...]
    metric: Metric


@dataclass(frozen=True, eq=False)
class Signer:
    """A model with its pair table."""

    model: Model
    table: PairTable


def open_signer(
    model: str | Path | Model = PRESETS[0],
    cache_dir: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
    *,
    cached: bool = True,
) -> Signer:
    """Load a model, and load or build its pair table.

    The first call on a machine builds the table, which takes seconds, and caches it. Later calls
    map the cached table into memory.

    Parameters
    ----------
    model : "depth", "lidar", "paper", the path of a model file, or a model
    cache_dir : folder of cached tables; None selects the user's cache folder
    progress : callback that takes the number of finished bins and the total, while the table is
        built
    cached : whether to use the cache; pass False for a model that is used only once

    Raises
    ------
    UnreadableModel : See `read_model`
    """
    loaded = model if isinstance(model, Model) else read_model(model)
    if not cached:
        return Signer(loaded, build_table(loaded, progress))
    return Signer(loaded, open_table(loaded, cache_dir, progress))


def see(frame: AnyFrame, p: ModelParameters) -> Surface:
    """Compute the points and normals of a frame's surface, the input to Sec. III.

    Returns
    -------
    surface : image of points for a depth image; Voxels for a cloud

    Raises
    ------
    UselessFrame : If no sample lies within the sensor's range
    """
    if isinstance(frame, Cloud):
        return voxels(frame, p.cloud)
    q, camera = inverse_depth(frame, p.depth)
    return fit_surface(q, camera, p.normals)


def describe(frame: AnyFrame, p: ModelParameters) -> Hierarchy:
    """Compute the segmentation hierarchy of a frame; see `see` and `hierarchy_of`."""
    return hierarchy_of(see(frame, p), p, frame.name)


def hierarchy_of(seen: Surface, p: ModelParameters, name: str = "") -> Hierarchy:
    """Segment a surface into a hierarchy of patches: Sec. III-F.

    Parameters
    ----------
    seen : result of `see`
    name : name of the frame, for errors

    Raises
    ------
    UselessFrame : If the samples are too scattered to form a patch
    """
    if isinstance(seen, Voxels):
        finest = supervoxels(seen, p.cloud.seed_px, p.cloud.maximum_patches, p.segmentation)
        samples, advice = "points", "Check the units of its coordinates and its viewpoint"
    else:
        finest = segment(seen, p.segmentation)
        samples, advice = "depth samples", "Check that the image is depth and its scale is right"
    if finest.max(initial=-1) < 0:
        raise UselessFrame(
            f"{_prefix(name)}the {samples} do not lie on a surface: they are too scattered to form "
            f"a patch. {advice}, or send another frame."
        )
    return hierarchy(seen, finest, p.hierarchy)


def patches_for_validation(seen: Surface, p: ModelParameters) -> Patches:
    """Segment a surface into patches of a fixed size, for correspondences: Sec. III-E.

    Parameters
    ----------
    seen : result of `see`
    p : parameters of the model
    """
    if isinstance(seen, Voxels):
        spacing, most = p.cloud.validation_seed_px, p.cloud.maximum_validation_patches
        return extract_patches(seen, supervoxels(seen, spacing, most, p.validation_segmentation))
    return extract_patches(seen, segment(seen, p.validation_segmentation))


def encode(patches: Hierarchy, signer: Signer, name: str = "") -> Signature:
    """Compute the signature of a hierarchy of patches: Sec. III-A and III-B.

    Parameters
    ----------
    patches : hierarchy that has all levels of the model's signature
    signer : result of `open_signer`
    name : name of the frame, for errors

    Raises
    ------
    UselessFrame : If no two patches of the finest level are close enough to form a pair
    """
    model, whitening = signer.model, signer.model.whitening
    used = [patches.levels[level] for level in model.levels]
    levels = [table_statistics(level, signer) for level in used]
    psi = float_signature(levels, model, name)
    return Signature(
        vector=quantise(psi, model.quantiser_step) if whitening is None else whiten(psi, whitening),
        model_id=model.id,
        n_patches=tuple(len(level) for level in used),
        n_pairs=tuple(level.n_pairs for level in levels),
        metric=model.metric,
    )


def table_statistics(level: Patches, signer: Signer) -> LevelStatistics:
    """Compute the pair statistics of a level with the 4-D table."""
    p = signer.model.parameters
    weights = patch_weights(level, p.weights)
    counts = count_pairs(level.means, level.normals, weights, p.table, p.properties)
    return statistics_of_counts(counts, signer.table, len(signer.model.mixture.weights))


def exact_statistics(level: Patches, model: Model) -> LevelStatistics:
    """Compute the pair statistics of a level without the table, slowly, for tests of the table."""
    p = model.parameters.properties
    pairs = neighbour_pairs(level, p)
    weights = patch_weights(level, model.parameters.weights)[pairs].prod(axis=1)
    features = project(pair_properties(level, pairs, p), model.projection)
    return statistics_of_features(features, weights, model.mixture)


def float_signature(levels: list[LevelStatistics], model: Model, name: str = "") -> Floats:
    """Return psi before quantisation: the normalised Fisher vectors of all levels, concatenated.

    A coarse level without pairs contributes zeros.

    Parameters
    ----------
    levels : statistics of at least one level, finest first
    name : name of the frame, for errors

    Raises
    ------
    UselessFrame : If the finest level has no pairs
    """
    if levels[0].n_pairs == 0:
        radius = model.parameters.properties.radius
        raise UselessFrame(
            f"{_prefix(name)}no two surface patches lie within {radius:g} m of each other, so no "
            "geometry can be described. Send a frame that shows more of the scene."
        )
    return signature(
        [
            fisher_vector(level, model.mixture) if level.n_pairs else np.zeros(model.level_length)
            for level in levels
        ]
    )


def _prefix(name: str) -> str:
    return f"{name}: " if name else ""
