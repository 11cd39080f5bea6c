"""Answers to queries: ranking R, selections C and C_vld, pose, and status.

PreparedQuery, SearchedMaps  --answer-->  Answer
PoseEstimate, matches, counts  --answer_status-->  Outcome
"""

from __future__ import annotations

import time
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sceneprint.engine.search.response import (
    Candidates,
    ExplainedQuery,
    alternative_records,
    explain,
    listed,
    location_record,
    match_records,
    why,
)
from sceneprint.engine.search.retrieval import (
    Deadline,
    PreparedQuery,
    Searched,
    SearchedMap,
    search_maps,
)
from sceneprint.engine.search.verification import (
    CANDIDATES,
    Validated,
    nearest_first,
    numbers_of,
    parent_key,
    placed,
    prior_of,
    validated,
)
from sceneprint.engine.serializers import query_sensor
from sceneprint.engine.upkeep.repair import resign_frames
from sceneprint.geometry.registration.overlap import PlaneParameters, plane_weights
from sceneprint.geometry.retrieval.ranking import (
    DiversityParameters,
    Ints64,
    Selection,
    diversify,
    pairwise_distances,
)
from sceneprint.geometry.validation.validation import PairValidation, ValidationParameters
from sceneprint.localization import PosedFrame, PoseEstimate, decide, mark_unconfirmed
from sceneprint.models import Model
from sceneprint.pipeline import VERDICT_MATCHES, PairMatch
from sceneprint.places import PosePrior, QueryFrame
from sceneprint.store import Store
from sceneprint.store.maps import frames_of, viewpoints_among
from sceneprint.store.tables import FrameRow
from sceneprint.types import Floats, Geometry
from sceneprint_client.api import Answer, AnswerStatus, Counts, Match, OfMap, Query
from sceneprint_client.api.query import Cause


@dataclass
class _Clock:
    """Total durations of the stages of a query, milliseconds."""

    spent: dict[str, float]
    _since: float = field(default_factory=time.perf_counter)

    def stage(self, name: str) -> None:
        now = time.perf_counter()
        self.spent[name] = round(self.spent.get(name, 0.0) + 1e3 * (now - self._since), 2)
        self._since = now


@dataclass(frozen=True, eq=False)
class SequenceFrame:
    """An earlier frame of a sequence, with T_query_sensor (4, 4) from odometry."""

    prepared: PreparedQuery
    T: Floats


@dataclass(frozen=True, eq=False)
class _Attempt:
    """The search for one frame of a query: its candidates and their validations.

    Parameters
    ----------
    searched : ranking R of the frame
    selection : C; None if it was not requested
    among, scales : (R, R) distances within R, and the parameters of the selection
    chosen : positions in R of the candidates: C, or the first frames of R
    checks : validations of the candidates that decide the pose, regardless of `k`
    rows : rows of the frames in the answer, by frame number
    matches : validated candidates that still exist
    rivals : matches that are not candidates, at other places than the best pose
    late : whether the deadline passed before all rivals were validated
    """

    prepared: PreparedQuery
    searched: Searched
    selection: Selection | None
    among: Ints64 | None
    scales: DiversityParameters | None
    chosen: Sequence[int]
    checks: Validated
    rows: dict[int, FrameRow]
    matches: list[PairMatch]
    rivals: list[PairMatch] = field(default_factory=list)
    late: bool = False


