"""Queries by the library without a service, for comparison."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np

from sceneprint.formats.artifact import read_geometry, write_geometry
from sceneprint.formats.dataset import FrameReference
from sceneprint.localization import PoseEstimate, localize, views_of_rows
from sceneprint.pipeline import (
    PairMatch,
    Signature,
    associate,
    diversify,
    open_signer,
    prepare,
    retrieve,
    unguided_validations,
)
from sceneprint.places import QueryFrame
from sceneprint.types import Floats, Geometry
from sceneprint_client.api import Answer
from sceneprint_lab.evaluation.pair_run import Clock

#: Matches for comparison: index in the database, and transform row by row.
Matches = list[tuple[int, list[list[float]]]]


class Library:
    """A database in memory with timed stages of a query."""

    def __init__(self, frames: Sequence[FrameReference]) -> None:
        self._signer = open_signer("depth")
        self._signatures: list[Signature] = []
        self._artifacts: list[bytes] = []
        self._poses: list[Floats | None] = []
        for reference in frames:
            frame = reference.read()
            signature, geometry = prepare(frame, self._signer)
            self._signatures.append(signature)
            self._artifacts.append(write_geometry(geometry))
            self._poses.append(frame.pose)

    def ask(self, query: FrameReference) -> tuple[dict[str, float], Matches]:
        """Return the milliseconds of each stage, and the accepted matches."""
        clock = Clock()
        frame = clock.run("decode", query.read)
        signature, seen = clock.run("sign, with geometry", lambda: prepare(frame, self._signer))
        ranking = clock.run(
            "retrieve", lambda: retrieve(signature, self._signatures, self._signer.model)
        )
        selection = clock.run("diversify", lambda: diversify(ranking, self._signatures))
        geometry = read_geometry(write_geometry(seen))  # like the service
        validate = partial(associate, geometry, ranking, selection.indices.tolist(), self._geometry)
        matches = clock.run("validate", lambda: validate(pose_of=self._pose))
        estimate = clock.run("locate", lambda: self._locate(geometry, matches))
        before = unguided_validations(matches)
        if before is not None and estimate is not None and estimate.status != "found":
            matches = validate(validations=before)
        return clock.stages, [
            (match.index, match.validation.T_match_query.tolist())
            for match in matches
            if match.validation.status == "accepted" and match.validation.T_match_query is not None
        ]

    def _geometry(self, index: int) -> Geometry:
        return read_geometry(self._artifacts[index])

    def _pose(self, index: int) -> tuple[str, Floats] | None:
        pose = self._poses[index]
        return None if pose is None else ("", pose)

    def _locate(self, query: Geometry, matches: list[PairMatch]) -> PoseEstimate | None:
        poses = [np.eye(4) if pose is None else pose for pose in self._poses]
        if any(pose is None for pose in self._poses):
            return None
        views = views_of_rows(matches, poses, self._geometry)
        return localize([QueryFrame(query, matches)], poses, None, views)


def accepted(answer: Answer, names: Mapping[str, int]) -> Matches:
    """Return the accepted matches of a service's answer in the format of `Library.ask`."""
    return [
        (names[match.frame_id], match.transform.matrix)
        for match in answer.matches
        if match.validation.status == "accepted" and match.transform is not None
    ]


def are_same(some: Matches, others: Matches) -> bool:
    """Return whether matches are equal, with a tolerance of 0.01 mm.

    A service rounds stored poses, which may change the points in the last step of a refinement and
    thus the transform by some micrometres.
    """
    return [i for i, _ in some] == [i for i, _ in others] and all(
        np.allclose(transform, other, rtol=0, atol=1e-5)
        for (_, transform), (_, other) in zip(some, others, strict=True)
    )
