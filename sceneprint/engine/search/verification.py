"""Validate candidates of R, and find the pose of the query by its matches and the map's frames.

query Geometry, candidates  --validated-->  Validated  --placed-->  PoseEstimate

Candidates are validated, C_vld first, until enough are accepted or time is up: Sec. III-E. The
poses that they suggest are compared on the frames of the map that were taken near them.
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

#: Candidates that are validated for the pose of a query, unless it gives a number: more cost time.
CANDIDATES = 10
#: Limits that take the place of another one where nothing is known of free space, or where the
#: frames share little: a limit that the caller sets holds in each of its places.
_ALSO_SET = {
    "residual_m": ("apart_m",),
    "residual_rad": ("apart_rad",),
    "evidence": ("blind_evidence", "sparse_evidence"),
    "plane_overlap": ("blind_plane_overlap", "sparse_plane_overlap", "apart_plane_overlap"),
    "ambiguous_share": ("blind_ambiguous_share",),
}
#: Why no candidate was tried where validation was not asked for.
NOT_ASKED = "not requested"


@dataclass(frozen=True, eq=False)
class Validated:
    """The candidates of a query with their validations.

    Parameters
    ----------
    chosen : positions in R of the candidates
    matches : those that were tried, of `associate`
    unreadable : numbers of frames whose artifact cannot be read, and why
    untried : why the others were not tried
    late : whether the deadline came before the last of them; None without a deadline
    geometries : of the first candidates that were tried, by frame number
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
    """Return the parameters and the mode of a validation: the model's `p` with the query's own."""
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
    known: Mapping[int, PairValidation] | None = None, *, k: int = VERDICT_MATCHES,
    guided: bool = True, retry: bool = True,
) -> Validated:  # fmt: skip
    """Validate candidates in their order until `k` are accepted.

    Parameters
    ----------
    chosen : positions in R of the candidates
    geometry : of the query; None where validation was not asked for
    up : (3,) in the query's sensor, where it is known
    known : validations of an earlier pass, by number
    k : accepted matches after which to stop
    guided : whether the transforms of later candidates may follow from earlier matches
    retry : see `associate`
    """
    if geometry is None:
        return Validated(chosen, [], {}, NOT_ASKED, deadline.reached)
    ranking, model_id = searched.ranking, searched.parts[0].place.row.model_id
    with store.database.read() as connection:
        blobs = geometry_blobs(connection, ranking.indices[list(chosen)].tolist(), model_id)
        ups = {} if up is None else known_ups(connection, ranking.indices.tolist())
        viewpoints = viewpoints_among(connection, list(blobs)) if guided else []
    posed = {one.number: (parent_key(one), one.pose) for one in viewpoints}
    unreadable: dict[int, str] = {}
    opened: dict[int, Geometry] = {}

    def open_geometry(number: int) -> Geometry | None:
        if number not in blobs:  # deleted in the meantime
            return None
        try:  # when its turn comes: 200 at once would be 125 MB
            geometry_of = store.geometries.read(blobs[number])
        except (DamagedBlob, UnreadableGeometry) as error:  # one frame must not cost the answer
            unreadable[number] = str(error)
            return None
        if len(opened) < CANDIDATES:
            opened[number] = geometry_of
        return geometry_of

    matches = associate(
        geometry, ranking, chosen, open_geometry, k, query.seed,
        *thresholds(query.validation, p), deadline.allows, up=up, up_of=ups.get, pose_of=posed.get,
        known=known, retry=retry,
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
    return Validated(chosen, matches, unreadable, untried, late, opened)


#: Frames that are looked for about each pose that a candidate suggests: first close by, as a map
#: may hold thousands, and farther off where that gives too few.
_NEAR_FRAMES = 48
#: Places that are looked about, at most.
_MOST_PLACES = 24


def numbers_of(model: Model, query: Query) -> LocalizationParameters:
    """Return the numbers of an answer: those of the model, and what a query asks of an answer."""
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
    """Return where the query was taken, by its matches and the frames of the map about the poses.

    Parameters
    ----------
    geometries : of candidates, by number, as far as they are open
    rows : of the candidates, by number; those without a pose suggest none
    query_frames : frames of the query with their matches
    prior : what the robot believed before; its parent as `parent_key` writes it
    query : where it asks for anything of a match, a pose needs the vote of one; in mode `paper` the
        map's frames are not asked

    Returns
    -------
    estimate : None where no match has a pose, and there is no prior
    """
    poses = {number: np.array(row.pose) for number, row in rows.items() if row.pose is not None}
    parents = {number: parent_key(rows[number]) for number in poses}
    frames = [
        replace(one, matches=[m for m in one.matches if m.index in poses]) for one in query_frames
    ]
    own_p, agreement = numbers_of(model, query), model.parameters.validation.agreement

    def views_of(parent: str, at: Floats) -> MapViews:
        known = {number for number in geometries if parents.get(number) == parent}
        near = _near_frames(store, searched, parent, at, own_p.map)
        numbers = sorted({*known, *near})
        at_poses = [poses[n] if n in known else near[n].pose for n in numbers]
        ahead = [rows[n].cloud is None if n in known else not near[n].is_cloud for n in numbers]
        rendered = [VIRTUAL in (rows[n] if n in known else near[n]).tags for n in numbers]

        def open_view(i: int) -> Geometry | None:
            number = numbers[i]
            if number in known:
                return geometries[number]
            try:
                return store.geometries.read(near[number].geometry)
            except (DamagedBlob, UnreadableGeometry):
                return None  # one frame of many: the others tell the poses apart

        stack = np.array(at_poses).reshape(-1, 4, 4)
        first = [i for i, number in enumerate(numbers) if number in known]
        return MapViews(stack, open_view, own_p.map, agreement, first, ahead, rendered)

    asks_map = None if _is_paper(query) else views_of
    return localize(frames, poses, parents, asks_map, prior, own_p, agreement)


def prior_of(store: Store, query: Query, places: Sequence[SearchedMap]) -> PosePrior | None:
    """Return the prior of a query; InvalidRequest or InvalidPose where it cannot be used."""
    prior = query.prior
    if prior is None:
        return None
    if "validate" not in query.stages:
        raise InvalidRequest(
            "A prior needs validated matches. Leave `stages` out, or include `validate`.",
            (("prior", "without validate"),),
        )
    if len(places) > 1:
        raise InvalidRequest(
            "A prior is a pose in one map. Ask that map alone, or leave `prior` out.",
            (("prior", "of several maps"),),
        )
    covariance = _prior_covariance(prior)
    T = pose_matrix(prior.pose, "The prior")
    if np.abs(T[:3, 3]).max() > FARTHEST_PRIOR:
        raise InvalidRequest(
            f"The prior lies more than {FARTHEST_PRIOR:,.0f} m from the origin of its parent "
            "frame. Give the pose in metres, or leave `prior` out.",
            (("prior.pose", "too far off"),),
        )
    row, name = places[0].row, str(prior.pose.parent_frame)
    with store.database.read() as connection:
        joined = find_joins(connection, row.number).get(name)
        if joined is not None:  # the map's poses are in its root
            name, T = joined.root, joined.T @ T
            covariance = transform_covariance(covariance, joined.T[:3, :3], np.zeros(3))
        if not has_parent_frame(connection, row.number, name):
            raise InvalidRequest(
                f"No frame of map {row.name!r} has a pose in the parent frame {name!r} of the "
                "prior. Give the pose in one that the map has; `sceneprint frames` shows them.",
                (("prior.pose.parent_frame", "not of this map"),),
            )
    return PosePrior(f"{row.number} {name}", T, covariance)


#: Least eigenvalue of a covariance once its deviations are 1: what is less is rounding.
_LEAST_EIGENVALUE = 1e-12


def _prior_covariance(prior: Prior) -> Floats:
    """Return the covariance (6, 6) of a prior; InvalidRequest where it is not valid."""
    if prior.covariance is None:
        metres, radians = prior.deviation_m, math.radians(prior.deviation_deg)
        return np.diag(np.square([metres] * 3 + [radians] * 3))
    covariance = np.array(prior.covariance).reshape(6, 6)
    variances = np.diag(covariance)
    if (variances > 0).all():
        deviations = np.sqrt(variances)
        # a little more, as a square that is rounded has another root
        within = LEAST_DEVIATION * (1 - 1e-9), MOST_DEVIATION * (1 + 1e-9)
        if deviations.min() < within[0] or deviations.max() > within[1]:
            raise InvalidRequest(
                f"The deviations of the prior reach from {deviations.min():.3g} to "
                f"{deviations.max():.3g}, and can be from {LEAST_DEVIATION} to "
                f"{MOST_DEVIATION:.0f}, metres and radians. The diagonal of its covariance has "
                "their squares: give others, or leave `prior` out.",
                (("prior.covariance", "deviations out of range"),),
            )
        # no entry of a covariance is above the largest variance, and no product overflows then
        if np.abs(covariance).max() <= variances.max():
            correlation = covariance / np.outer(deviations, deviations)
            if (
                np.allclose(correlation, correlation.T)
                and np.linalg.eigvalsh(correlation)[0] > _LEAST_EIGENVALUE
            ):
                return covariance
    raise InvalidRequest(
        "The covariance of the prior is not one: it must be symmetric with eigenvalues "
        "above 0. Send the 36 numbers row by row, or `deviation_m` and `deviation_deg`.",
        (("prior.covariance", "not positive definite"),),
    )


def nearest_first(
    store: Store, ranking: Ranking, chosen: Sequence[int], prior: PosePrior, p: MapParameters
) -> list[int]:
    """Return candidates, as positions in R, those that were taken near a prior first."""
    with store.database.read() as connection:
        viewpoints = viewpoints_among(connection, ranking.indices[list(chosen)].tolist())
    posed = {one.number: one for one in viewpoints}

    def far(position: int) -> bool:
        one = posed.get(int(ranking.indices[position]))
        return one is None or parent_key(one) != prior.parent or not prior.reaches(one.pose, p)

    return sorted(chosen, key=far)


def parent_key(row: FrameRow | FrameViewpoint) -> str:
    """Return a name of a parent frame that no other map has: the map's number and its own name."""
    return f"{row.map_number} {row.pose_parent}"


def _near_frames(
    store: Store, searched: Searched, parent: str, at: Floats, p: MapParameters
) -> dict[int, PlacedFrame]:
    """Return frames of a parent frame about poses (n, 4, 4) that the query may find, by number."""
    number, _, name = parent.partition(" ")
    part = next(one for one in searched.parts if one.place.row.number == int(number))
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
            frames |= {one.number: one for one in near}
    passing = set(frames)
    if part.among is not None:
        passing = set(np.intersect1d(list(frames), part.among).tolist())
    return {n: one for n, one in frames.items() if n in passing and n not in part.dead}
