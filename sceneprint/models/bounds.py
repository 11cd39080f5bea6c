"""What a model may ask for: no frame takes unbounded memory or time with it."""

from __future__ import annotations

from sceneprint.geometry.clouds import CloudParameters
from sceneprint.models.model import ModelParameters

#: Most components: the pair table names them in 16 bits.
MAXIMUM_COMPONENTS = 2**15 - 1
#: Least and most of what decides how much memory and time a frame takes.
BOUNDS = {
    "bins of the table": (1, 4_000_000),
    "levels": (1, 16),
    "patches": (1, 10_000),
    "pixels": (64, 1 << 20),
    "iterations": (0, 1000),
    "window": (1, 16),
    "patches for validation": (1, 2_000),
    "iterations for validation": (0, 1000),
    "bins of the surroundings": (1, 10_000),
    "bytes of a descriptor": (1, 1024),
    "pixels of a cloud": (64, 1 << 20),
    "fewest points of a cloud": (1, 1_000_000),
    "window of a cloud": (1, 16),
    "patches of a cloud": (1, 10_000),
    "patches of a cloud for validation": (1, 2_000),
    "gap of a cloud": (0, 1000),
    "neighbours in a cloud": (1, 1 << 27),
    "hypotheses": (1, 1000),
    "correspondences": (1, 10_000),
    "rivals": (0, 100),
    "iterations of a refinement": (0, 1000),
    "stride": (1, 1000),
    "pixels about an edge": (0, 100),
    "rounds of a hypothesis": (0, 1000),
    "neighbours in a sequence": (1, 1000),
    "correspondences of sequences": (1, 10_000),
}


#: Most bytes of a whitened signature.
MAXIMUM_DIMENSION = 1024


def check_whitening(levels: tuple[object, ...], n_levels: int, dimension: int) -> None:
    """See that a whitening is of levels that there are, and short.

    Raises
    ------
    ValueError : it is not.
    """
    known = [level for level in range(n_levels) if level in levels]
    if not known or list(levels) != known or any(isinstance(level, bool) for level in levels):
        raise ValueError(f"a whitening of levels {list(levels)} of {n_levels}")
    if not 1 <= dimension <= MAXIMUM_DIMENSION:
        raise ValueError(f"{dimension} bytes of a signature are not from 1 to {MAXIMUM_DIMENSION}")


def check_bounds(p: ModelParameters, n_components: int, n_compressed: int) -> None:
    """See that no frame can take unbounded memory or time with these parameters.

    Parameters
    ----------
    p : as read from a file
    n_components : of the mixture
    n_compressed : bytes of a descriptor

    Raises
    ------
    ValueError : a number is out of its bounds.
    """
    if n_components > MAXIMUM_COMPONENTS:
        raise ValueError(f"{n_components} components are more than {MAXIMUM_COMPONENTS}")
    t = p.table
    if min(t.distance_bins, t.angle_bins, t.dihedral_bins) < 1:
        raise ValueError("every axis of the table should have bins")
    if not (p.surroundings.scales >= 1e-3).all():
        raise ValueError("every scale of the surroundings should have a radius and bins")
    _check_cloud(p.cloud)
    alignment, rivals = p.validation.alignment, p.validation.rivals
    sequence = alignment.sequence
    refinements = (alignment.coarse, alignment.fine, rivals.first, rivals.then)
    strides = [p.validation.agreement.stride, *(one.stride for one in refinements)]
    counts = {
        "bins of the table": t.n_bins,
        "levels": p.hierarchy.n_levels,
        "patches": p.segmentation.n_patches,
        "pixels": p.depth.maximum_pixels,
        "iterations": max(p.segmentation.iterations, p.hierarchy.iterations),
        "window": p.normals.radius_px,
        "patches for validation": p.validation_segmentation.n_patches,
        "iterations for validation": p.validation_segmentation.iterations,
        "bins of the surroundings": p.surroundings.dimension,
        "bytes of a descriptor": n_compressed,
        "pixels of a cloud": p.cloud.maximum_pixels,
        "fewest points of a cloud": p.cloud.minimum_points,
        "window of a cloud": max(p.cloud.radius_px, p.cloud.image_radius_px),
        "patches of a cloud": p.cloud.maximum_patches,
        "patches of a cloud for validation": p.cloud.maximum_validation_patches,
        "gap of a cloud": p.cloud.gap_px,
        "neighbours in a cloud": p.cloud.maximum_pixels * (2 * p.cloud.radius_px + 1) ** 2,
        "hypotheses": max(alignment.n_refined, alignment.consensus.n_seeds),
        "correspondences": alignment.matching.n_sources * alignment.matching.n_nearest,
        "rivals": max(rivals.n_axes, rivals.n_planes, rivals.n_shifts),
        "iterations of a refinement": max(one.iterations for one in refinements),
        "stride": min(strides),
        "pixels about an edge": p.validation.agreement.edge_px,
        "rounds of a hypothesis": alignment.consensus.rounds,
        "neighbours in a sequence": sequence.n_neighbours,
        "correspondences of sequences": sequence.n_sources * sequence.n_nearest,
    }
    for what, (least, most) in BOUNDS.items():
        if not least <= counts[what] <= most:
            raise ValueError(f"{what}: {counts[what]} is not from {least} to {most}")


def _check_cloud(p: CloudParameters) -> None:
    """See that voxels and pixels have a size, and the range has points."""
    if not 1e-4 <= p.minimum_range < p.maximum_range <= 1e6:
        raise ValueError("the range of a cloud should begin above 0 and before it ends")
    if not (p.voxel_size > 0 and min(p.voxel_angle, p.image_angle) >= 1e-4):
        raise ValueError("voxels and pixels of a cloud should have a size")
    if not max(p.voxel_angle, p.image_angle) <= 0.1 or not p.same_surface > 0:
        raise ValueError("voxels and pixels of a cloud should be small, and not flat")
    if not min(p.seed_px, p.validation_seed_px) >= 1:
        raise ValueError("seeds of a cloud should be as far apart as voxels")
    if not 0 < p.range_gate <= 1:  # of 1, neighbours are as far as e times the range
        raise ValueError("neighbours in a cloud should be in some range of each other")
