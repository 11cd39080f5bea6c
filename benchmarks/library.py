"""The same query by the library alone, for the service to be compared with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from benchmarks.encode import Clock
from sceneprint.formats.artifact import read_geometry, write_geometry
from sceneprint.formats.dataset import FrameReference
from sceneprint.matches import associate
from sceneprint.pipeline import Signature, diversify, open_signer, prepare, retrieve
from sceneprint_client.api import Answer

#: What a match is compared by: place in the database, and its transform row by row.
Matches = list[tuple[int, list[list[float]]]]


class Library:
    """A database in memory, asked stage by stage.

    Parameters
    ----------
    frames : of the database
    """

    def __init__(self, frames: Sequence[FrameReference]) -> None:
        self._signer = open_signer("depth")
        self._signatures: list[Signature] = []
        self._artifacts: list[bytes] = []
        for frame in frames:
            signature, geometry = prepare(frame.read(), self._signer)
            self._signatures.append(signature)
            self._artifacts.append(write_geometry(geometry))

    def ask(self, query: FrameReference, k: int = 5) -> tuple[dict[str, float], Matches]:
        """Milliseconds of each stage, and the accepted matches."""
        clock = Clock()
        frame = clock.run("decode", query.read)
        signature, seen = clock.run("sign, with geometry", lambda: prepare(frame, self._signer))
        ranking = clock.run(
            "retrieve", lambda: retrieve(signature, self._signatures, self._signer.model)
        )
        selection = clock.run("diversify", lambda: diversify(ranking, self._signatures))
        geometry = read_geometry(write_geometry(seen))  # as both have it
        matches = clock.run(
            "validate",
            lambda: associate(
                geometry,
                ranking,
                selection.indices.tolist(),
                lambda i: read_geometry(self._artifacts[i]),
                k,
            ),
        )
        found = [
            (match.index, match.validation.T_match_query.tolist())
            for match in matches
            if match.validation.status == "accepted" and match.validation.T_match_query is not None
        ]
        return clock.stages, found


def accepted(answer: Answer, names: Mapping[str, int]) -> Matches:
    """The accepted matches of a service's answer, in the terms of `Library.ask`."""
    return [
        (names[match.frame_id], match.transform.matrix)
        for match in answer.matches
        if match.validation.status == "accepted" and match.transform is not None
    ]
