"""A model: all data that determine signatures and artifacts, identified by a digest.

`scale_lengths` returns parameters for a larger or smaller world. If a cloud and the lengths of the
parameters are multiplied by s, the signature is unchanged, and translations are multiplied by s.
For depth images, this holds approximately: the gate of their plane fit
(`NormalParameters.plane_gate`) is both a share of 1/z and a value in 1/metres.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from functools import cached_property
from typing import Any, TypeVar, get_type_hints

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import UnreadableModel
from sceneprint.geometry.registration.alignment import AlignmentParameters, ConsensusParameters
from sceneprint.geometry.registration.icp import CovarianceParameters, RefinementParameters
from sceneprint.geometry.registration.overlap import OverlapParameters, PlaneParameters
from sceneprint.geometry.registration.patch_descriptors import (
    Compression,
    PatchDescriptorParameters,
)
from sceneprint.geometry.registration.plan_search import PlanParameters
from sceneprint.geometry.registration.sequence_alignment import SequenceParameters
from sceneprint.geometry.retrieval.ranking import Metric
from sceneprint.geometry.signature.fisher_vector import Ints8, Whitening
from sceneprint.geometry.signature.mixture import Mixture
from sceneprint.geometry.signature.pair_features import Projection, PropertyParameters, TableLayout
from sceneprint.geometry.signature.segmentation import (
    HierarchyParameters,
    SegmentationParameters,
    WeightParameters,
)
from sceneprint.geometry.surface.cloud import CloudParameters
from sceneprint.geometry.surface.depth_image import DepthParameters, NormalParameters
from sceneprint.geometry.validation.acceptance import AcceptanceParameters, AmbiguityParameters
from sceneprint.geometry.validation.confidence import ConfidenceModel
from sceneprint.geometry.validation.map_verification import MapParameters
from sceneprint.geometry.validation.validation import ValidationParameters
from sceneprint.types import Floats32

#: Versions of the file format and its semantics, for models with and without a whitening. A model's
#: id depends on its version. Raise a version if a change of code changes signatures of such models.
SCHEMA_VERSION, PSI_SCHEMA_VERSION = 3, 2

#: Groups of parameters; files and ids omit those with the default value. Therefore, new
#: parameters preserve the ids of existing models, but defaults must not change.
SPARSE = ("cloud", "validation")

T = TypeVar("T")


@dataclass(frozen=True)
class ModelParameters:
    """The parameters of all stages, in the order of the paper."""

    depth: DepthParameters = field(default_factory=DepthParameters)
    normals: NormalParameters = field(default_factory=NormalParameters)
    segmentation: SegmentationParameters = field(default_factory=SegmentationParameters)
    hierarchy: HierarchyParameters = field(default_factory=HierarchyParameters)
    weights: WeightParameters = field(default_factory=WeightParameters)
    properties: PropertyParameters = field(default_factory=PropertyParameters)
    table: TableLayout = field(default_factory=TableLayout)
    validation_segmentation: SegmentationParameters = field(
        default_factory=lambda: SegmentationParameters(n_patches=400)
    )
    surroundings: PatchDescriptorParameters = field(default_factory=PatchDescriptorParameters)
    cloud: CloudParameters = field(default_factory=CloudParameters)
    validation: ValidationParameters = field(default_factory=ValidationParameters)


@dataclass(frozen=True)
class AnswerParameters:
    """The parameters for evaluating poses on a map; they do not affect signatures and artifacts."""

    map: MapParameters = field(default_factory=MapParameters)
    confidence: ConfidenceModel = field(default_factory=ConfidenceModel)


@dataclass(frozen=True, eq=False)
class Model:
    """Projection, mixture, quantiser, compression, whitening, and the parameters of each stage.

    A whitened signature has a few hundred bytes and is compared by L2. Without a whitening, the
    signature is psi and is compared by L1, as in Sec. III-C.

    Parameters
    ----------
    name : display name; not part of the id
    quantiser_step : difference in psi per unit of a quantised byte
    psi_unrelated_distance : median L1 distance between quantised psi of unrelated training frames
    provenance : data and settings of the training; not part of the id
    whitening : see Whitening; None if signatures are psi
    answer : see AnswerParameters; not part of the id, so that a change requires no new signatures
    """

    name: str
    parameters: ModelParameters
    projection: Projection
    mixture: Mixture
    compression: Compression
    quantiser_step: float
    psi_unrelated_distance: float
    provenance: Mapping[str, Any]
    whitening: Whitening | None = None
    answer: AnswerParameters = field(default_factory=AnswerParameters)

    @property
    def metric(self) -> Metric:
        """Return the metric of stored signatures."""
        return "l1" if self.whitening is None else "l2"

    @property
    def unrelated_distance(self) -> float:
        """Return d0, the median distance of unrelated training frames, in `metric`."""
        if self.whitening is None:
            return self.psi_unrelated_distance
        return self.whitening.unrelated_distance

    @property
    def levels(self) -> tuple[int, ...]:
        """Return the hierarchy levels that a signature contains, ascending; 0 is the finest."""
        if self.whitening is None:
            return tuple(range(self.parameters.hierarchy.n_levels))
        return self.whitening.levels

    @property
    def tensors(self) -> dict[str, NDArray[np.float64] | Floats32 | Ints8]:
        """Return the fitted arrays by name, as in the file."""
        arrays = {
            "projection.mean": self.projection.mean,
            "projection.matrix": self.projection.matrix,
            "mixture.weights": self.mixture.weights,
            "mixture.means": self.mixture.means,
            "mixture.variances": self.mixture.variances,
        }
        small = {
            "compression.mean": self.compression.mean,
            "compression.matrix": self.compression.matrix,
        }
        bytes_: dict[str, Ints8] = {}
        if self.whitening is not None:
            bytes_["whitening.basis"] = self.whitening.basis
            arrays["whitening.scales"] = self.whitening.scales
            arrays["whitening.offsets"] = self.whitening.offsets
        # safetensors writes raw memory, which must be in C order
        return {
            **{name: np.ascontiguousarray(array, "<f8") for name, array in arrays.items()},
            **{name: np.ascontiguousarray(array, "<f4") for name, array in small.items()},
            **{name: np.ascontiguousarray(array, "i1") for name, array in bytes_.items()},
        }

    @property
    def header(self) -> dict[str, Any]:
        """Return all values on which signatures or artifacts depend, except arrays."""
        header = {
            "schema_version": PSI_SCHEMA_VERSION,
            "parameters": to_mapping(self.parameters),
            "quantiser_step": self.quantiser_step,
            "unrelated_distance": self.psi_unrelated_distance,
        }
        if self.whitening is None:
            return header
        whitening = {
            "levels": list(self.whitening.levels),
            "unrelated_distance": self.whitening.unrelated_distance,
        }
        return header | {"schema_version": SCHEMA_VERSION, "whitening": whitening}

    @cached_property
    def id(self) -> str:
        """Return the SHA-256 of header and arrays, as 64 hexadecimal digits."""
        digest = hashlib.sha256(json.dumps(self.header, sort_keys=True).encode())
        for name, tensor in sorted(self.tensors.items()):
            digest.update(f"{name} {tensor.shape} ".encode())
            digest.update(tensor.tobytes())
        return digest.hexdigest()

    @property
    def label(self) -> str:
        """Return the name and the first 12 digits of the id, for display."""
        return f"{self.name}-{self.id[:12]}"

    @property
    def level_length(self) -> int:
        """Return the length of a level's Fisher vector, 25 G."""
        return int(2 * self.mixture.means.shape[1] + 1) * len(self.mixture)

    @property
    def signature_bytes(self) -> int:
        """Return the number of bytes of a signature: d of the whitening, or 25 G H."""
        if self.whitening is None:
            return self.level_length * len(self.levels)
        return self.whitening.dimension

    @property
    def without_whitening(self) -> Model:
        """Return the model without its whitening; its signatures are psi of all levels."""
        return replace(self, whitening=None)


