"""API records of matches and poses, and explanations of rankings.

Candidates, Validated  --match_records | explain-->  Match | Explanation of each
frame id, Searched, Validated  --why-->  ExplainedFrame
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from sceneprint.engine.search import retrieval
from sceneprint.engine.search.up_vectors import known_ups
from sceneprint.engine.search.verification import NOT_REQUESTED, Validated, thresholds
from sceneprint.engine.serializers import copy_fields, sensor_of, transform, vector
from sceneprint.errors import DamagedBlob, UnknownFrame, UnreadableGeometry
from sceneprint.geometry.registration.icp import (
    PAIR_METHOD,
    PLACE_METHOD,
    CovarianceParameters,
    Method,
    free_directions,
)
from sceneprint.geometry.retrieval.ranking import (
    DUPLICATE,
    DiversityParameters,
    Ints64,
    Ranking,
    Selection,
    distances,
    remaining_gains,
    similarity,
)
from sceneprint.geometry.rigid import inverse
from sceneprint.geometry.validation.confidence import PlaceEvidence
from sceneprint.geometry.validation.validation import PairValidation
from sceneprint.localization import PoseEstimate
from sceneprint.models import Model
from sceneprint.pipeline import PairMatch, validate
from sceneprint.store import Store
from sceneprint.store.maps import find_frame, geometry_blobs
from sceneprint.store.tables import FrameRow
from sceneprint.types import Floats
from sceneprint_client.api import Alternative as AlternativeRecord
from sceneprint_client.api import (
    EvidenceRecord,
    ExplainedFrame,
    Explanation,
    FrameState,
    Query,
    Residual,
    Transform,
)
from sceneprint_client.api import Location as LocationRecord
from sceneprint_client.api import Match as MatchRecord
from sceneprint_client.api import Validation as ValidationRecord
from sceneprint_client.api.query import FreeDirection, Lost, Outcome, Stage, Uncertainty


@dataclass(frozen=True, eq=False)
class Candidates:
    """The candidates of a query, with the data that their records need.

    Parameters
    ----------
    maps : names of the queried maps, by map number
    ranking : R, of frame numbers
    selection : C; None if diversification was not requested
    rows : rows of the candidates that still exist, by frame number
    unreadable : errors of unreadable artifacts, by frame number
    untried : reason why the other candidates were not validated
    query_frame : name of the sensor frame of the query
    covariance : parameters that define free directions
    base : name of the base frame of the robot, and T_base_query (4, 4); None if unknown
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
        """Return the pose of the robot base; None if the base or the query pose is unknown."""
        if self.base is None or T_parent_query is None:
            return None
        name, T_base_query = self.base
        return transform(T_parent_query @ inverse(T_base_query), parent, name)


def listed(matches: Sequence[PairMatch], k: int) -> list[PairMatch]:
    """Return the matches without the accepted ones after the first `k`."""
    accepted = [match.index for match in matches if match.validation.status == "accepted"]
    return [match for match in matches if match.index not in accepted[k:]]


def match_records(
    candidates: Candidates, chosen: Sequence[int], matches: Sequence[PairMatch]
) -> list[MatchRecord]:
    """Return match records: first those of `matches`, then the unvalidated frames of `chosen`."""
    position = {int(candidates.ranking.indices[i]): i for i in chosen}
    checks = {match.index: match.validation for match in matches}
    order = [*checks, *(number for number in position if number not in checks)]
    records = []
    for number in order:
        if number not in candidates.rows:
            continue
        if number in checks:
            validation = validation_record(checks[number])
        else:
            validation = _skipped(candidates.unreadable.get(number, candidates.untried))
        records.append(_match(candidates, position[number], number, checks.get(number), validation))
    return records


def _skipped(reason: str) -> ValidationRecord:
    return ValidationRecord(status="skipped", reason=reason)


def location_record(candidates: Candidates, estimate: PoseEstimate | None) -> LocationRecord | None:
    """Return the API record of the pose of the query; None if there is no pose."""
    if estimate is None or estimate.average is None:
        return None
    average, (number, _, parent) = estimate.average, estimate.parent.partition(" ")
    return LocationRecord(
        pose=transform(average.T, parent, candidates.query_frame),
        map=candidates.maps[int(number)],
        confidence=estimate.confidence,
        evidence=evidence_record(estimate.evidence),
        support=len(estimate.members),
        guided=estimate.guided,
        votes=estimate.votes,
        strength=estimate.strength or "weak",
        verified_by=estimate.verified_by or "matches",
        spread_m=average.spread_m,
        spread_deg=math.degrees(average.spread_rad),
        uncertainty=uncertainty_record(estimate.covariance, PLACE_METHOD, candidates.covariance),
        base=candidates.base_of(average.T, parent),
    )