def answer(
    store: Store, places: Sequence[SearchedMap], model: Model, prepared: PreparedQuery,
    query: Query, deadline: Deadline, earlier: Sequence[SequenceFrame] = (),
) -> tuple[Answer, tuple[int, ...]]:  # fmt: skip
    """Answer a query; return the answer and the frame numbers of R.

    Parameters
    ----------
    places : one or more maps of one model
    prepared, query : frame and options of the query
    earlier : earlier frames of the sequence, which vote for the pose of `prepared`

    Raises
    ------
    UnknownFrame : If the frame to explain does not exist.
    InvalidRequest, InvalidPose : If the prior is not valid; see `prior_of`.
    """
    clock = _Clock({"prepare": round(prepared.prepare_ms, 2)})
    prior = prior_of(store, query, places)
    # search the last frame first, so that a deadline only excludes votes of earlier frames
    last = _attempt(store, places, model, prepared, query, deadline, prior, clock)
    before = [
        _attempt(store, places, model, frame.prepared, query, deadline, prior) for frame in earlier
    ]
    if before:
        clock.stage("earlier")
    estimate = None
    if prepared.geometry is not None:
        database = _StoredDatabase(store, [*before, last], prior, model, query, deadline)
        poses = [*(frame.T for frame in earlier), np.eye(4)]
        frames = [
            QueryFrame(attempt.prepared.geometry, attempt.matches, T)
            for attempt, T in zip(database.attempts, poses, strict=True)
            if attempt.prepared.geometry is not None
        ]
        estimate = decide(frames, last.searched.ranking, database, numbers_of(model, query))
        last = database.attempts[-1]
        if last.late and estimate is not None:
            estimate = mark_unconfirmed(estimate)
        clock.stage("locate")
    return _answer(store, places, model, last, estimate, query, deadline, clock, len(before))


class _StoredDatabase:
    """Access of `decide` to the store; new validations are added to `attempts`."""

    def __init__(
        self, store: Store, attempts: Sequence[_Attempt], prior: PosePrior | None, model: Model,
        query: Query, deadline: Deadline,
    ) -> None:  # fmt: skip
        self.attempts = list(attempts)
        self._store, self._prior, self._model = store, prior, model
        self._query, self._deadline = query, deadline

    def locate(self, frames: Sequence[QueryFrame]) -> PoseEstimate | None:
        rows = {number: row for attempt in self.attempts for number, row in attempt.rows.items()}
        checks = [attempt.checks for attempt in self.attempts]
        geometries = {n: g for check in checks for n, g in check.geometries.items()}
        return placed(
            self._store, self.attempts[-1].searched, geometries, rows, frames, self._prior,
            self._model, self._query,
        )  # fmt: skip

    def search(
        self, frame: int, validations: Mapping[int, PairValidation]
    ) -> Sequence[PairMatch] | None:
        before = self.attempts[frame]
        checks = self._validated(before, before.checks.chosen, validations)
        if checks.late:
            return None
        self.attempts[frame] = replace(
            before,
            checks=replace(checks, geometries=before.checks.geometries | checks.geometries),
            matches=[match for match in checks.matches if match.index in before.rows],
        )
        return self.attempts[frame].matches

    def posed(self, rows: Sequence[int]) -> Mapping[int, PosedFrame]:
        with self._store.database.read() as connection:
            viewpoints = viewpoints_among(connection, rows)
        return {
            row.number: PosedFrame(parent_key(row), row.pose, not row.is_cloud)
            for row in viewpoints
        }

    def compare(self, rows: Sequence[int]) -> Sequence[PairMatch]:
        last = self.attempts[-1]
        positions = np.flatnonzero(np.isin(last.searched.ranking.indices, rows)).tolist()
        more = self._validated(last, positions, retry=False)
        with self._store.database.read() as connection:
            existing_rows = frames_of(connection, [match.index for match in more.matches])
        self.attempts[-1] = replace(
            last,
            checks=replace(last.checks, geometries=last.checks.geometries | more.geometries),
            rows=last.rows | existing_rows,
            rivals=[match for match in more.matches if match.index in existing_rows],
            late=bool(more.late),
        )
        return self.attempts[-1].rivals

    def _validated(
        self, attempt: _Attempt, positions: Sequence[int],
        validations: Mapping[int, PairValidation] | None = None, *, retry: bool = True,
    ) -> Validated:  # fmt: skip
        return validated(
            self._store, attempt.searched, positions, attempt.prepared.geometry, self._query,
            self._deadline, self._model.parameters.validation, attempt.prepared.up, validations,
            guided=False, retry=retry,
        )  # fmt: skip


