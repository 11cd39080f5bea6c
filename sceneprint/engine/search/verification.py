"""Validation of candidates, and pose of the query from matches and nearby frames.

query Geometry, candidates  --validated-->  Validated  --placed-->  PoseEstimate

Candidates are validated in order until enough are accepted or the deadline passes, Sec. III-E. The
poses that the matches imply are checked against the frames of the map near these poses.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sceneprint.engine.ingest.frame_decoder import pose_matrix
from sceneprint.engine.search.retrieval import Deadline, Searched, SearchedMap
from sceneprint.engine.search.up_vectors import known_ups
from sceneprint.engine.upkeep.repair import resign_frames
from sceneprint.errors import DamagedBlob, InvalidRequest, UnreadableGeometry
from sceneprint.geometry.registration.icp import transform_covariance
from sceneprint.geometry.retrieval.ranking import Ranking
from sceneprint.geometry.validation.acceptance import Mode
from sceneprint.geometry.validation.map_verification import MapParameters, MapViews
from sceneprint.geometry.validation.validation import PairValidation, ValidationParameters
from sceneprint.localization import PoseEstimate, localize
from sceneprint.models import Model
from sceneprint.pipeline import VERDICT_MATCHES, PairMatch, associate
from sceneprint.places import LocalizationParameters, PosePrior, QueryFrame
from sceneprint.store import Store
from sceneprint.store.frame_queries import has_parent_frame
from sceneprint.store.maps import (
    FrameViewpoint,
    PlacedFrame,
    geometry_blobs,
    placed_frames,
    viewpoints_among,
)
from sceneprint.store.parent_joins import find_joins
from sceneprint.store.tables import FrameRow
from sceneprint.types import Floats, Geometry
from sceneprint_client.api import Prior, Query, ValidationOptions
from sceneprint_client.api.frames import VIRTUAL
from sceneprint_client.api.query import FARTHEST_PRIOR, LEAST_DEVIATION, MOST_DEVIATION

#: Default number of candidates to validate for the pose of a query.
CANDIDATES = 10
#: For each limit that a caller can set: the limits for frames without free space or with little
#: overlap that get the same value.
_ALSO_SET = {
    "residual_m": ("apart_m",),
    "residual_rad": ("apart_rad",),
    "evidence": ("blind_evidence", "sparse_evidence"),
    "plane_overlap": ("blind_plane_overlap", "sparse_plane_overlap", "apart_plane_overlap"),
    "ambiguous_share": ("blind_ambiguous_share",),
}
#: Reason why no candidate was validated in a query without validation.
NOT_REQUESTED = "not requested"


@dataclass(frozen=True, eq=False)
class Validated:
    """The candidates of a query with their validations.

    Parameters
    ----------
    chosen : positions in R of the candidates
    matches : results of `associate` for the validated candidates
    unreadable : errors of unreadable artifacts, by frame number
    untried : reason why the other candidates were not validated
    late : whether the deadline passed before enough were validated; None if there is no deadline
    geometries : geometries of the first validated candidates, by frame number
    """

    chosen: Sequence[int]
    matches: list[PairMatch]
    unreadable: dict[int, str]
    untried: str
    late: bool | None
    geometries: dict[int, Geometry] = field(default_factory=dict)


def thresholds(
    options: ValidationOptions | None, p: ValidationParameters
) -> tuple[ValidationParameters, Mode]:
    """Return the validation parameters with the limits that a query sets, and its mode."""
    if options is None:
        return p, "full"
    own = options.model_dump(exclude={"mode", "residual_deg"}, exclude_unset=True)
    if "residual_deg" in options.model_fields_set:
        own["residual_rad"] = math.radians(options.residual_deg)
    own |= {also: own[name] for name in _ALSO_SET if name in own for also in _ALSO_SET[name]}
    return replace(p, acceptance=replace(p.acceptance, **own)), options.mode


def validated(
    store: Store, searched: Searched, chosen: Sequence[int], geometry: Geometry | None,
    query: Query, deadline: Deadline, p: ValidationParameters, up: Floats | None = None,
    validations: Mapping[int, PairValidation] | None = None, *, k: int = VERDICT_MATCHES,
    guided: bool = True, retry: bool = True,
) -> Validated:  # fmt: skip
    """Validate candidates in order until `k` are accepted or time is up; return the results.

    Frames with an unreadable geometry are queued for signing.

    Parameters
    ----------
    chosen : positions in R of the candidates
    geometry : geometry of the query; None if validation is skipped
    up : (3,) up vector in the sensor frame of the query; None if unknown
    validations : validations to reuse, by frame number
    k : number of accepted matches after which validation stops
    guided : whether earlier matches predict transforms of later candidates
    """
    if geometry is None:
        return Validated(chosen, [], {}, NOT_REQUESTED, deadline.reached)
    ranking, model_id = searched.ranking, searched.parts[0].place.row.model_id
    with store.database.read() as connection:
        blobs = geometry_blobs(connection, ranking.indices[list(chosen)].tolist(), model_id)
        ups = {} if up is None else known_ups(connection, ranking.indices.tolist())
        viewpoints = viewpoints_among(connection, list(blobs)) if guided else []
    posed = {viewpoint.number: (parent_key(viewpoint), viewpoint.pose) for viewpoint in viewpoints}
    unreadable: dict[int, str] = {}
    loaded: dict[int, Geometry] = {}

    def open_geometry(number: int) -> Geometry | None:
        if number not in blobs:  # deleted during the query
            return None
        try:  # load one at a time, since 200 geometries take 125 MB
            geometry_of = store.geometries.read(blobs[number])
        except (DamagedBlob, UnreadableGeometry) as error:
            unreadable[number] = str(error)
            return None
        if len(loaded) < CANDIDATES:
            loaded[number] = geometry_of
        return geometry_of

    matches = associate(
        geometry, ranking, chosen, open_geometry, k, query.seed,
        *thresholds(query.validation, p), deadline.allows, up=up, up_of=ups.get, pose_of=posed.get,
        validations=validations, retry=retry,
    )  # fmt: skip
    owner = dict(zip(ranking.indices.tolist(), searched.owners.tolist(), strict=True))
    for i, part in enumerate(searched.parts):
        if bad := sorted(number for number in unreadable if owner[number] == i):
            resign_frames(store, part.place.row, bad, model_id)
    late = deadline.reached
    untried = (
        "the deadline passed before it was validated"
        if late
        else "enough matches were accepted before it"
    )
    return Validated(chosen, matches, unreadable, untried, late, loaded)


#: Number of frames to find near each implied pose; the search radius grows until there are enough.
_NEAR_FRAMES = 48
#: Maximum number of places to search frames around.
_MOST_PLACES = 24


def numbers_of(model: Model, query: Query) -> LocalizationParameters:
    """Return the localisation parameters of a model, with the options of a query."""
    p = LocalizationParameters.of(model.answer)
    p = replace(p, confidence=query.confidence, voted_only=query.validation is not None)
    return replace(p, rivals=0) if _is_paper(query) else p


def _is_paper(query: Query) -> bool:
    return query.validation is not None and query.validation.mode == "paper"


def placed(
    store: Store, searched: Searched, geometries: Mapping[int, Geometry],
    rows: Mapping[int, FrameRow],
    query_frames: Sequence[QueryFrame], prior: PosePrior | None, model: Model, query: Query,
) -> PoseEstimate | None:  # fmt: skip
    """Estimate the pose of a query from its matches, and from frames near the poses they imply.

    Parameters
    ----------
    geometries : loaded geometries of candidates, by frame number
    rows : rows of the candidates, by frame number
    prior : prior pose of the robot; its parent is a key of `parent_key`
    query : options of the query; with validation options, a pose requires the vote of a match, and
        the mode `paper` ignores the other frames of the map

    Returns
    -------
    estimate : pose; None if no match has a pose and there is no prior
    """
    poses = {number: np.array(row.pose) for number, row in rows.items() if row.pose is not None}
    parents = {number: parent_key(rows[number]) for number in poses}
    frames = [
        replace(frame, matches=[m for m in frame.matches if m.index in poses])
        for frame in query_frames
    ]
    own_p, agreement = numbers_of(model, query), model.parameters.validation.agreement

    def views_of(parent: str, at: Floats) -> MapViews:
        loaded = {number for number in geometries if parents.get(number) == parent}
        near = _near_frames(store, searched, parent, at, own_p.map)
        numbers = sorted({*loaded, *near})
        at_poses = [poses[n] if n in loaded else near[n].pose for n in numbers]
        ahead = [rows[n].cloud is None if n in loaded else not near[n].is_cloud for n in numbers]
        rendered = [VIRTUAL in (rows[n] if n in loaded else near[n]).tags for n in numbers]

        def open_view(i: int) -> Geometry | None:
            number = numbers[i]
            if number in loaded:
                return geometries[number]
            try:
                return store.geometries.read(near[number].geometry)
            except (DamagedBlob, UnreadableGeometry):
                return None

        stack = np.array(at_poses).reshape(-1, 4, 4)
        first = [i for i, number in enumerate(numbers) if number in loaded]
        return MapViews(stack, open_view, own_p.map, agreement, first, ahead, rendered)

    asks_map = None if _is_paper(query) else views_of
    return localize(frames, poses, parents, asks_map, prior, own_p, agreement)


def prior_of(store: Store, query: Query, places: Sequence[SearchedMap]) -> PosePrior | None:
    """Return the prior of a query; raise InvalidRequest or InvalidPose if it is not valid."""
    prior = query.prior
    if prior is None:
        return None
    if "validate" not in query.stages:
        raise InvalidRequest(
            "A prior requires validated matches. Omit `stages`, or include `validate`.",
            (("prior", "without validate"),),
        )
    if len(places) > 1:
        raise InvalidRequest(
            "A prior is a pose in one map. Query only that map, or omit `prior`.",
            (("prior", "with several maps"),),
        )
    covariance = _prior_covariance(prior)
    T = pose_matrix(prior.pose, "The prior")
    if np.abs(T[:3, 3]).max() > FARTHEST_PRIOR:
        raise InvalidRequest(
            f"The prior lies more than {FARTHEST_PRIOR:,.0f} m from the origin of its parent "
            "frame. Send the pose in metres, or omit `prior`.",
            (("prior.pose", "too far from the origin"),),
        )
    row, name = places[0].row, str(prior.pose.parent_frame)
    with store.database.read() as connection:
        joined = find_joins(connection, row.number).get(name)
        if joined is not None:  # convert it to the root frame, like stored poses
            name, T = joined.root, joined.T @ T
            covariance = transform_covariance(covariance, joined.T[:3, :3], np.zeros(3))
        if not has_parent_frame(connection, row.number, name):
            raise InvalidRequest(
                f"No frame of map {row.name!r} has a pose in the parent frame {name!r} of the "
                "prior. Use a parent frame of the map; `sceneprint frames` lists frames with their "
                "poses.",
                (("prior.pose.parent_frame", "not of this map"),),
            )
    return PosePrior(f"{row.number} {name}", T, covariance)


#: Minimum eigenvalue of a correlation matrix; smaller eigenvalues are rounding errors.
_LEAST_EIGENVALUE = 1e-12


def _prior_covariance(prior: Prior) -> Floats:
    """Return the covariance (6, 6) of a prior: translation in metres, then rotation in radians.

    It is diagonal if the prior has only deviations. Raise InvalidRequest if it is not symmetric and
    positive definite, or a deviation is out of range.
    """
    if prior.covariance is None:
        metres, radians = prior.deviation_m, math.radians(prior.deviation_deg)
        return np.diag(np.square([metres] * 3 + [radians] * 3))
    covariance = np.array(prior.covariance).reshape(6, 6)
    variances = np.diag(covariance)
    if (variances > 0).all():
        deviations = np.sqrt(variances)
        # tolerate rounding of squares
        within = LEAST_DEVIATION * (1 - 1e-9), MOST_DEVIATION * (1 + 1e-9)
        if deviations.min() < within[0] or deviations.max() > within[1]:
            raise InvalidRequest(
                f"The deviations of the prior are between {deviations.min():.3g} and "
                f"{deviations.max():.3g}, but must be between {LEAST_DEVIATION} and "
                f"{MOST_DEVIATION:.0f} (metres and radians). Check the diagonal of the "
                "covariance, which contains their squares, or omit `prior`.",
                (("prior.covariance", "deviations out of range"),),
            )
        # reject entries above the largest variance, which also prevents overflows below
        if np.abs(covariance).max() <= variances.max():
            correlation = covariance / np.outer(deviations, deviations)
            if (
                np.allclose(correlation, correlation.T)
                and np.linalg.eigvalsh(correlation)[0] > _LEAST_EIGENVALUE
            ):
                return covariance
    raise InvalidRequest(
        "The covariance of the prior is not valid: it must be symmetric with positive "
        "eigenvalues. Send its 36 numbers row by row, or `deviation_m` and `deviation_deg`.",
        (("prior.covariance", "not positive definite"),),
    )


def nearest_first(
    store: Store, ranking: Ranking, chosen: Sequence[int], prior: PosePrior, p: MapParameters
) -> list[int]:
    """Return the candidates (positions in R), sorted so that those near a prior come first."""
    with store.database.read() as connection:
        viewpoints = viewpoints_among(connection, ranking.indices[list(chosen)].tolist())
    posed = {viewpoint.number: viewpoint for viewpoint in viewpoints}

    def far(position: int) -> bool:
        viewpoint = posed.get(int(ranking.indices[position]))
        if viewpoint is None or parent_key(viewpoint) != prior.parent:
            return True
        return not prior.reaches(viewpoint.pose, p)

    return sorted(chosen, key=far)


def parent_key(row: FrameRow | FrameViewpoint) -> str:
    """Return a unique key of a parent frame: its map number, a space, and its name."""
    return f"{row.map_number} {row.pose_parent}"


def _near_frames(
    store: Store, searched: Searched, parent: str, at: Floats, p: MapParameters
) -> dict[int, PlacedFrame]:
    """Return searchable frames in a parent frame near the poses `at` (n, 4, 4), by frame number."""
    number, _, name = parent.partition(" ")
    part = next(part for part in searched.parts if part.place.row.number == int(number))
    cells = np.unique(np.round(at[:, :3, 3] / p.cell), axis=0, return_index=True)[1]
    frames: dict[int, PlacedFrame] = {}
    with store.database.read() as connection:
        for centre in at[np.sort(cells)[:_MOST_PLACES], :3, 3].tolist():
            for within in (p.near, p.same_surfaces):
                near = placed_frames(
                    connection, int(number), name, part.place.row.model_id, centre, within,
                    _NEAR_FRAMES,
                )  # fmt: skip
                if len(near) == _NEAR_FRAMES:
                    break
            frames |= {frame.number: frame for frame in near}
    passing = set(frames)
    if part.among is not None:
        passing = set(np.intersect1d(list(frames), part.among).tolist())
    return {n: frame for n, frame in frames.items() if n in passing and n not in part.dead}
