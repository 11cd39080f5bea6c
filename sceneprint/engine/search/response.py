"""Matches as JSON tells them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sceneprint.engine.serializers import sensor_of, transform
from sceneprint.geometry.registration.icp import (
    PAIR_METHOD,
    PLACE_METHOD,
    CovarianceParameters,
    Method,
    free_directions,
)
from sceneprint.geometry.retrieval.distance import Ranking
from sceneprint.geometry.retrieval.dpp import Selection
from sceneprint.geometry.rigid import inverse
from sceneprint.geometry.validation.validation import PairValidation
from sceneprint.localization import PoseEstimate
from sceneprint.pipeline import PairMatch
from sceneprint.store.tables import FrameRow
from sceneprint.types import Floats
from sceneprint_client.api import Alternative as ToldAlternative
from sceneprint_client.api import Location as ToldLocation
from sceneprint_client.api import Match as ToldMatch
from sceneprint_client.api import Residual, Transform
from sceneprint_client.api import Validation as ToldValidation
from sceneprint_client.api.base import Vector
from sceneprint_client.api.matches import FreeDirection, Uncertainty


@dataclass(frozen=True, eq=False)
class Candidates:
    """What there is to tell about candidates.

    Parameters
    ----------
    maps : names of all that were asked, by number
    ranking : R, of frame numbers
    selection : C, or None where diversification was not asked for
    rows : frames of the candidates by number; those deleted in the meantime are not among them
    unreadable : numbers of frames whose artifact cannot be read, and why
    untried : why the other candidates were not tried
    query_frame : what the coordinates of the query's sensor are called
    covariance : of the model, by which a direction is told to be free
    base : what the robot's base is called, and T_base_query (4, 4); None where it is not known
    """

    maps: dict[int, str]
    ranking: Ranking
    selection: Selection | None
    rows: dict[int, FrameRow]
    unreadable: dict[int, str]
    untried: str
    query_frame: str
    covariance: CovarianceParameters
    base: tuple[str, Floats] | None = None

    def base_of(self, T_parent_query: Floats | None, parent: str) -> Transform | None:
        """Where the robot's base is, by where its camera is."""
        if self.base is None or T_parent_query is None:
            return None
        name, T_base_query = self.base
        return transform(T_parent_query @ inverse(T_base_query), parent, name)


def match_records(
    found: Candidates, chosen: Sequence[int], matches: Sequence[PairMatch]
) -> list[ToldMatch]:
    """What was validated, in the order of belief, then the other candidates in the order of R.

    Parameters
    ----------
    found : see Found
    chosen : positions in R of the candidates
    matches : of `associate`
    """
    position = {int(found.ranking.indices[i]): i for i in chosen}
    tried = {match.index: match.validation for match in matches}
    order = [*tried, *(number for number in position if number not in tried)]
    told = []
    for number in order:
        if number not in found.rows:
            continue
        if number in tried:
            validation = validation_record(tried[number])
        elif number in found.unreadable:
            validation = ToldValidation(status="skipped", reason=found.unreadable[number])
        else:
            validation = ToldValidation(status="skipped", reason=found.untried)
        told.append(_match(found, position[number], number, tried.get(number), validation))
    return told


def location_record(found: Candidates, estimate: PoseEstimate | None) -> ToldLocation | None:
    """The query's pose, where it was found."""
    if estimate is None or estimate.average is None:
        return None
    average, (number, _, parent) = estimate.average, estimate.parent.partition(" ")
    return ToldLocation(
        pose=transform(average.T, parent, found.query_frame),
        map=found.maps[int(number)],
        support=len(estimate.members),
        guided=estimate.guided,
        votes=estimate.votes,
        strength=estimate.strength or "weak",
        verified_by=estimate.verified_by or "matches",
        rival_ratio=estimate.rival_ratio,
        spread_m=average.spread_m,
        spread_deg=math.degrees(average.spread_rad),
        uncertainty=uncertainty_record(estimate.covariance, PLACE_METHOD, found.covariance),
        base=found.base_of(average.T, parent),
    )


def alternative_records(found: Candidates, estimate: PoseEstimate | None) -> list[ToldAlternative]:
    """The poses that the evidence supports, where it does not decide."""
    if estimate is None:
        return []
    number, _, parent = estimate.parent.partition(" ")
    return [
        ToldAlternative(
            pose=transform(one.T, parent, found.query_frame),
            map=found.maps[int(number)],
            weight=one.weight,
            support=one.support,
            score=one.score,
        )
        for one in estimate.alternatives
    ]


def _match(
    found: Candidates,
    position: int,
    number: int,
    tried: PairValidation | None,
    validation: ToldValidation,
) -> ToldMatch:
    row, gain = found.rows[number], None
    selected = None
    if found.selection is not None:
        places = found.selection.indices.tolist()
        selected = position in places
        gain = float(found.selection.gains[places.index(position)]) if selected else None
    T = None if tried is None else tried.T_match_query
    in_map: Floats | None = None
    if T is not None and row.pose is not None and validation.status != "rejected":
        in_map = np.array(row.pose) @ T
    return ToldMatch(
        frame_id=row.id,
        map=found.maps[row.map_number],
        robot=row.robot,
        session=row.session,
        name=row.name,
        sequence=row.sequence,
        rank=position + 1,
        distance=int(found.ranking.distances[position]),
        similarity=float(found.ranking.similarities[position]),
        selected=selected,
        diversity_gain=gain,
        validation=validation,
        transform=None if T is None else transform(T, sensor_of(row), found.query_frame),
        predicted=(
            None
            if tried is None or tried.predicted is None
            else transform(tried.predicted, sensor_of(row), found.query_frame)
        ),
        pose_in_map=(
            None if in_map is None else transform(in_map, str(row.pose_parent), found.query_frame)
        ),
        uncertainty=(
            None
            if tried is None
            else uncertainty_record(tried.covariance, PAIR_METHOD, found.covariance)
        ),
        base_in_map=found.base_of(in_map, str(row.pose_parent)),
    )


def uncertainty_record(
    covariance: Floats | None, method: Method, p: CovarianceParameters
) -> Uncertainty | None:
    """A covariance (6, 6) with the directions that it leaves free by the model's numbers."""
    if covariance is None:
        return None
    free = [
        FreeDirection(
            translation=_vector(one.translation),
            rotation=_vector(one.rotation),
            deviation=one.deviation,
        )
        for one in free_directions(covariance, p)
    ]
    return Uncertainty(covariance=covariance.ravel().tolist(), method=method, degenerate=free)


def _vector(v: Floats) -> Vector:
    x, y, z = v.tolist()
    return Vector(x=x, y=y, z=z)


def validation_record(v: PairValidation) -> ToldValidation:
    """What came of an alignment."""
    residual = None
    if math.isfinite(v.residual_m):
        residual = Residual(translation_m=v.residual_m, rotation_deg=math.degrees(v.residual_rad))
    return ToldValidation(
        status=v.status,
        strength=v.strength,
        reason=v.reason,
        residual=residual,
        overlap=v.overlap,
        plane_overlap=v.plane_overlap,
        free_space_violations=v.violations,
        planes=v.planes,
        plane_violations=None if v.violations is None else v.plane_violations,
        inliers=v.inliers,
        ambiguity=v.ambiguity,
        search=v.search if v.directions else None,
        directions=list(v.directions),
        tilt_deg=None if v.tilt_rad is None else math.degrees(v.tilt_rad),
    )