def _attempt(
    store: Store, places: Sequence[SearchedMap], model: Model, prepared: PreparedQuery,
    query: Query, deadline: Deadline, prior: PosePrior | None, clock: _Clock | None = None,
) -> _Attempt:  # fmt: skip
    """Search the maps for a frame of a query, validate its candidates, and return the results.

    Frames with damaged signatures are queued for signing.
    """
    clock = clock or _Clock({})
    searched = search_maps(store, places, prepared, query, model)
    for place in places:
        if place.view.damaged:
            resign_frames(store, place.row, sorted(place.view.damaged), place.row.model_id)
    ranking = searched.ranking
    clock.stage("retrieve")
    for_pose = (query.candidates or CANDIDATES) if "validate" in query.stages else query.k
    for_list = for_pose if query.candidates else max(for_pose, query.k)
    among, scales, selections = _selections(searched, query, model, (for_list, for_pose))
    clock.stage("diversify")
    selection, smaller = selections
    chosen = range(min(for_list, len(ranking))) if selection is None else selection.indices.tolist()
    first = chosen[:for_pose] if smaller is None else smaller.indices.tolist()
    if prior is not None:
        first = nearest_first(store, ranking, first, prior, model.answer.map)
    p = model.parameters.validation
    checks = validated(store, searched, first, prepared.geometry, query, deadline, p, prepared.up)
    clock.stage("validate")
    shown = range(len(ranking)) if query.explain else chosen
    with store.database.read() as connection:
        rows = frames_of(connection, ranking.indices[list(shown)].tolist())
    matches = [match for match in checks.matches if match.index in rows]  # omit deleted frames
    return _Attempt(prepared, searched, selection, among, scales, chosen, checks, rows, matches)


def _answer(
    store: Store, places: Sequence[SearchedMap], model: Model, last: _Attempt,
    estimate: PoseEstimate | None, query: Query, deadline: Deadline, clock: _Clock, earlier: int,
) -> tuple[Answer, tuple[int, ...]]:  # fmt: skip
    """Return the answer for the last frame of a sequence, and the frame numbers of its R."""
    prepared, searched, p = last.prepared, last.searched, model.parameters.validation
    ranking, checks = searched.ranking, _validate_more(store, last, query, deadline, p)
    clock.stage("validate")
    rivals_left = [rival for rival in last.rivals if rival.validation.status != "rejected"]
    matches = [*(match for match in checks.matches if match.index in last.rows), *rivals_left]
    names = {place.row.number: place.row.name for place in places}
    sensor = query_sensor(prepared.name, prepared.kind, list(names.values()))
    candidates = Candidates(
        names, ranking, last.selection, last.rows, checks.unreadable, checks.untried, sensor,
        p.covariance, prepared.base,
    )  # fmt: skip
    explanations = explained = None
    if query.explain:
        compared = replace(checks, matches=[*checks.matches, *last.rivals])
        explanations = explain(candidates, compared, last.among, last.scales)
    if query.explain_frame is not None:
        case = ExplainedQuery(store, searched, prepared, query, candidates, checks, model, deadline)
        explained = why(case, query.explain_frame)
    if query.explain or explained is not None:
        clock.stage("explain")
    clock.spent["total"] = round(sum(clock.spent.values()), 2)
    counts = [_counts(searched, i, candidates, checks, matches) for i in range(len(places))]
    sums = {name: sum(getattr(count, name) for count in counts) for name in Counts.model_fields}
    total = Counts(**sums)
    deciding = [*last.matches, *rivals_left]
    accepted = [last.rows[m.index] for m in deciding if m.validation.status == "accepted"]
    posed = any(row.pose is not None for row in accepted)
    outcome = answer_status(
        query, estimate, last.checks, deciding, total, prepared.geometry, p, posed=posed
    )
    others = alternative_records(candidates, estimate) if outcome.status == "ambiguous" else []
    response = Answer(
        query_id=uuid.uuid4().hex,
        status=outcome.status,
        reason=outcome.reason,
        cause=outcome.cause,
        matches=_listed_matches(candidates, last, checks, rivals_left, query.k),
        location=location_record(candidates, estimate) if outcome.status == "found" else None,
        alternatives=others,
        seed=query.seed,
        model=model.label,
        index_version=min(place.view.number for place in places),
        exact=searched.exact,
        counts=total,
        milliseconds=clock.spent,
        maps=[place.row.name for place in places],
        frame=prepared.name,
        kind=prepared.kind,
        frames=1 + earlier,
        per_map=_per_map(places, counts) if len(places) > 1 else None,
        deadline_reached=None if checks.late is None else checks.late or last.late,
        explanations=explanations,
        explained_frame=explained,
    )
    return response, tuple(ranking.indices.tolist())


