"""What an evaluation remembers of a query: plain data, from which every figure is worked out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.association import preferred
from sceneprint.geometry.rigid import difference
from sceneprint.geometry.validation import Validation
from sceneprint.types import Bytes, Floats

#: Views of a query that are averaged, counted and drawn.
VIEWS = 5
#: A transform between rooms' frames is right within these metres and degrees.
RIGHT = (0.10, 10.0)


@dataclass(frozen=True, eq=False)
class Member:
    """A frame that takes part and could be signed.

    Parameters
    ----------
    number : of its files in the store
    name : unique in the evaluation
    scene : its parent frame
    pose : (4, 4) T_parent_sensor
    signature : (n,) uint8
    """

    number: int
    name: str
    scene: str
    pose: Floats
    signature: Bytes


@dataclass(frozen=True)
class Error:
    """How far an estimated pose lies from the true one; infinite where there is none."""

    metres: float = math.inf
    radians: float = math.inf

    def within(self, metres: float, degrees: float) -> bool:
        """Whether both parts are at most these."""
        return self.metres <= metres and self.radians <= math.radians(degrees)


@dataclass(frozen=True, eq=False)
class Pair:
    """A query validated against a database frame.

    Parameters
    ----------
    match : index of the database frame
    scene : of the database frame
    validation : what came of it
    same_scene : whether the match has the query's parent frame
    error : of T_match_query; infinite for another scene
    bound : error of refinement started at the true pose; None where it was not asked for
    overlap_mean, overlap_least : as in `Overlaps`; 0 for another scene
    milliseconds : that validation took
    limits : metres and degrees to which its transform is to be right
    """

    match: int
    scene: str
    validation: Validation
    same_scene: bool
    error: Error
    bound: Error | None
    overlap_mean: float
    overlap_least: float
    milliseconds: float
    limits: tuple[float, float] = RIGHT

    @property
    def accepted(self) -> bool:
        """Whether the match was accepted, strong or weak."""
        return self.validation.status == "accepted"

    @property
    def right(self) -> bool:
        """Whether the transform is right to its limits, accepted or not."""
        return self.error.within(*self.limits)


@dataclass(frozen=True, eq=False)
class Outcome:
    """All that is known of a query when the evaluation is done.

    Parameters
    ----------
    name, scene, pose : of the query
    allowed : (A,) rising indices of the database frames that it may find
    present : whether one of them is of the query's scene
    overlap_mean, overlap_least : (A,) with those, as in `Overlaps`
    ranking : R, indices of database frames, nearest first
    distances : (|R|,) of the ranking, as of `cross_distances`
    selection : C, in the order of R
    pairs : by index of the database frame: the first of R and all of C
    candidates : how many of R were validated
    average, average_of_ranking : errors of the pose averaged over accepted views of C and of R
    average_bound : error of the average of the same views of C, each refined from the true pose
    milliseconds : of ranking, of the selection, of averaging
    """

    name: str
    scene: str
    pose: Floats
    allowed: NDArray[np.intp]
    present: bool
    overlap_mean: Floats
    overlap_least: Floats
    ranking: list[int]
    distances: NDArray[np.int64]
    selection: list[int]
    pairs: dict[int, Pair]
    candidates: int
    average: Error = Error()
    average_of_ranking: Error = Error()
    average_bound: Error = Error()
    milliseconds: dict[str, float] = field(default_factory=dict)

    def overlap_of(self, match: int) -> float:
        """Overlap with a database frame, by the definition of retrieval."""
        return float(self.overlap_mean[np.searchsorted(self.allowed, match)])

    def views(self, of: str) -> list[Pair]:
        """The pairs of a row in the order in which it answers with them.

        Parameters
        ----------
        of : "R" and "DR": as ranked, accepted or not; "VR" and "VDR": accepted ones, strong
            before weak
        """
        first = self.ranking[: self.candidates] if of in ("R", "VR") else self.selection
        pairs = [self.pairs[match] for match in first]
        return pairs if of in ("R", "DR") else in_preferred_order(pairs)

    def tried(self) -> list[Pair]:
        """All pairs of C as `associate` gives them: VDR's views, then the others as ranked."""
        first = self.views("VDR")
        return first + [pair for pair in self.views("DR") if not pair.accepted]


def in_preferred_order(pairs: Sequence[Pair]) -> list[Pair]:
    """Accepted pairs, strong ones first: the order in which they are believed."""
    return [pairs[i] for i in preferred([pair.validation for pair in pairs])]


def pose_error(T: Floats, truth: Floats) -> Error:
    """How far apart two (4, 4) rigid transforms between the same two frames are."""
    return Error(*difference(T, truth))