def alternative_records(
    candidates: Candidates, estimate: PoseEstimate | None
) -> list[AlternativeRecord]:
    """Return the API records of the alternative poses of an ambiguous answer."""
    if estimate is None:
        return []
    number, _, parent = estimate.parent.partition(" ")
    return [
        AlternativeRecord(
            pose=transform(alternative.T, parent, candidates.query_frame),
            map=candidates.maps[int(number)],
            confidence=alternative.confidence,
            evidence=evidence_record(alternative.evidence),
            support=alternative.support,
        )
        for alternative in estimate.alternatives
    ]


def evidence_record(evidence: PlaceEvidence | None) -> EvidenceRecord | None:
    """Return the API record of the evidence for a pose, rounded to three decimals."""
    if evidence is None:
        return None
    rounded = {
        name: round(value, 3) if isinstance(value, float) else value
        for name, value in asdict(evidence).items()
    }
    return EvidenceRecord.model_validate(rounded)


def _match(
    candidates: Candidates,
    position: int,
    number: int,
    checks: PairValidation | None,
    validation: ValidationRecord,
) -> MatchRecord:
    row, gain = candidates.rows[number], None
    selected = None
    if candidates.selection is not None:
        places = candidates.selection.indices.tolist()
        selected = position in places
        gain = float(candidates.selection.gains[places.index(position)]) if selected else None
    T = None if checks is None else checks.T_match_query
    in_map: Floats | None = None
    if T is not None and row.pose is not None and validation.status != "rejected":
        in_map = np.array(row.pose) @ T
    return copy_fields(
        MatchRecord,
        row,
        frame_id=row.id,
        map=candidates.maps[row.map_number],
        rank=position + 1,
        distance=int(candidates.ranking.distances[position]),
        similarity=float(candidates.ranking.similarities[position]),
        selected=selected,
        diversity_gain=gain,
        validation=validation,
        transform=None if T is None else transform(T, sensor_of(row), candidates.query_frame),
        predicted=(
            None
            if checks is None or checks.predicted is None
            else transform(checks.predicted, sensor_of(row), candidates.query_frame)
        ),
        parent_frame=row.sent_parent or row.pose_parent,
        pose_in_map=(
            None
            if in_map is None
            else transform(in_map, str(row.pose_parent), candidates.query_frame)
        ),
        uncertainty=(
            None
            if checks is None
            else uncertainty_record(checks.covariance, PAIR_METHOD, candidates.covariance)
        ),
        base_in_map=candidates.base_of(in_map, str(row.pose_parent)),
    )


def uncertainty_record(
    covariance: Floats | None, method: Method, p: CovarianceParameters
) -> Uncertainty | None:
    """Return the API record of a covariance (6, 6), including its free directions."""
    if covariance is None:
        return None
    free = [
        FreeDirection(
            translation=vector(direction.translation.tolist()),
            rotation=vector(direction.rotation.tolist()),
            deviation=direction.deviation,
        )
        for direction in free_directions(covariance, p)
    ]
    return Uncertainty(covariance=covariance.ravel().tolist(), method=method, degenerate=free)


def validation_record(v: PairValidation) -> ValidationRecord:
    """Return the API record of a validation."""
    residual = None
    if math.isfinite(v.residual_m):
        residual = Residual(translation_m=v.residual_m, rotation_deg=math.degrees(v.residual_rad))
    return copy_fields(
        ValidationRecord, v, residual=residual, free_space_violations=v.violations,
        plane_violations=None if v.violations is None else v.plane_violations,
        search=v.search if v.directions else None, directions=list(v.directions),
        tilt_deg=None if v.tilt_rad is None else math.degrees(v.tilt_rad),
    )  # fmt: skip


def explain(
    candidates: Candidates, checks: Validated, among: Ints64 | None, p: DiversityParameters | None
) -> list[Explanation]:
    """Return, for each frame of the ranking R, which stage it reached last, and why.

    Parameters
    ----------
    candidates : candidates with the rows of the frames of R; frames without a row are skipped
    checks : validations of the candidates
    among : (R, R) distances within R; None if diversification was not requested
    p : parameters of the selection
    """
    gains = None
    if among is not None and len(candidates.ranking):
        gains = remaining_gains(among, np.asarray(checks.chosen, np.intp), p)
    records = {match.index: validation_record(match.validation) for match in checks.matches}
    return list(_each(candidates, checks, records, among, gains))