def _listed_matches(
    candidates: Candidates, last: _Attempt, checks: Validated, rivals: Sequence[PairMatch], k: int
) -> list[Match]:
    """Return match records of candidates and rivals, without accepted matches after the first k."""
    shown = listed([match for match in checks.matches if match.index in last.rows], k)
    hidden = {match.index for match in checks.matches} - {match.index for match in shown}
    order = candidates.ranking.indices.tolist()
    chosen = [position for position in last.chosen if order[position] not in hidden]
    beyond = [order.index(rival.index) for rival in rivals]
    return match_records(candidates, [*chosen, *beyond], [*shown, *rivals])


def _validate_more(
    store: Store, last: _Attempt, query: Query, deadline: Deadline, p: ValidationParameters
) -> Validated:
    """Validate further candidates if `k` requires it; return the validations of all candidates."""
    checks = last.checks
    accepted = sum(match.validation.status == "accepted" for match in checks.matches)
    rest = [position for position in last.chosen if position not in checks.chosen]
    if query.k > VERDICT_MATCHES and (rest or accepted == VERDICT_MATCHES) and not checks.late:
        validations = {match.index: match.validation for match in checks.matches}
        return validated(
            store, last.searched, [*checks.chosen, *rest], last.prepared.geometry, query, deadline,
            p, last.prepared.up, validations, k=query.k, retry=False,
        )  # fmt: skip
    return replace(checks, chosen=last.chosen)


def _selections(
    searched: Searched, query: Query, model: Model, sizes: Sequence[int]
) -> tuple[Ints64 | None, DiversityParameters | None, list[Selection | None]]:
    """Return the distances within R, the parameters, and a selection C of each size; Sec. III-D.

    The selection is greedy, so that a larger C contains the smaller ones.
    """
    if "diversify" not in query.stages:
        return None, None, [None for _ in sizes]
    scales = None
    if query.diversity is not None:
        scales = DiversityParameters(query.diversity.sigma, query.diversity.omega)
    among = pairwise_distances(searched.signatures(), model.metric)
    of_size = {
        size: diversify(searched.ranking.distances, among, size, scales) for size in set(sizes)
    }
    return among, scales, [of_size[size] for size in sizes]


def _per_map(places: Sequence[SearchedMap], counts: Sequence[Counts]) -> dict[str, OfMap]:
    return {
        place.row.name: OfMap(index_version=place.view.number, counts=own)
        for place, own in zip(places, counts, strict=True)
    }


def _counts(
    searched: Searched,
    i: int,
    candidates: Candidates,
    checks: Validated,
    matches: Sequence[PairMatch],
) -> Counts:
    """Return the number of frames of the map `searched.parts[i]` that reached each stage."""
    part, hits = searched.parts[i], searched.hits[i]
    number = part.place.row.number
    statuses = [
        match.validation.status
        for match in matches
        if candidates.rows[match.index].map_number == number
    ]
    own = searched.owners == i
    return Counts(
        map=part.size,
        passed=part.passed,
        compared=hits.compared,
        ranked=int(own.sum()),
        selected=0 if candidates.selection is None else int(own[list(checks.chosen)].sum()),
        validated=len(statuses),
        accepted=statuses.count("accepted"),
    )


#: Minimum number of distinct planes in a distinctive frame.
_FEWEST_PLANES = 4.0
#: Ratio between surface distances in the query and in the candidates that indicates a wrong scale.
_OTHER_SCALE = 2.5


@dataclass(frozen=True)
class Outcome:
    """Status of an answer, its reason, and the most likely cause of `not_found`."""

    status: AnswerStatus
    reason: str
    cause: Cause | None = None