def to_mapping(parameters: ModelParameters) -> dict[str, Any]:
    """Convert parameters to JSON values; `SPARSE` groups omit values that equal the default."""
    whole = {name: group for name, group in asdict(parameters).items() if name not in SPARSE}
    for name in SPARSE:
        group = getattr(parameters, name)
        different = differences(group)
        if different:
            whole[name] = different
    return whole


def parse_parameters(values: Any) -> ModelParameters:
    """Parse the result of `to_mapping`.

    Raises
    ------
    UnreadableModel : If a field is missing, unknown or not a number
    """
    if not isinstance(values, dict):
        raise UnreadableModel(
            f"The model's parameters are {values!r}, not an object. Download the model again, or "
            "train it again."
        )
    dense = {name: value for name, value in values.items() if name not in SPARSE}
    default = ModelParameters()
    groups = {
        name: apply_changes(getattr(default, name), values.get(name, {}), f"parameters.{name}")
        for name in SPARSE
    }
    return from_mapping(ModelParameters, dense, "parameters", **groups)


def from_mapping(kind: type[T], values: Any, where: str, **groups: Any) -> T:
    """Convert parsed JSON with exactly the fields of a parameter record to this record.

    Parameters
    ----------
    kind : class of the record
    where : path of the record, for errors
    groups : further fields of the record, which are not in `values`

    Raises
    ------
    UnreadableModel : If `values` has other fields than `kind`, or a value is not a number
    """
    hints = get_type_hints(kind)
    names = {field.name for field in fields(kind)} - set(groups)  # type: ignore[arg-type]
    if not isinstance(values, dict) or set(values) != names:
        actual = sorted(values) if isinstance(values, dict) else values
        raise UnreadableModel(
            f"The model's {where} must have the fields {sorted(names)}, but has {actual}. Another "
            "version of sceneprint wrote the model. Train it again, or use that version."
        )
    parsed = {
        name: from_mapping(hints[name], value, f"{where}.{name}")
        if is_dataclass(hints[name])
        else _convert_number(hints[name], value, f"{where}.{name}")
        for name, value in values.items()
    }
    return kind(**parsed, **groups)