def figures(v: ValidationRecord) -> str:
    """Format a validation as one line: status, reason and figures."""
    if v.residual is None:
        return f"{v.status}: {v.reason}"
    share = v.free_space_violations
    violations = "unknown" if share is None else f"{share:.3g}"
    return (
        f"{v.status}: {v.reason} (the two directions differ by {v.residual.translation_m:.3g} m, "
        f"{v.residual.rotation_deg:.3g} deg; overlap {v.overlap:.3g}, by planes "
        f"{v.plane_overlap:.3g}; violations {violations}; ambiguity "
        f"{v.ambiguity:.3g})"
    )


def _each(
    candidates: Candidates, checks: Validated, records: dict[int, ValidationRecord],
    among: Ints64 | None, gains: np.ndarray | None,
) -> Iterator[Explanation]:  # fmt: skip
    chosen = set(checks.chosen)
    for position, number in enumerate(candidates.ranking.indices.tolist()):
        if number not in candidates.rows:  # deleted during the query
            continue
        stage: Stage = "retrieve"
        outcome: Outcome = "not_selected"
        if number in records:
            stage, outcome = "validate", records[number].status
            reason = figures(records[number])
        elif position in chosen:
            stage = "retrieve" if candidates.selection is None else "diversify"
            was_requested = checks.untried != NOT_REQUESTED
            outcome = "skipped" if was_requested else "ranked"
            reason = checks.unreadable.get(number, checks.untried)
        elif among is not None and gains is not None:
            reason = _not_selected(candidates, checks, among, position, float(gains[position]))
        else:
            reason = f"not a candidate: these were the first {len(chosen)} frames of the ranking"
        yield Explanation(
            frame_id=candidates.rows[number].id,
            map=candidates.maps[candidates.rows[number].map_number],
            name=candidates.rows[number].name,
            rank=position + 1,
            distance=int(candidates.ranking.distances[position]),
            similarity=float(candidates.ranking.similarities[position]),
            stage=stage,
            outcome=outcome,
            reason=reason,
        )


def _not_selected(
    candidates: Candidates, checks: Validated, among: Ints64, position: int, gain: float
) -> str:
    """Return the reason why a frame was not selected, with its most similar selected frame."""
    own = among[position, list(checks.chosen)]
    nearest = checks.chosen[int(np.argmin(own))]
    row = candidates.rows.get(int(candidates.ranking.indices[nearest]))
    name = "frame, which was deleted" if row is None else f"frame {row.id}"
    if gain <= DUPLICATE:
        return f"a duplicate of the selected {name}"
    return (
        f"most similar to the selected {name} (distance {int(own.min())}); it would add a gain "
        f"of {gain:.2g}"
    )


@dataclass(frozen=True, eq=False)
class ExplainedQuery:
    """An answered query with the data to explain one frame."""

    store: Store
    searched: retrieval.Searched
    prepared: retrieval.PreparedQuery
    query: Query
    candidates: Candidates
    checks: Validated
    model: Model
    deadline: retrieval.Deadline


def why(case: ExplainedQuery, frame_id: str) -> ExplainedFrame:
    """Return the stage at which a query rejected a frame, and how the frame would align.

    Raise UnknownFrame if the frame is not in the queried maps.
    """
    part, row = _locate_frame(case, frame_id)
    absent = _unsearchable(case, part, row)
    name = part.place.row.name
    if absent is not None:
        return ExplainedFrame(
            frame_id=row.id, map=name, name=row.name, state=row.state, passes_filter=None,
            distance=None, similarity=None, rank=None, of=None, shortlisted=None, ranked=None,
            selected=None, validation=None, transform=None, lost_at=absent[0], reason=absent[1],
        )  # fmt: skip
    view, number = part.place.view, np.array([row.number], np.int64)
    stored = view.signatures(number)
    distance = distances(case.prepared.vector, stored, view.metric)
    rank = retrieval.rank_among_all(case.searched, case.prepared, row.number, int(distance[0]))
    at = np.flatnonzero(case.searched.ranking.indices == row.number).tolist()
    passes = part.among is None or row.number in part.among
    # infer misses of an approximate index, which does not report the frames that it compared
    missed = not at and passes and not case.searched.exact and rank <= case.searched.size
    selected = bool(at) and at[0] in case.checks.chosen
    validation, T = _aligned(case, part, row)
    if missed:
        lost: Lost | None = "shortlist"
        reason = f"the approximate index missed it, although its rank is {rank}; query with `exact`"
    else:
        lost, reason = _lost(case, row, rank, passes, bool(at), selected)
    early = lost not in (None, "validation")
    if early and validation is not None and validation.status != "skipped":
        reason += f"; validated only for this explanation, it is {figures(validation)}"
    return ExplainedFrame(
        frame_id=row.id,
        map=name,
        name=row.name,
        state=row.state,
        passes_filter=passes,
        distance=int(distance[0]),
        similarity=float(similarity(distance, case.model.unrelated_distance)[0]),
        rank=rank,
        of=sum(part.passed for part in case.searched.parts),
        shortlisted=not missed,
        ranked=bool(at),
        selected=selected,
        validation=validation,
        transform=(
            None if T is None
            else transform(T, sensor_of(row), case.candidates.query_frame)
        ),
        lost_at=lost,
        reason=reason,
    )  # fmt: skip


