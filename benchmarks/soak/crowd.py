"""Writers and readers side by side, half of them over HTTP and half in processes of their own.

Every answer is checked afterwards against all that was acknowledged before it was asked for.
"""

from __future__ import annotations

import json
import multiprocessing
import random
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.soak.load import MAP, MODEL, Shot, free_port, service, workers
from benchmarks.soak.writers import read_shots, write_shots
from sceneprint.client import Client
from sceneprint.errors import SceneprintError, UnknownFrame
from sceneprint.pipeline import open_signer, sign
from sceneprint.types import Bytes

#: Frames that are there from the beginning to the end: these are asked for.
STABLE = 40
#: Matches that are asked for.
K = 20
#: Share of a writer's steps in which it deletes a frame of its own.
DELETING = 0.3


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


def crowd(
    folder: Path, shots: list[Shot], n_writers: int, n_readers: int, seconds: float, seed: int
) -> CrowdFigures:
    """Let writers and readers loose on one map.

    Parameters
    ----------
    folder : empty; the data folder and logs come to lie in it
    shots : STABLE ones that stay, and those that the writers share
    n_writers, n_readers : processes; every second one has the engine in it, and no service
    seconds : for how long
    seed : of what they do
    """
    data, file = folder / "crowd", folder / "shots.json"
    write_shots(shots, file)
    with Client.embedded(data) as client:
        client.create_map(MAP, model=MODEL)
        added = [client.upload(MAP, shot.png, shot.meta) for shot in shots[:STABLE]]
        client.wait([one.job_id for one in added])
    stable = {one.frame_id: number for number, one in enumerate(added)}
    port = free_port()
    url = f"http://127.0.0.1:{port}"
    parts = [service(data, port), workers(data, 2)]
    spawn = multiprocessing.get_context("spawn")
    jobs: list[tuple[Callable[..., None], tuple[Any, ...]]] = []
    for i in range(n_writers):
        place = url if i % 2 else str(data)
        own = range(STABLE + i, len(shots), n_writers)
        jobs.append((_write, (place, str(file), own, seconds, seed + i, str(folder / f"w{i}"))))
    for i in range(n_readers):
        place = url if i % 2 else str(data)
        arguments = (place, list(stable), seconds, seed + 100 + i, str(folder / f"r{i}"))
        jobs.append((_read, arguments))
    processes = [spawn.Process(target=do, args=arguments) for do, arguments in jobs]
    try:
        for part in parts:
            part.begin()
        _wait_for(url)
        for process in processes:
            process.start()
        for process in processes:
            process.join(seconds + 300)
    finally:
        codes = [_ended(process) for process in processes]
        for part in parts:
            part.end()
    figures = CrowdFigures(n_writers, n_readers, seconds)
    figures.errors += [f"process {i} ended with {code}" for i, code in enumerate(codes) if code]
    told = [
        [json.loads(line) for line in (folder / f"{kind}{i}").read_text().splitlines()]
        for kind, n in (("w", n_writers), ("r", n_readers))
        for i in range(n)
        if (folder / f"{kind}{i}").exists()
    ]
    logs = [path.read_text() for path in folder.glob("*.log")]
    _check(figures, shots, stable, [one for own in told for one in own], logs)
    return figures


def _wait_for(url: str) -> None:
    with Client(url) as client:
        end = time.monotonic() + 120
        while not client.healthy():
            if time.monotonic() > end:
                raise AssertionError("the service does not start")
            time.sleep(0.1)


def _ended(process: SpawnProcess) -> int | None:
    """Exit code of a process that is gone; None where it never began."""
    if process.pid is None:
        return None
    process.kill()
    process.join()
    code = process.exitcode
    process.close()
    return code


def _client(place: str) -> Client:
    return Client(place) if place.startswith("http://") else Client.embedded(place)


def _write(place: str, file: str, own: range, seconds: float, seed: int, told: str) -> None:
    """Upload and delete frames of one's own, and note what was acknowledged, and when."""
    shots, rng = read_shots(Path(file)), random.Random(seed)
    absent, present = list(own), dict[int, str]()
    with _client(place) as client, Path(told).open("w", buffering=1) as notes:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            begun = time.monotonic()
            try:
                if present and (not absent or rng.random() < DELETING):
                    number = rng.choice(list(present))
                    frame_id, what = present.pop(number), "delete"
                    client.delete_frame(MAP, frame_id)
                    absent.append(number)
                else:
                    number = absent.pop(rng.randrange(len(absent)))
                    shot = shots[number]
                    frame_id, what = client.upload(MAP, shot.png, shot.meta).frame_id, "upload"
                    present[number] = frame_id
            except SceneprintError as error:
                note: dict[str, Any] = {"error": str(error)}
            else:
                note = {"what": what, "number": number, "frame_id": frame_id}
            _note(notes, note | {"begun": begun, "done": time.monotonic()})
            time.sleep(rng.uniform(0, 0.1))


def _read(place: str, stable: list[str], seconds: float, seed: int, told: str) -> None:
    """Ask for stable frames, and note the answers; look at some frame now and then."""
    rng = random.Random(seed)
    with _client(place) as client, Path(told).open("w", buffering=1) as notes:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            begun, asked = time.monotonic(), rng.choice(stable)
            try:
                answer = client.query(MAP, frame_id=asked, stages=("retrieve",), exact=True, k=K)
                with suppress(UnknownFrame):
                    client.frame(MAP, rng.choice(answer.matches).frame_id)
            except SceneprintError as error:
                note: dict[str, Any] = {"error": str(error)}
            else:
                found = [[one.frame_id, one.distance] for one in answer.matches]
                note = {"what": "answer", "asked": asked, "found": found}
            _note(notes, note | {"begun": begun, "done": time.monotonic()})


def _note(notes: Any, note: dict[str, Any]) -> None:
    notes.write(json.dumps(note) + "\n")


def _check(
    figures: CrowdFigures, shots: list[Shot], stable: dict[str, int],
    notes: list[dict[str, Any]], logs: list[str],
) -> None:  # fmt: skip
    """Hold every answer against the signatures, and against what was acknowledged when."""
    figures.errors += [one["error"] for one in notes if "error" in one]
    figures.errors += [
        line for log in logs for line in log.splitlines()
        if '"level": "ERROR"' in line or "Traceback" in line
    ]  # fmt: skip
    figures.locked = sum("database is locked" in text for text in (*figures.errors, *logs))
    numbers, deleted = dict(stable), dict[str, tuple[float, float]]()
    for one in notes:
        if one.get("what") == "upload":
            numbers[one["frame_id"]] = one["number"]
            figures.uploads += 1
        elif one.get("what") == "delete":
            deleted[one["frame_id"]] = (one["begun"], one["done"])
            figures.deletions += 1
    vectors = _signed(shots)
    for one in notes:
        if one.get("what") == "answer":
            figures.answers += 1
            figures.wrong += faults(one, numbers, deleted, stable, vectors)


def _signed(shots: list[Shot]) -> Bytes:
    """Signatures of all shots, by the library alone."""
    from sceneprint.engine.frames import read_upload

    signer = open_signer(MODEL)
    return np.stack([sign(read_upload(one.png, one.meta), signer).vector for one in shots])


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
        if distance != int(np.abs(query - vectors[numbers[frame_id]]).sum()):
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
        near = int(np.abs(query - vectors[number]).sum())
        if frame_id != note["asked"] and near < farthest and frame_id not in names:
            wrong.append(f"{frame_id} at {near} is missing")
    return wrong