def answer_status(
    query: Query, estimate: PoseEstimate | None, checks: Validated, matches: Sequence[PairMatch],
    counts: Counts, geometry: Geometry | None, p: ValidationParameters, *, posed: bool,
) -> Outcome:  # fmt: skip
    """Return the status of an answer, with its reason and cause.

    Parameters
    ----------
    estimate : result of `decide`; None if no match has a pose
    checks : result of `validated`
    matches : validated candidates that still exist
    counts : number of frames at each stage, summed over the maps
    geometry : geometry of the query; None if validation is skipped
    posed : whether an accepted match has a pose in the map
    """
    if "validate" not in query.stages:
        return Outcome("unvalidated", "validation was not requested")
    accepted = [match for match in matches if match.validation.status == "accepted"]
    if accepted and not posed:
        return Outcome(
            "found",
            f"{len(accepted)} matches are accepted, but none has a pose in the map; `best` "
            "contains the transform to the first match",
        )
    unsure = next((match for match in matches if match.validation.status == "ambiguous"), None)
    decided = estimate is not None and estimate.status == "found"
    if estimate is not None and (decided or accepted or (estimate.alternatives and not unsure)):
        return Outcome(estimate.status, estimate.reason)
    if unsure is not None:
        return Outcome("ambiguous", f"the best fit is not unique: {unsure.validation.reason}")
    if checks.late:
        explanation = (
            f"the deadline passed before a match was accepted: {counts.validated} of "
            f"{len(checks.chosen)} candidates were validated. Increase `deadline_ms`"
        )
        return Outcome("unvalidated", explanation, "deadline")
    cause, reason = _likeliest_cause(checks, matches, counts, geometry, p)
    return Outcome("not_found", reason, cause)


def _likeliest_cause(
    checks: Validated, matches: Sequence[PairMatch], counts: Counts, geometry: Geometry | None,
    p: ValidationParameters,
) -> tuple[Cause, str]:  # fmt: skip
    """Return the most likely cause of `not_found`, and a text with the cause and the next step."""
    if not counts.passed:
        if counts.map:
            return "no_frames", "no frame of the map passes the filter. Widen the filter"
        return "no_frames", "the map has no indexed frames. Upload frames of the place"
    tilted = next((match for match in matches if match.validation.contradicts_up), None)
    if tilted is not None:
        return "gravity", tilted.validation.reason
    if geometry is not None:
        own = _cause_in_view(geometry, checks, p)
        if own is not None:
            return own
    first = matches[0].validation.reason if matches else ""
    nearest = f" (the nearest: {first})" if first else ""
    return (
        "nothing_alike",
        f"none of {counts.validated} candidates is accepted{nearest}. Move and send another "
        "query, or add frames of this place to the map",
    )


def _cause_in_view(
    geometry: Geometry, checks: Validated, p: ValidationParameters
) -> tuple[Cause, str] | None:
    """Return a cause in the query frame itself, with its text; None if the frame is good."""
    if len(geometry.patches) < p.minimum_patches:
        return (
            "too_little_in_view",
            f"the frame has {len(geometry.patches)} surface patches, but {p.minimum_patches} are "
            "needed. Turn the sensor so that it sees more surfaces, and send another query",
        )
    planes = float(plane_weights(geometry.patches, PlaneParameters()).sum(dtype=float))
    if planes < _FEWEST_PLANES:
        return (
            "one_plane",
            f"the frame shows {planes:.0f} planes, too few to distinguish places. Turn the "
            "sensor towards furniture or a corner, and send another query",
        )
    others = list(checks.geometries.values())
    if not others:
        return None
    if all(type(other.surface.camera) is not type(geometry.surface.camera) for other in others):
        return (
            "other_sensor",
            "the frame and the map are from different kinds of sensors. Query a map of the same "
            "kind of sensor",
        )
    ratio = _distance(geometry) / float(np.median([_distance(other) for other in others]))
    if not 1 / _OTHER_SCALE < ratio < _OTHER_SCALE:
        return (
            "scale",
            f"the surfaces in the frame are {ratio:.2g} times as far away as those in the map. "
            "Check `depth_scale`, or `units_per_metre` of a cloud",
        )
    return None


def _distance(geometry: Geometry) -> float:
    """Return the median distance of patches from the sensor, metres."""
    return float(np.median(np.linalg.norm(geometry.patches.means, axis=1)))