def differences(record: Any, default: Any = None) -> dict[str, Any]:
    """Return the values of a record that differ from another record, by group.

    Parameters
    ----------
    record : frozen record of numbers and of further records
    default : record of the same class; None selects the defaults of the class
    """
    default = type(record)() if default is None else default
    different: dict[str, Any] = {}
    for parameter in fields(record):
        value, usual = getattr(record, parameter.name), getattr(default, parameter.name)
        if is_dataclass(value):
            value, usual = differences(value, usual), {}
        if value != usual:
            different[parameter.name] = value
    return different


def apply_changes(default: T, values: Any, where: str) -> T:
    """Return a copy of a record with some of its values replaced.

    Parameters
    ----------
    default : frozen record
    values : result of `differences`, parsed from JSON
    where : path of the record, for errors

    Raises
    ------
    UnreadableModel : If a field is unknown or not a number
    """
    hints = get_type_hints(type(default))
    unknown = sorted(set(values) - set(hints)) if isinstance(values, dict) else values
    if unknown or not isinstance(values, dict):
        raise UnreadableModel(
            f"The model's {where} has the fields {unknown}, which are unknown to this version of "
            "sceneprint. Use the version that wrote the model, or a later version."
        )
    parsed = {
        name: apply_changes(getattr(default, name), value, f"{where}.{name}")
        if is_dataclass(hints[name])
        else _convert_number(hints[name], value, f"{where}.{name}")
        for name, value in values.items()
    }
    return replace(default, **parsed)  # type: ignore[type-var]


def _convert_number(kind: Any, value: Any, where: str) -> Any:
    """Convert a number or Boolean to its field's type; raise UnreadableModel if it is neither."""
    if isinstance(value, bool) is not (kind is bool) or not isinstance(value, bool | int | float):
        raise UnreadableModel(
            f"The model's {where} is {value!r}, not a number: the file is damaged. Download the "
            "model again, or train it again."
        )
    return kind(value)


#: Exponent of the metre in the unit of each parameter, by class and field.
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
    AcceptanceParameters: {"residual_m": 1, "sparse_deviation_m": 1, "apart_m": 1},
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
    ValidationParameters: {"guided_m": 1},
    MapParameters: {
        "look_ahead": 1,
        "reach": 1,
        "around_reach": 1,
        "same_surfaces": 1,
        "near": 1,
        "cell": 1,
        "start_shift": 1,
        "same_m": 1,
        "place_m": 1,
    },
    SequenceParameters: {
        "opposite_distance": 1,
        "minimum_distance": 1,
        "radius": 1,
        "length_scale": 1,
    },
}


def scale_lengths(parameters: T, factor: float) -> T:
    """Return a copy of a parameter record with all lengths scaled, including those in its groups.

    Parameters
    ----------
    parameters : frozen record, such as ModelParameters
    factor : positive factor for lengths; powers of lengths are scaled by powers of it
    """
    powers = POWERS.get(type(parameters), {})
    changes: dict[str, Any] = {}
    for parameter in fields(parameters):  # type: ignore[arg-type]
        value = getattr(parameters, parameter.name)
        if is_dataclass(value):
            changes[parameter.name] = scale_lengths(value, factor)
        elif parameter.name in powers:
            changes[parameter.name] = value * factor ** powers[parameter.name]
    return replace(parameters, **changes)  # type: ignore[type-var]
