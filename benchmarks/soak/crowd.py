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
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any

from benchmarks.soak.crowd_audit import CrowdFigures, K, check
from benchmarks.soak.kills import is_idle, wait_until
from benchmarks.soak.load import MAP, MODEL, Shot, free_port, service, workers
from benchmarks.soak.writers import read_shots, write_shots
from sceneprint.errors import SceneprintError, UnknownFrame
from sceneprint_client import Client

#: Frames that are there from the beginning to the end: these are asked for.
STABLE = 40
#: Share of a writer's steps in which it deletes a frame of its own.
DELETING = 0.3


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
    parts = [service(data, port, waiting=512), workers(data, 2)]
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
    check(figures, shots, stable, [one for own in told for one in own], logs)
    return figures


def _wait_for(url: str) -> None:
    with Client(url) as client:
        wait_until(lambda: is_idle(client), "the service is ready")


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