def _locate_frame(case: ExplainedQuery, frame_id: str) -> tuple[retrieval.MapSearch, FrameRow]:
    """Return the search of the map that has the frame, and the row of the frame.

    If several maps have a frame of this id, prefer a map whose search can return it.
    """
    parts, own = case.searched.parts, case.prepared.frame
    candidates, missing = [], None
    with case.store.database.read() as connection:
        for part in parts:
            try:
                candidates.append((part, find_frame(connection, part.place.row, frame_id)))
            except UnknownFrame as error:
                missing = error
    if missing is not None and not candidates:
        raise missing
    return min(
        candidates,
        key=lambda pair: (
            pair[1].state != FrameState.INDEXED,
            own is not None and pair[1].number == own[0],
        ),
    )


def _unsearchable(
    case: ExplainedQuery, part: retrieval.MapSearch, row: FrameRow
) -> tuple[Lost, str] | None:
    """Return stage and reason if a frame is the query or not in the index; otherwise None."""
    view, prepared = part.place.view, case.prepared
    if prepared.frame is not None and prepared.frame[0] == row.number:
        return "query", "it is the queried frame, which the search excludes"
    if row.state != FrameState.INDEXED:
        return "state", f"it is {row.state}: {row.state.sentence}"
    if row.number in view.damaged:
        return "state", "its signature is damaged and is being rebuilt from its upload"
    number = np.array([row.number], np.int64)
    if not view.has(number)[0]:
        return "state", "it was indexed during the query. Send the query again"
    return None


def _lost(
    case: ExplainedQuery, row: FrameRow, rank: int, passes: bool, ranked: bool, selected: bool
) -> tuple[Lost | None, str]:
    """Return the stage at which a query rejected a frame (None for a match), and the reason."""
    size, checks = len(case.searched.ranking), case.checks
    if not passes:
        return "filter", "it does not pass the filter"
    if not ranked:
        return "ranking", f"its rank is {rank}, and only {size} frames are ranked"
    if not selected:
        return "selection", (
            f"its rank is {rank}, and it is not among the {len(checks.chosen)} candidates; query "
            "with more `candidates`, or with `explain` to get the most similar candidate"
        )
    status = {match.index: match.validation for match in checks.matches}.get(row.number)
    shown = {match.index for match in listed(checks.matches, case.query.k)}
    if status is not None and row.number not in shown:
        return "turn", (
            "more than `k` matches are accepted, and `k` others precede it; "
            f"{figures(validation_record(status))}"
        )
    if status is not None and status.status == "accepted":
        return None, f"it is a match, {figures(validation_record(status))}"
    if status is not None:
        return "validation", figures(validation_record(status))
    if "validate" not in case.query.stages:
        return None, f"it is a match with rank {rank}; validation was not requested"
    if row.number in checks.unreadable:
        return "validation", checks.unreadable[row.number]
    return "deadline" if checks.late else "turn", checks.untried


def _aligned(
    case: ExplainedQuery, part: retrieval.MapSearch, row: FrameRow
) -> tuple[ValidationRecord | None, np.ndarray | None]:
    """Return validation and transform of a frame, validated now if necessary; None if unknown."""
    geometry = case.prepared.geometry
    if geometry is None:
        return None, None
    earlier: dict[int, PairValidation] = {m.index: m.validation for m in case.checks.matches}
    aligned = earlier.get(row.number)
    if aligned is None:
        if not case.deadline.allows():
            return _skipped("the deadline passed before it was validated"), None
        model_id = part.place.row.model_id
        with case.store.database.read() as connection:
            blob = geometry_blobs(connection, [row.number], model_id).get(row.number)
            ranked = case.searched.ranking.indices.tolist()
            up = known_ups(connection, [*ranked, row.number]).get(row.number)
        if blob is None:
            return _skipped("it was deleted during the query"), None
        try:
            own = case.store.geometries.read(blob)
        except (DamagedBlob, UnreadableGeometry) as error:
            return _skipped(str(error)), None
        query = case.query
        p = case.model.parameters.validation
        options = thresholds(query.validation, p)
        aligned = validate(geometry, own, query.seed, *options, ups=(case.prepared.up, up))
    return validation_record(aligned), aligned.T_match_query
