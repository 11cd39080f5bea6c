"""Parameters of a larger or smaller world: every length in them times one factor.

A cloud times s, under parameters scaled by s, signs the same, and validates to the same
transforms with translations times s. Depth images do not, quite: the gate of their plane fit
(`NormalParameters.plane_gate`) is a share of 1/z and 1/metres at once.
"""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

from sceneprint.geometry.registration.alignment import AlignmentParameters
from sceneprint.geometry.registration.consensus import ConsensusParameters
from sceneprint.geometry.registration.covariance import CovarianceParameters
from sceneprint.geometry.registration.icp import RefinementParameters
from sceneprint.geometry.registration.overlap import OverlapParameters, PlaneParameters
from sceneprint.geometry.registration.patch_descriptors import PatchDescriptorParameters
from sceneprint.geometry.registration.plan_search import PlanParameters
from sceneprint.geometry.registration.sequence_alignment import SequenceParameters
from sceneprint.geometry.signature.pair_features import PropertyParameters
from sceneprint.geometry.surface.cloud import CloudParameters
from sceneprint.geometry.surface.depth_image import DepthParameters
from sceneprint.geometry.validation.acceptance import AcceptanceParameters
from sceneprint.geometry.validation.ambiguity import AmbiguityParameters

T = TypeVar("T")

#: Numbers that are not bare: the power of a metre in each.
POWERS: dict[type, dict[str, int]] = {
    DepthParameters: {"minimum_depth": 1, "maximum_depth": 1},
    CloudParameters: {
        "minimum_range": 1,
        "maximum_range": 1,
        "voxel_size": 1,
        "noise_gate": -1,
    },
    PropertyParameters: {"radius": 1},
    PatchDescriptorParameters: {"near_radius": 1, "middle_radius": 1, "far_radius": 1},
    AcceptanceParameters: {"residual_m": 1},
    OverlapParameters: {
        "surface_tolerance": 1,
        "point_tolerance": 1,
        "free_space_margin": 1,
        "reference_depth": 1,
        "nearest": 1,
    },
    AlignmentParameters: {"same_m": 1, "lever": 1},
    ConsensusParameters: {
        "distance_tolerance": 1,
        "minimum_distance": 1,
        "normal_weight": 2,
        "inlier_distance": 1,
    },
    CovarianceParameters: {"least_square": 2, "most": 1, "lever": 1},
    PlaneParameters: {"same_plane": 1},
    PlanParameters: {"cell": 1, "voxel": 1, "height_step": 1, "height_range": 1},
    RefinementParameters: {
        "first_gate": 1,
        "last_gate": 1,
        "reference_depth": 1,
        "weight_depth": 1,
        "nearest": 1,
        "reach": 1,
    },
    AmbiguityParameters: {"shift": 1, "rival_m": 1},
    SequenceParameters: {
        "opposite_distance": 1,
        "minimum_distance": 1,
        "radius": 1,
        "length_scale": 1,
    },
}


def scaled(parameters: T, factor: float) -> T:
    """A record of parameters with every length in it, and in its groups, times a factor.

    Parameters
    ----------
    parameters : a frozen record, such as ModelParameters
    factor : above 0; areas take its square
    """
    powers = POWERS.get(type(parameters), {})
    changed: dict[str, Any] = {}
    for one in fields(parameters):  # type: ignore[arg-type]
        value = getattr(parameters, one.name)
        if is_dataclass(value):
            changed[one.name] = scaled(value, factor)
        elif one.name in powers:
            changed[one.name] = value * factor ** powers[one.name]
    return replace(parameters, **changed)  # type: ignore[type-var]
