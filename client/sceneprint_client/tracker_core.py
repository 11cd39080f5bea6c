"""State of a tracked robot, computed from answers and odometry without a service.

answer of the service  --observation_of-->  Observation
odometry, Observation  --TrackerCore.update-->  State: lost, ambiguous or tracking; T_map_odom

Each answer is a vote for T_map_odom = T_map_sensor @ inv(T_odom_sensor). The same calls give the
same states, so a log of them can be replayed.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sceneprint_client.api import Localization
from sceneprint_client.api.query import MOST_OF_SEQUENCE
from sceneprint_client.errors import InvalidRequest
from sceneprint_client.poses import rigid_transform

Array = NDArray[np.float64]
TrackerStatus = Literal["lost", "ambiguous", "tracking"]

#: Minimum standard deviations of the filter, and deviations that are added to those of an answer.
_LEAST_M, _LEAST_RAD = 0.01, math.radians(0.3)
_ANSWER_M, _ANSWER_RAD = 0.03, math.radians(1.0)
#: Factor that increases the deviations of an answer if the prior decided on the pose.
_PRIOR_FACTOR = 2.0
#: Number of odometry poses stored; limits how late an answer can arrive.
_MOST_MARKS = 4096
#: Minimum motion between two views of one query; either value is sufficient.
_SPACING_M, _SPACING_RAD = 0.1, math.radians(6.0)
#: Maximum path length and turn from an earlier view of a query to the last view. Beyond these,
#: odometry may be off by centimetres, or has jumped.
_LONGEST_WAY_M, _LONGEST_TURN_RAD = 3.0, math.radians(120.0)


@dataclass(frozen=True)
class TrackerParameters:
    """Parameters of a TrackerCore.

    Parameters
    ----------
    drift : drift of the odometry, as a fraction of the travelled distance
    turn_drift : drift of the odometry, as a fraction of the turned angle
    heading_drift_deg : drift of the heading, degrees per travelled metre
    gate_m, gate_deg : maximum difference between two poses of one place, in addition to drift
    apart_m, apart_deg : minimum distance, or else minimum angle, between two independent views
    strong_weight, weak_weight : weights of an answer `found` with strong matches from at least two
        viewpoints, and of any other answer `found`
    alternative_weight : total weight of the alternatives of an ambiguous answer
    need : minimum lead in weight of a place over any other place, for a first fix
    ratio : minimum ratio of the weight of answers `found` at a place to that at any other place,
        for a first fix
    most_votes : number of stored answers
    half_life_m, half_life_s : distance and time after which the weight of a vote is halved
    contradictions : weight of contradictions, from separate viewpoints, after which the robot is
        lost. An answer `found` elsewhere has weight 1, an ambiguous answer without the tracked
        place 0.5
    patience_s : longest period of contradictions from one place before the robot is lost
    most_deviation_m : maximum standard deviation of the position; beyond it, the robot is lost
    most_undecided_m : distance after which the state is ambiguous if all answers leave several
        places possible or depend on the prior
    alone_every : interval, in queries, between queries without a prior
    frames : number of latest frames in a query while the robot is lost or ambiguous, 1 to 10
    """

    drift: float = 0.01
    turn_drift: float = 0.01
    heading_drift_deg: float = 0.1
    gate_m: float = 0.35
    gate_deg: float = 8.0
    apart_m: float = 0.3
    apart_deg: float = 15.0
    strong_weight: float = 1.5
    weak_weight: float = 0.6
    alternative_weight: float = 0.4
    need: float = 1.0
    ratio: float = 2.0
    most_votes: int = 32
    half_life_m: float = 30.0
    half_life_s: float = 120.0
    contradictions: float = 2.0
    patience_s: float = 1.5
    most_deviation_m: float = 0.3
    most_undecided_m: float = 10.0
    alone_every: int = 4
    frames: int = 3

    def __post_init__(self) -> None:
        if not 1 <= self.frames <= MOST_OF_SEQUENCE:
            raise InvalidRequest(
                f"A query cannot contain {self.frames} frames. Set `frames` to 1 to "
                f"{MOST_OF_SEQUENCE}.",
                (("frames", f"not from 1 to {MOST_OF_SEQUENCE}"),),
            )


@dataclass(frozen=True, eq=False)
class PoseEvidence:
    """A pose that an answer supports.

    Parameters
    ----------
    parent_frame : parent frame of the map
    T_map_sensor : (4, 4)
    weight : confidence of an alternative relative to the others
    covariance : (6, 6) of errors (x, y, z, rx, ry, rz), metres and radians; None if unknown
    """

    parent_frame: str
    T_map_sensor: Array
    weight: float = 1.0
    covariance: Array | None = None


@dataclass(frozen=True, eq=False)
class Observation:
    """Evidence of an answer.

    Parameters
    ----------
    status : status of the answer; `unanswered` without an answer
    poses : pose of the answer, or its alternatives if it is ambiguous
    strong : whether strong matches from at least two viewpoints support the pose
    by_prior : whether the prior decided between several poses
    reason : reason for the answer
    earlier : (4, 4) T_odom_sensor of each earlier frame of the query
    """

    status: Literal["found", "ambiguous", "not_found", "unanswered"]
    poses: tuple[PoseEvidence, ...] = ()
    strong: bool = False
    by_prior: bool = False
    reason: str = ""
    earlier: tuple[Array, ...] = ()


def observation_of(answer: Localization) -> Observation:
    """Return the evidence of an answer of `localize`."""
    if answer.status == "found" and answer.pose is not None:
        covariance = None
        if answer.uncertainty is not None:
            covariance = np.reshape(np.array(answer.uncertainty.covariance), (6, 6))
        pose = PoseEvidence(
            answer.pose.parent_frame, rigid_transform(np.array(answer.pose.matrix)), 1.0, covariance
        )
        strong = answer.strength == "strong" and answer.support >= 2
        return Observation("found", (pose,), strong, answer.verified_by == "prior", answer.reason)
    if answer.status == "found":
        return Observation("not_found", reason="No matching frame has a pose in the map.")
    poses = tuple(
        PoseEvidence(
            alternative.pose.parent_frame, rigid_transform(np.array(alternative.pose.matrix)),
            max(alternative.confidence or 0.0, 1e-3),
        )
        for alternative in answer.alternatives
    )  # fmt: skip
    return Observation(answer.status, poses, reason=answer.reason)


@dataclass(frozen=True, eq=False)
class State:
    """Pose of the robot, as far as it is known.

    Parameters
    ----------
    status : `tracking`: the pose is safe to use; `ambiguous`: several places are possible, or the
        tracked place is in doubt; `lost`: no place is known
    stamp : stamp of the latest odometry, seconds
    parent_frame : parent frame of the map, to which T_map_odom leads; None if unknown
    T_map_odom : (4, 4), or None; while tracking, only corrections by answers change it
    T_map_sensor : (4, 4) T_map_odom @ T_odom_sensor, or None
    covariance : (6, 6) of T_map_sensor, errors (x, y, z, rx, ry, rz) in the order of ROS, or None
    age : time since an answer without a prior confirmed the place, seconds, or None
    reason : reason for the status
    """

    status: TrackerStatus
    stamp: float
    parent_frame: str | None
    T_map_odom: Array | None
    T_map_sensor: Array | None
    covariance: Array | None
    age: float | None
    reason: str


@dataclass(frozen=True, eq=False)
class _Mark:
    """A pose of the odometry, and the path to it in metres and radians.

    `earlier` holds the poses of earlier frames that support the same answer.
    """

    stamp: float
    T_odom_sensor: Array
    distance: float
    angle: float
    earlier: tuple[Array, ...] = ()


@dataclass(frozen=True, eq=False)
class _Vote:
    """A pose that an answer supports, at a pose of the odometry."""

    number: int  #: number of the answer
    mark: _Mark
    evidence: PoseEvidence
    weight: float
    found: bool
    agreeing: set[int] = field(default_factory=set)  #: indices of the votes that agree


@dataclass(frozen=True, eq=False)
class _Belief:
    """The tracked pose after the last correction."""

    parent_frame: str
    mark: _Mark
    T_map_sensor: Array
    covariance: Array
    confirmed: float  #: stamp of the last answer that confirmed the pose without a prior
    #: Travelled distance at the first later answer that left several places possible or depended on
    #: the prior; None if there is no such answer.
    undecided: float | None = None


class TrackerCore:
    """Votes over time, and the resulting state; not safe to share between threads."""

    def __init__(self, parameters: TrackerParameters | None = None) -> None:
        self.parameters = parameters or TrackerParameters()
        self._marks: deque[_Mark] = deque(maxlen=_MOST_MARKS)
        self._votes: list[_Vote] = []
        self._belief: _Belief | None = None
        self._against: list[tuple[int, _Mark, float]] = []
        self._answers = 0
        self._stamp = 0.0
        self._verdict: tuple[TrackerStatus, str] = ("lost", "no frame has been queried")

    def move(self, stamp: float, T_odom_sensor: Array) -> State:
        """Update the odometry without an answer, and return the state."""
        mark = self._mark(stamp, rigid_transform(T_odom_sensor))
        if self._belief is not None:
            self._verdict = self._track(mark)
        return self.state()

    def update(self, stamp: float, T_odom_sensor: Array, observation: Observation) -> State:
        """Add an answer, and return the state.

        Parameters
        ----------
        stamp, T_odom_sensor : stamp, seconds, and odometry of the queried frame. Answers arrive in
            the order of their frames, but later odometry may have arrived before
        observation : the answer

        Returns
        -------
        state : state at the latest odometry

        Raises
        ------
        InvalidPose : If the odometry is not a rigid transform.
        InvalidRequest : If the stamps are not strictly increasing.
        """
        mark = self._mark(stamp, rigid_transform(T_odom_sensor))
        if observation.status == "unanswered":
            status, reason = self._verdict[0], observation.reason
            self._verdict = self._track(self._marks[-1]) if self._belief else (status, reason)
            return self.state()
        self._answers += 1
        mark = replace(mark, earlier=observation.earlier)
        self._vote(mark, observation)
        if self._belief is None:
            self._verdict = self._first_fix(mark, observation)
        else:
            self._compare(mark, observation)
            self._verdict = self._track(self._marks[-1])
        return self.state()

    def reset(self, reason: str = "it was reset") -> State:
        """Forget the pose, as after a lift, which odometry does not measure; return the state.

        The clock and the odometry may restart. Do not pass answers to earlier frames afterwards.
        """
        self._forget()
        self._votes.clear()
        self._stamp = self.state().stamp
        self._marks.clear()
        self._verdict = ("lost", reason)
        return self.state()

    def state(self) -> State:
        """Return the current state."""
        status, reason = self._verdict
        stamp = self._marks[-1].stamp if self._marks else self._stamp
        belief = self._belief
        if belief is None:
            return State(status, stamp, None, None, None, None, None, reason)
        T, P = self._predict(self._marks[-1])
        T_map_odom = rigid_transform(belief.T_map_sensor @ inverse(belief.mark.T_odom_sensor))
        age = stamp - belief.confirmed
        return State(status, stamp, belief.parent_frame, T_map_odom, T, P, age, reason)

    def prior(self, T_odom_sensor: Array) -> PoseEvidence | None:
        """Return the prior for the next query; None for every `alone_every`-th query, and unless
        the robot is tracked without a contradicting answer.
        """
        alone = (self._answers + 1) % self.parameters.alone_every == 0
        if self._belief is None or self._against or alone or self._verdict[0] != "tracking":
            return None
        T, P = self._predict(self._ahead(rigid_transform(T_odom_sensor)))
        return PoseEvidence(self._belief.parent_frame, T, 1.0, P + _diagonal_covariance(0.05, 0.03))

    # Odometry.

    def _mark(self, stamp: float, T: Array) -> _Mark:
        """Return the mark at a stamp, and add it if the stamp is after the last one.

        Raise InvalidRequest if an earlier stamp has no mark, or its mark has another pose.
        """
        if self._marks and stamp <= self._marks[-1].stamp:
            at = bisect_right([mark.stamp for mark in self._marks], stamp) - 1
            mark = self._marks[max(at, 0)]
            if mark.stamp != stamp or not np.allclose(mark.T_odom_sensor, T, atol=1e-6):
                raise InvalidRequest(
                    f"The stamp {stamp} is not after {self._marks[-1].stamp}, the stamp of the "
                    "last odometry. Pass increasing stamps; after a jump of the clock, reset the "
                    "tracker.",
                    (("stamp", "not after the last"),),
                )
            return mark
        mark = replace(self._ahead(T), stamp=stamp)
        self._marks.append(mark)
        return mark

    def _ahead(self, T: Array) -> _Mark:
        """Return the mark that a pose after the last mark would have."""
        if not self._marks:
            return _Mark(-math.inf, T, 0.0, 0.0)
        last = self._marks[-1]
        step, turn = difference(last.T_odom_sensor, T)
        return _Mark(last.stamp, T, last.distance + step, last.angle + turn)

    def _drifts(self, a: _Mark, b: _Mark) -> tuple[float, float]:
        """Return the expected drift of the odometry between two marks, metres and radians."""
        p, way = self.parameters, abs(a.distance - b.distance)
        turned = math.radians(p.heading_drift_deg) * way + p.turn_drift * abs(a.angle - b.angle)
        return p.drift * way, turned

    def _are_independent(self, a: _Mark, b: _Mark) -> bool:
        """Return whether all views of two answers are far enough apart to be independent."""
        A, B = (np.stack([mark.T_odom_sensor, *mark.earlier]) for mark in (a, b))
        steps = np.linalg.norm(A[:, None, :3, 3] - B[None, :, :3, 3], axis=2)
        # The trace of a rotation is 1 + 2 cos(angle).
        cosines = (np.einsum("aij,bij->ab", A[:, :3, :3], B[:, :3, :3]) - 1) / 2
        turned = cosines < math.cos(math.radians(self.parameters.apart_deg))
        return bool(np.all((steps > self.parameters.apart_m) | turned))

    # Votes, and the first fix.

    def _vote(self, mark: _Mark, observation: Observation) -> None:
        """Add the poses of an answer as votes, unless the prior decided between them; remove the
        votes of answers before the last `most_votes`.
        """
        p, total = self.parameters, sum(pose.weight for pose in observation.poses)
        found = observation.status == "found"
        if found and observation.by_prior:
            return
        for pose in observation.poses:
            weight = p.alternative_weight * pose.weight / total
            if found:
                weight = p.strong_weight if observation.strong else p.weak_weight
            vote = _Vote(self._answers, mark, pose, weight, found)
            for place, other in enumerate(self._votes):
                if self._votes_agree(other, vote):
                    vote.agreeing.add(place)
                    other.agreeing.add(len(self._votes))
            vote.agreeing.add(len(self._votes))
            self._votes.append(vote)
        self._filter_votes(lambda vote: vote.number > self._answers - p.most_votes)

    def _filter_votes(self, condition: Callable[[_Vote], bool]) -> None:
        if all(map(condition, self._votes)):
            return
        remaining = [old for old, vote in enumerate(self._votes) if condition(vote)]
        place = {old: new for new, old in enumerate(remaining)}
        self._votes = [
            replace(vote, agreeing={place[friend] for friend in vote.agreeing if friend in place})
            for vote in map(self._votes.__getitem__, remaining)
        ]

    def _votes_agree(self, older: _Vote, newer: _Vote) -> bool:
        """Return whether two votes agree, after odometry moves the older to the newer."""
        if older.evidence.parent_frame != newer.evidence.parent_frame:
            return False
        moved = inverse(older.mark.T_odom_sensor) @ newer.mark.T_odom_sensor
        carried = older.evidence.T_map_sensor @ moved
        step, turn = difference(carried, newer.evidence.T_map_sensor)
        drift_m, drift_rad = self._drifts(older.mark, newer.mark)
        p = self.parameters
        return step <= p.gate_m + 2 * drift_m and turn <= math.radians(p.gate_deg) + 2 * drift_rad

    def _weight(
        self, places: Iterable[int], apart: Callable[[_Mark, _Mark], bool], *, found: bool
    ) -> float:
        """Return the weight of votes, or only of `found` votes. Of views that are not `apart`, only
        the one with the greatest weight counts.
        """
        votes = [self._votes[place] for place in places]
        weighed = sorted(
            ((self._current_weight(vote), vote) for vote in votes if vote.found or not found),
            key=lambda pair: (-pair[0], pair[1].number),
        )
        counted: list[_Mark] = []
        total = 0.0
        for weight, vote in weighed:
            if all(apart(vote.mark, other) for other in counted):
                counted.append(vote.mark)
                total += weight
        return total

    def _current_weight(self, vote: _Vote) -> float:
        """Return the weight of a vote after its decay over distance and time."""
        p, now = self.parameters, self._votes[-1].mark
        halves = abs(now.distance - vote.mark.distance) / p.half_life_m
        halves += abs(now.stamp - vote.mark.stamp) / p.half_life_s
        return float(vote.weight * 0.5**halves)

    def _first_fix(self, mark: _Mark, observation: Observation) -> tuple[TrackerStatus, str]:
        """Return status and reason without a belief; set the belief if a place leads clearly."""
        p = self.parameters
        own = [i for i, vote in enumerate(self._votes) if vote.number == self._answers]
        if not own:
            disputed = any(len(vote.agreeing) < len(self._votes) for vote in self._votes)
            waits = "several places are possible; " if disputed else ""
            return "ambiguous" if waits else "lost", waits + observation.reason
        apart = cache(self._are_independent)  # several votes compare the same marks
        totals = [self._weight(vote.agreeing, apart, found=False) for vote in self._votes]
        founds = [self._weight(vote.agreeing, apart, found=True) for vote in self._votes]
        best = max(own, key=lambda place: (founds[place], totals[place], -place))
        others = [i for i in range(len(totals)) if i not in self._votes[best].agreeing]
        rival = max((totals[i] for i in others), default=0.0)
        rival_found = max((founds[i] for i in others), default=0.0)
        leads = totals[best] - rival >= p.need - 1e-9 and founds[best] >= p.ratio * rival_found
        if founds[best] > 0 and leads:
            self._set_belief(mark, best)
            return "tracking", "found: " + observation.reason
        if observation.status == "ambiguous" or rival_found > 0:
            return "ambiguous", "several places are possible; " + observation.reason
        return "lost", "one view suggests a place; move, and query again"

    def _set_belief(self, mark: _Mark, best: int) -> None:
        """Set the belief to the newest vote `found` at the best place, moved by odometry."""
        supporters = [self._votes[place] for place in self._votes[best].agreeing]
        vote = max((vote for vote in supporters if vote.found), key=lambda vote: vote.number)
        pose = vote.evidence
        start = _Belief(
            pose.parent_frame, vote.mark, pose.T_map_sensor, _covariance_of(pose), vote.mark.stamp
        )
        self._belief = start
        T, P = self._predict(mark)
        self._belief = replace(start, mark=mark, T_map_sensor=T, covariance=P)
        self._against.clear()

    # The tracked place.

    def _predict(self, mark: _Mark) -> tuple[Array, Array]:
        """Return T_map_sensor and its covariance at a mark, from the belief and the odometry."""
        belief = self._belief
        if belief is None:
            raise AssertionError("there is no tracked pose")
        T = belief.T_map_sensor @ inverse(belief.mark.T_odom_sensor) @ mark.T_odom_sensor
        drift_m, drift_rad = self._drifts(belief.mark, mark)
        carried = shifted_covariance(belief.covariance, T[:3, 3] - belief.T_map_sensor[:3, 3])
        return T, carried + _diagonal_covariance(drift_m, drift_rad)

    def _is_tracked(self, pose: PoseEvidence, T: Array, P: Array) -> bool:
        """Return whether a pose agrees with the tracked pose T, within the gate plus twice the
        deviations of T, whose covariance is P.
        """
        if self._belief is None or pose.parent_frame != self._belief.parent_frame:
            return False
        step, turn = difference(T, pose.T_map_sensor)
        gate = self.parameters.gate_m + 2 * _largest_deviation(P[:3, :3])
        gate_rad = math.radians(self.parameters.gate_deg) + 2 * _largest_deviation(P[3:, 3:])
        return step <= gate and turn <= gate_rad

    def _compare(self, mark: _Mark, observation: Observation) -> None:
        """Correct the belief by an answer that agrees, or record a contradiction."""
        belief = self._belief
        if belief is None or not observation.poses:
            return
        T, P = self._predict(mark)
        agreeing = [pose for pose in observation.poses if self._is_tracked(pose, T, P)]
        if observation.status == "found" and agreeing:
            if observation.by_prior:
                self._correct(mark, agreeing[0], _PRIOR_FACTOR)
                self._set_undecided(mark)
            else:
                self._correct(mark, agreeing[0], 1.0)
                if self._belief is not None:
                    self._belief = replace(self._belief, confirmed=mark.stamp, undecided=None)
                self._against.clear()
        elif agreeing:
            self._set_undecided(mark)
        elif not observation.by_prior:
            weight = 1.0 if observation.status == "found" else 0.5
            self._against.append((self._answers, mark, weight))

    def _set_undecided(self, mark: _Mark) -> None:
        if self._belief is not None and self._belief.undecided is None:
            self._belief = replace(self._belief, undecided=mark.distance)

    def _correct(self, mark: _Mark, pose: PoseEvidence, factor: float) -> None:
        """Correct the belief by a view; `factor` multiplies the view's deviations.

        Do nothing if there is no belief, or the view is not independent of it.
        """
        belief = self._belief
        if belief is None or not self._are_independent(belief.mark, mark):
            return
        T, P = self._predict(mark)
        R = _covariance_of(pose) * factor**2
        gain = P @ np.linalg.inv(P + R)
        off = np.concatenate([
            pose.T_map_sensor[:3, 3] - T[:3, 3],
            rotation_vector(pose.T_map_sensor[:3, :3] @ T[:3, :3].T),
        ])  # fmt: skip
        shift = gain @ off
        moved = np.eye(4)
        moved[:3, :3] = rotation_matrix(shift[3:]) @ T[:3, :3]
        moved[:3, 3] = T[:3, 3] + shift[:3]
        covariance = P - gain @ P
        covariance = (covariance + covariance.T) / 2
        floor = np.diag(_diagonal_covariance(_LEAST_M, _LEAST_RAD))
        covariance[np.diag_indices(6)] = np.maximum(np.diag(covariance), floor)
        self._belief = replace(
            belief, mark=mark, T_map_sensor=rigid_transform(moved), covariance=covariance
        )

    def _track(self, mark: _Mark) -> tuple[TrackerStatus, str]:
        """Return the status, and its reason, of the belief; drop a belief that lost its support."""
        p, belief = self.parameters, self._belief
        if belief is None:
            return self._verdict
        _, P = self._predict(mark)
        if self._against:
            first, since = self._against[0][:2]
            lasted = mark.stamp - since.stamp
            enough = self._contradiction() >= p.contradictions - 1e-9
            if enough or (len(self._against) > 1 and lasted >= p.patience_s - 1e-9):
                self._filter_votes(lambda vote: vote.number >= first)
                self._forget()
                return "lost", "answers repeatedly contradict the tracked place"
            if len(self._against) > 1:
                return "ambiguous", "answers from one place contradict the tracked place"
        deviation = _largest_deviation(P[:3, :3])
        if deviation > p.most_deviation_m:
            self._forget()
            return "lost", f"odometry since the last fix may be off by {deviation:.2f} m"
        if belief.undecided is not None and mark.distance - belief.undecided > p.most_undecided_m:
            return "ambiguous", "no answer has recently confirmed the place without the prior"
        if self._against:
            return "tracking", "one answer contradicts the tracked place; the pose is unchanged"
        return "tracking", "tracked by odometry since the last fix"

    def _contradiction(self) -> float:
        """Return the weight of contradicting answers; views from one place count once."""
        counted: list[tuple[int, _Mark, float]] = []
        for entry in sorted(self._against, key=lambda entry: (-entry[2], entry[0])):
            if all(self._are_independent(entry[1], other[1]) for other in counted):
                counted.append(entry)
        return sum(weight for _, _, weight in counted)

    def _forget(self) -> None:
        self._belief = None
        self._against.clear()


# Rigid transforms.


def inverse(T: Array) -> Array:
    """Return the inverse of a rigid transform (4, 4)."""
    back = np.eye(4)
    back[:3, :3] = T[:3, :3].T
    back[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return back


def difference(a: Array, b: Array) -> tuple[float, float]:
    """Return distance, metres, and angle, radians, between two poses (4, 4)."""
    angle = float(np.linalg.norm(rotation_vector(a[:3, :3].T @ b[:3, :3])))
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3])), angle


def spaced_views(poses: Sequence[Array], most: int) -> list[int]:
    """Return the indices of the latest views to use in one query.

    Any two views differ by 0.1 m or 6 degrees. The path from a view to the last view is at most 3 m
    long and turns by at most 120 degrees.

    Parameters
    ----------
    poses : (4, 4) T_odom_sensor of each view, in order of capture
    most : maximum number of views, including the last

    Returns
    -------
    places : increasing indices into `poses`, including the last
    """
    last = len(poses) - 1
    chosen, way, turned = [last], 0.0, 0.0
    for place in range(last - 1, -1, -1):
        step, turn = difference(poses[place], poses[place + 1])
        way, turned = way + step, turned + turn
        if len(chosen) >= most or way > _LONGEST_WAY_M or turned > _LONGEST_TURN_RAD:
            break
        if all(is_new_view(poses[place], poses[other]) for other in chosen):
            chosen.append(place)
    return chosen[::-1]


def is_new_view(a: Array, b: Array) -> bool:
    """Return whether two poses (4, 4) differ by at least 0.1 m or 6 degrees."""
    step, turn = difference(a, b)
    return step >= _SPACING_M or turn >= _SPACING_RAD


def rotation_vector(R: Array) -> Array:
    """Return the rotation vector (axis times angle, radians) of a rotation (3, 3)."""
    # Near 180 degrees, the skew part vanishes and the symmetric part contains the axis.
    skew = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2
    sine, cosine = float(np.linalg.norm(skew)), (float(np.trace(R)) - 1) / 2
    angle = math.atan2(sine, cosine)
    if sine > 1e-6:
        return skew * (angle / sine)
    if cosine > 0:
        return skew
    axis = np.linalg.eigh((R + R.T) / 2)[1][:, 2]
    return np.asarray(axis * angle, np.float64)


def rotation_matrix(vector: Array) -> Array:
    """Return the rotation (3, 3) of a rotation vector (axis times angle, radians)."""
    x, y, z = vector
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = float(np.linalg.norm(vector))
    sine, cosine = 1.0, 0.5
    if angle > 1e-9:
        sine, cosine = math.sin(angle) / angle, (1 - math.cos(angle)) / angle**2
    return np.asarray(np.eye(3) + sine * K + cosine * K @ K, np.float64)


def shifted_covariance(P: Array, offset: Array) -> Array:
    """Return the covariance (6, 6) of a pose that is rigidly attached to another pose.

    Parameters
    ----------
    P : (6, 6) covariance of the other pose, errors (x, y, z, rx, ry, rz) in the parent frame
    offset : (3,) vector from the other pose to the attached pose in the parent frame, metres
    """
    x, y, z = offset
    F = np.eye(6)  # a rotation error e moves the point by e x offset
    F[:3, 3:] = [[0, z, -y], [-z, 0, x], [y, -x, 0]]
    return np.asarray(F @ P @ F.T, np.float64)


def _diagonal_covariance(metres: float, radians: float) -> Array:
    """Return the covariance (6, 6) of independent deviations."""
    return np.diag(np.repeat([metres**2, radians**2], 3))


def _covariance_of(pose: PoseEvidence) -> Array:
    """Return the covariance of a pose, plus the deviations that every answer has."""
    least = _diagonal_covariance(_ANSWER_M, _ANSWER_RAD)
    return least if pose.covariance is None else pose.covariance + least


def _largest_deviation(P: Array) -> float:
    """Return the largest standard deviation in any direction."""
    return math.sqrt(max(float(np.linalg.eigvalsh(P)[-1]), 0.0))
