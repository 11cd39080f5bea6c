"""What came of a query: its status, why, and where nothing was found, the likeliest cause.

PoseEstimate, matches, counts  --answer_status-->  Outcome
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sceneprint.engine.search.verification import Validated
from sceneprint.geometry.registration.overlap import PlaneParameters, plane_weights
from sceneprint.geometry.validation.validation import ValidationParameters
from sceneprint.localization import PoseEstimate
from sceneprint.pipeline import PairMatch
from sceneprint.types import Geometry
from sceneprint_client.api import AnswerStatus, Counts, Query
from sceneprint_client.api.query import Cause

#: Distinct planes that a frame must show at least to be told from others.
_FEWEST_PLANES = 4.0
#: Surfaces that lie so many times as far away as those of all candidates speak of a wrong scale.
_OTHER_SCALE = 2.5


@dataclass(frozen=True)
class Outcome:
    """The status of an answer, why, and the likeliest cause of `not_found`."""

    status: AnswerStatus
    reason: str
    cause: Cause | None = None


def answer_status(
    query: Query, estimate: PoseEstimate | None, tried: Validated, matches: Sequence[PairMatch],
    counts: Counts, geometry: Geometry | None, p: ValidationParameters, *, posed: bool,
) -> Outcome:  # fmt: skip
    """What came of a query.

    Parameters
    ----------
    query : see there
    estimate : of `placed`; None where no match has a pose
    tried : of `validated`
    matches : those that were tried and are still there
    counts : of all maps
    geometry : of the query; None where it was not validated
    p : of the model
    posed : whether an accepted match has a pose in the map
    """
    if "validate" not in query.stages:
        return Outcome("unvalidated", "validation was not asked for")
    accepted = [one for one in matches if one.validation.status == "accepted"]
    if accepted and not posed:
        return Outcome(
            "found",
            f"{len(accepted)} matches are accepted, but none has a pose in the map; `best` has the "
            "transform to the first",
        )
    unsure = next((one for one in matches if one.validation.status == "ambiguous"), None)
    decided = estimate is not None and estimate.status == "found"
    if estimate is not None and (decided or accepted or (estimate.alternatives and not unsure)):
        return Outcome(estimate.status, estimate.reason)
    if unsure is not None:
        return Outcome("ambiguous", f"the best fit is not unique: {unsure.validation.reason}")
    if tried.late:
        told = (
            f"the deadline passed before a match was accepted: {counts.validated} of "
            f"{len(tried.chosen)} candidates were validated. Allow more time"
        )
        return Outcome("unvalidated", told, "deadline")
    cause, reason = _likeliest_cause(tried, matches, counts, geometry, p)
    return Outcome("not_found", reason, cause)


def _likeliest_cause(
    tried: Validated, matches: Sequence[PairMatch], counts: Counts, geometry: Geometry | None,
    p: ValidationParameters,
) -> tuple[Cause, str]:  # fmt: skip
    """Why nothing was found, and what to do next."""
    if not counts.passed:
        if counts.map:
            return "no_frames", "no frame of the map passes the filter. Widen the filter"
        return "no_frames", "the map has no frame to compare. Upload frames of the place"
    tilted = next((one for one in matches if one.validation.contradicts_up), None)
    if tilted is not None:
        return "gravity", tilted.validation.reason
    if geometry is not None:
        own = _cause_in_view(geometry, tried, p)
        if own is not None:
            return own
    first = matches[0].validation.reason if matches else ""
    nearest = f" (the nearest: {first})" if first else ""
    return (
        "nothing_alike",
        f"none of {counts.validated} candidates is accepted{nearest}. Move on and ask again, or "
        "add frames of this place to the map",
    )


def _cause_in_view(
    geometry: Geometry, tried: Validated, p: ValidationParameters
) -> tuple[Cause, str] | None:
    """What in the frame itself speaks against finding it."""
    if len(geometry.patches) < p.minimum_patches:
        return (
            "too_little_in_view",
            f"the frame has {len(geometry.patches)} surface patches, and {p.minimum_patches} are "
            "needed. Turn towards more of the place and ask again",
        )
    planes = float(plane_weights(geometry.patches, PlaneParameters()).sum(dtype=float))
    if planes < _FEWEST_PLANES:
        return (
            "one_plane",
            f"the frame shows {planes:.0f} planes, too few to tell places apart. Turn towards "
            "furniture or a corner and ask again",
        )
    others = list(tried.geometries.values())
    if not others:
        return None
    if all(type(one.surface.camera) is not type(geometry.surface.camera) for one in others):
        return (
            "other_sensor",
            "the frame is of another kind of sensor than the map's. Ask a map of the same kind of "
            "sensor",
        )
    ratio = _distance(geometry) / float(np.median([_distance(one) for one in others]))
    if not 1 / _OTHER_SCALE < ratio < _OTHER_SCALE:
        return (
            "scale",
            f"surfaces of the frame lie {ratio:.2g} times as far away as those of the map. Check "
            "`depth_scale`, or `units_per_metre` of a cloud",
        )
    return None


def _distance(geometry: Geometry) -> float:
    """Median distance of the patches from the sensor, metres."""
    return float(np.median(np.linalg.norm(geometry.patches.means, axis=1)))
