"""What the crowd saw, held against the signatures and against what was acknowledged when."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.soak.load import MODEL, Shot
from sceneprint.pipeline import open_signer, sign
from sceneprint.types import Bytes

#: Matches that are asked for.
K = 20
#: How SQLite says that a writer gave up waiting, and how we do.
LOCKED = ("database is locked", "have waited for long", "has been writing for long")


@dataclass
class CrowdFigures:
    """What came of it.

    Parameters
    ----------
    writers, readers : how many
    seconds : for how long
    uploads, deletions, answers : acknowledged
    errors : of any process, none of which should be: with their texts
    locked : lines of any log with "database is locked"
    wrong : answers with a distance that is not that of the signatures, in a wrong order, without
        a frame that had to be in it, or with one that was deleted before; with what is wrong
    """

    writers: int
    readers: int
    seconds: float
    uploads: int = 0
    deletions: int = 0
    answers: int = 0
    errors: list[str] = field(default_factory=list)
    locked: int = 0
    wrong: list[str] = field(default_factory=list)


def check(
    figures: CrowdFigures, shots: list[Shot], stable: dict[str, int],
    notes: list[dict[str, Any]], logs: list[str],
) -> None:  # fmt: skip
    """Hold every answer against the signatures, and against what was acknowledged when."""
    figures.errors += [one["error"] for one in notes if "error" in one]
    figures.errors += [
        line for log in logs for line in log.splitlines()
        if '"level": "error"' in line or '"level": "critical"' in line or "Traceback" in line
    ]  # fmt: skip
    figures.locked = sum(text.count(sign) for text in (*figures.errors, *logs) for sign in LOCKED)
    numbers, deleted = dict(stable), dict[str, tuple[float, float]]()
    for one in notes:
        if one.get("what") == "upload":
            numbers[one["frame_id"]] = one["number"]
            figures.uploads += 1
        elif one.get("what") == "delete":
            deleted[one["frame_id"]] = (one["begun"], one["done"])
            figures.deletions += 1
    answers = [one for one in notes if one.get("what") == "answer"]
    figures.answers = len(answers)
    vectors = _signed(shots) if answers else np.empty((0, 0), np.uint8)
    for one in answers:
        figures.wrong += faults(one, numbers, deleted, stable, vectors)


def _signed(shots: list[Shot]) -> Bytes:
    """Signatures of all shots, by the library alone."""
    from sceneprint.decoders import LocalDecoders
    from sceneprint.engine.ingest.frame_decoder import read_upload

    signer, decoders = open_signer(MODEL), LocalDecoders(1)
    return np.stack(
        [sign(read_upload(one.png, one.meta, decoders).frame, signer).vector for one in shots]
    )


def faults(
    note: dict[str, Any], numbers: dict[str, int], deleted: dict[str, tuple[float, float]],
    stable: dict[str, int], vectors: Bytes,
) -> list[str]:  # fmt: skip
    """What is wrong with an answer.

    Parameters
    ----------
    note : of a reader: the frame that was asked for, (id, distance) of the matches, the time
    numbers : of the shots, by the ids of their frames
    deleted : when the deletion of a frame was begun and done
    stable : numbers of the frames that are there all the time
    vectors : (n, D) signatures of the shots
    """
    query, found = vectors[stable[note["asked"]]].astype(np.int64), note["found"]
    wrong = []
    for frame_id, distance in found:
        if frame_id not in numbers:
            continue  # its upload was not acknowledged before the end
        if distance != _apart(query, vectors[numbers[frame_id]]):
            wrong.append(f"{frame_id} at {distance}, which is not its distance")
        if frame_id in deleted and deleted[frame_id][1] < note["begun"]:
            wrong.append(f"{frame_id} is found, and was deleted before")
    distances = [distance for _, distance in found]
    if distances != sorted(distances) or len({name for name, _ in found}) != len(found):
        wrong.append("the matches are not in their order, or one is there twice")
    # what is deleted while it is asked for is left out, and nothing takes its place
    meanwhile = sum(
        begun <= note["done"] and done >= note["begun"] for begun, done in deleted.values()
    )
    if len(found) + meanwhile < min(K, len(stable) - 1):
        wrong.append(f"{len(found)} matches, where {meanwhile} can have been deleted meanwhile")
    farthest = distances[-1] if distances else -1
    names = {name for name, _ in found}
    for frame_id, number in stable.items():
        near = _apart(query, vectors[number])
        if frame_id != note["asked"] and near < farthest and frame_id not in names:
            wrong.append(f"{frame_id} at {near} is missing")
    return wrong


def _apart(query: NDArray[np.int64], vector: Bytes) -> int:
    return int(((query - vector) ** 2).sum())
