"""The command `sceneprint demo`: upload, query and evaluate frames through a service."""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Generator, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from selectors import EVENT_READ, DefaultSelector
from tempfile import TemporaryDirectory
from typing import IO, Any

import numpy as np
from tqdm import tqdm

from sceneprint.atomic_files import write_whole
from sceneprint.cli import positive
from sceneprint.cli.options import ended_by_signals
from sceneprint.engine.search.verification import CANDIDATES
from sceneprint.errors import DatasetError, FrameConflict, FrameError, ServiceError, Unreachable
from sceneprint.formats.dataset import (
    Camera,
    FrameReference,
    find_sequences,
    write_depth_png,
    write_intrinsics,
    write_pose,
)
from sceneprint.models import PRESETS, read_model
from sceneprint.pictures import overlay_picture
from sceneprint.settings import Settings
from sceneprint.signing import see
from sceneprint_client import Client, meta_of
from sceneprint_client.api import Added, Answer, JobState
from sceneprint_lab.evaluation.report import FramePlace, answer_rows, decimal, judge_answers

SEED = 11
#: Number of frames of a walk through a room, 3 to 8 cm apart; and indices, in each group of ten
#: frames, of those for the map and of those for queries. A query is 10 to 30 cm from the map's
#: frames.
WALK, TEN, MAP, QUERIES = 100, 10, (0, 2, 4), (7,)
DEPTH_SCALE = 1000.0


def write_building(folder: Path, rooms: int) -> Generator[None]:
    """Write rooms in 7-Scenes layout with split files; yield after each room.

    Parameters
    ----------
    folder : new folder
    rooms : number of rooms
    """
    write = partial(_write_room, folder)
    jobs = min(os.cpu_count() or 1, rooms)
    if jobs == 1:  # a child process would import all modules again
        yield from map(write, range(rooms))
        return
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        yield from pool.map(write, range(rooms))


def _write_room(folder: Path, number: int) -> None:
    """Write a room as a scene that has one sequence for the map and one for the queries."""
    from sceneprint_lab.synth import KINECT, take, trajectory
    from sceneprint_lab.synth.dataset import room_and_rng

    room, rng = room_and_rng(SEED, number)
    scene = folder / f"room-{number}"
    for name in ("seq-01", "seq-02"):
        (scene / name).mkdir(parents=True)
    write_intrinsics(scene, Camera(KINECT, DEPTH_SCALE, along_ray=False))
    (scene / "TrainSplit.txt").write_text("sequence1\n")
    (scene / "TestSplit.txt").write_text("sequence2\n")
    for i, pose in enumerate(trajectory(room, WALK, rng)):
        if i % TEN in MAP + QUERIES:
            run = scene / ("seq-01" if i % TEN in MAP else "seq-02")
            depth = take(room, pose, KINECT, rng)
            write_depth_png(run / f"frame-{i:06d}.depth.png", depth, DEPTH_SCALE)
            write_pose(run / f"frame-{i:06d}.pose.txt", pose)


#: Without split files: share of each sequence for the map, and share for the gap after it.
DATABASE_SHARE, GAP_SHARE = 0.60, 0.05
#: Maximum number of database frames and of query frames, so that the demo takes only minutes.
MOST_DATABASE, MOST_QUERIES = 300, 180


@dataclass(frozen=True, eq=False)
class DemoFrame:
    """A frame of the demo, the parent frame of its pose, and the name of its sequence."""

    parent: str
    session: str
    reference: FrameReference


@dataclass(frozen=True, eq=False)
class Choice:
    """The database frames and the query frames of the demo."""

    database: list[DemoFrame]
    queries: list[DemoFrame]


def choose_frames(path: Path) -> Choice:
    """Return evenly spaced database and query frames, at most MOST_DATABASE and MOST_QUERIES.

    Split files select them if there are any; otherwise, the database is the beginning of each
    sequence, and the queries are its end. Raise DatasetError if there is no sequence, or there are
    too few frames for both uses.
    """
    database: list[DemoFrame] = []
    queries: list[DemoFrame] = []
    sequences = find_sequences(path)
    split = any(sequence.split for sequence in sequences)
    for sequence in sequences:
        frames = [DemoFrame(sequence.parent_frame, sequence.name, f) for f in sequence.frames]
        n = len(frames)
        if split:
            database += frames if sequence.split == "train" else []
            queries += frames if sequence.split == "test" else []
        else:
            database += frames[: round(DATABASE_SHARE * n)]
            queries += frames[round((DATABASE_SHARE + GAP_SHARE) * n) :]
    if not database or not queries:
        raise DatasetError(
            f"{path}: The demo requires frames for the map (found: {len(database)}) and for "
            f"queries (found: {len(queries)}). Use a longer sequence."
        )
    return Choice(_thinned(database, MOST_DATABASE), _thinned(queries, MOST_QUERIES))


def _thinned(frames: Sequence[DemoFrame], most: int) -> list[DemoFrame]:
    """Return at most `most` evenly spaced frames."""
    return list(frames[:: max(-(-len(frames) // most), 1)])


def add_demo(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint demo`."""
    command.add_argument("--out", type=Path, default=Path("demo"), metavar="DIR")
    command.add_argument(
        "--dataset", type=Path, metavar="PATH",
        help="your own frames, in any layout that `sign` reads",
    )  # fmt: skip
    command.add_argument(
        "--model", choices=PRESETS, default=PRESETS[0], help=f"default: {PRESETS[0]}"
    )
    command.add_argument(
        "--workers", type=positive, default=os.cpu_count() or 1, metavar="N",
        help="number of worker processes",
    )  # fmt: skip
    command.add_argument("--rooms", type=positive, default=3, help=argparse.SUPPRESS)
    command.set_defaults(run=run_demo)


def run_demo(options: argparse.Namespace) -> int:
    """Start a service with an empty folder, upload the frames of a small synthetic building (or
    of --dataset) to a map, query it with other frames, print the paper's table with true pose
    errors, and draw a match. The service and its data are removed at the end.
    """
    from sceneprint.cli.preparation import prepare_presets
    from sceneprint_client import Client

    options.out.mkdir(parents=True, exist_ok=True)
    begun = time.perf_counter()
    with ended_by_signals(), TemporaryDirectory(prefix="sceneprint-demo-") as temporary:
        folder = Path(temporary)
        choice = choose_frames(options.dataset or _building(folder / "building", options.rooms))
        prepare_presets(Settings())
        (folder / "data").mkdir()
        with serving(folder / "data", options.workers) as url, Client(url) as client:
            print(f"service: {url}, empty data folder, {options.workers} worker processes")
            indexed = fill(client, options.model, choice)
            queries = run_queries(client, choice)
        report(indexed, queries)
        draw(indexed, queries, options.model, options.out)
    print(f"whole demo: {time.perf_counter() - begun:.1f} s")
    print(
        "next: `sceneprint serve`; then, in another terminal, `sceneprint upload MAP PATH` and "
        "`sceneprint query MAP PATH` with your own frames; the dashboard is at "
        "http://127.0.0.1:8008/dashboard"
    )
    return 0


def _building(folder: Path, rooms: int) -> Path:
    """Write a synthetic building while showing a progress bar; return its folder."""
    start = time.perf_counter()
    # Close the generator before the folder is removed, because its processes write to the folder.
    with closing(write_building(folder, rooms)) as written:
        for _ in tqdm(written, total=rooms, desc="synthetic building", unit="room", disable=None):
            pass
    print(f"synthetic building: {rooms} rooms in {time.perf_counter() - start:.1f} s")
    return folder


DEMO_MAP = "demo"
#: Number of concurrent uploads.
PARALLEL = 4
#: Errors with a single frame, which do not stop the demo.
_OF_FRAME = (FrameError, FrameConflict)


@dataclass(frozen=True, eq=False)
class DemoQuery:
    """A query, its answers without and with diversification, and the seconds for the second."""

    chosen: DemoFrame
    ranked: Answer
    diverse: Answer
    seconds: float


def fill(client: Client, model: str, choice: Choice) -> dict[str, DemoFrame]:
    """Create the demo's map, upload the database to it, and wait until all frames are signed.

    Frames that are refused or cannot be signed are printed and skipped.

    Returns
    -------
    indexed : indexed frames, by id

    Raises
    ------
    DatasetError : If no frame could be signed
    ServiceError : If a frame was not signed in time
    """
    client.create_map(DEMO_MAP, model=model)
    indexed: dict[str, DemoFrame] = {}
    jobs = []
    start = time.perf_counter()
    pool = ThreadPoolExecutor(PARALLEL)
    try:
        uploads = [(frame, pool.submit(_upload, client, frame)) for frame in choice.database]
        for frame, upload in tqdm(uploads, desc="upload", unit="frame", disable=None):
            try:
                added = upload.result()
            except _OF_FRAME as error:
                tqdm.write(f"skipped: {frame.reference.name}: {error}")
                continue
            indexed[added.frame_id] = frame
            jobs.append(added.job_id)
    finally:  # after an error, cancel the pending uploads
        pool.shutdown(cancel_futures=True)
    with tqdm(total=len(jobs), desc="sign", unit="frame", disable=None) as bar:

        def progress(over: int, _total: int) -> None:
            bar.update(over - bar.n)

        done = client.wait(jobs, progress=progress)
    late = sum(not job.state.over for job in done)
    if late:  # queries could match these frames, which are not in `indexed`
        raise ServiceError(
            f"{late} of {len(done)} map frames were not signed in time. Run the demo with more "
            "--workers or a shorter --dataset."
        )
    for job in done:
        if job.state != JobState.SUCCEEDED and job.frame_id in indexed:
            print(f"skipped: {indexed.pop(job.frame_id).reference.name}: {job.error}")
    if not indexed:
        raise DatasetError("No map frame could be signed. The lines above give the reasons.")
    seconds = time.perf_counter() - start
    print(
        f"map: {len(indexed)} of {len(choice.database)} frames uploaded, signed and indexed in "
        f"{seconds:.1f} s, {len(indexed) / seconds:.1f} a second"
    )
    return indexed


def run_queries(client: Client, choice: Choice) -> list[DemoQuery]:
    """Query each frame (no pose), without and with diversification; return the answered queries."""
    answered, begun = [], time.perf_counter()
    for frame in tqdm(choice.queries, desc="query", unit="frame", disable=None):
        meta = meta_of(frame.reference, with_pose=False)  # a lost robot has no pose
        path = frame.reference.path
        try:
            # the same number of candidates as in `sceneprint evaluate`
            ranked = client.query(
                DEMO_MAP, path, meta, k=CANDIDATES, stages=("retrieve", "validate")
            )
            start = time.perf_counter()
            diverse = client.query(DEMO_MAP, path, meta, k=CANDIDATES)
        except FrameError as error:
            tqdm.write(f"skipped: {frame.reference.name}: {error}")
            continue
        answered.append(DemoQuery(frame, ranked, diverse, time.perf_counter() - start))
    print(f"sent: {2 * len(answered)} queries over HTTP in {time.perf_counter() - begun:.1f} s")
    return answered


def _upload(client: Client, frame: DemoFrame) -> Added:
    meta = meta_of(frame.reference, session=frame.session, parent_frame=frame.parent)
    return client.upload(DEMO_MAP, frame.reference.path, meta)


_NAMES = {
    "R": "R    nearest frame",
    "VR": "VR   validated of R",
    "DR": "DR   diverse frames",
    "VDR": "VDR  validated of DR",
    "pose_average": "pose of the answer",
}


def report(indexed: Mapping[str, DemoFrame], queries: Sequence[DemoQuery]) -> None:
    """Print the statuses, the table (if all true poses are known), and median durations."""
    counts = Counter(query.diverse.status for query in queries)
    states = ", ".join(f"{count} {status}" for status, count in sorted(counts.items()))
    print(f"queries: {len(queries)}: {states or 'none could be sent'}")
    truths = [(query, place_of(query.chosen)) for query in queries]
    places = {key: place for key, f in indexed.items() if (place := place_of(f)) is not None}
    judged = [judge_answers(t, query.ranked, query.diverse, places) for query, t in truths
              if t is not None and len(places) == len(indexed)]  # fmt: skip
    if judged and len(judged) == len(queries):
        print(*table(answer_rows(judged)), sep="\n")
    else:
        print("no table: the true pose of every frame is required")
    if queries:
        medians = [
            f"{stage} {statistics.median(q.diverse.milliseconds[stage] for q in queries):.0f}"
            for stage in queries[0].diverse.milliseconds
            if stage != "total"
        ]
        whole = 1e3 * statistics.median(query.seconds for query in queries)
        print(f"a query over HTTP: {whole:.0f} ms (median; {', '.join(medians)})")


def table(rows: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return a header and a line for each row of `_NAMES`, all of which `rows` must contain.

    The figures are those of `answer_rows`; median distances are printed in centimetres.
    """
    lines = [
        f"{'first answer within':26}{'5cm/5deg':>10}{'10cm/10deg':>12}{'median cm':>11}{'deg':>7}"
        f"{'first five: m from the query':>32}"
    ]
    for row, name in _NAMES.items():
        figures = rows[row]
        metres, spread = figures["median_translation_m"], figures["spread_mean_m"]
        line = (
            f"{name:26}{decimal(figures['within_5cm_5deg']):>10}"
            f"{decimal(figures['within_10cm_10deg']):>12}"
            f"{decimal(metres if metres is None else 100 * metres, 1):>11}"
            f"{decimal(figures['median_rotation_deg'], 2):>7}"
        )
        if spread is not None:
            both = f"{spread:.2f} +- {figures['spread_std_m']:.2f}"
            line += f"{both:>32}"
        lines.append(line)
    return lines


def draw(
    indexed: Mapping[str, DemoFrame], queries: Sequence[DemoQuery], preset: str, out: Path
) -> None:
    """Draw the accepted first match with the largest rotation, if any, into OUT/overlay.png."""
    accepted = [
        (query, match, np.array(match.transform.matrix))
        for query in queries
        for match in query.diverse.matches[:1]
        if match.validation.status == "accepted" and match.transform is not None
    ]
    if not accepted:
        print("no picture: no match was accepted")
        return
    best, match, transform = min(accepted, key=lambda entry: entry[2][:3, :3].trace())
    parameters = read_model(preset).parameters
    query, database = best.chosen.reference, indexed[match.frame_id].reference
    title = f"{query.name} in {database.name}: {match.validation.overlap:.0%} of the surfaces agree"
    picture = overlay_picture(
        see(query.read(), parameters), see(database.read(), parameters), transform,
        title.encode("ascii", "replace").decode(),
    )  # fmt: skip
    write_whole(out / "overlay.png", picture)
    print(f"picture: {out / 'overlay.png'}")


def place_of(frame: DemoFrame) -> FramePlace | None:
    """Return the true place of a frame, or None if it is unknown."""
    pose = frame.reference.pose
    return None if pose is None else FramePlace(frame.parent, pose)


#: Time limits for the start of the service, including compilation, and for its end, seconds.
START_S, STOP_S = 120.0, 30.0
_READY = "sceneprint: serving "


@contextmanager
def serving(data: Path, workers: int) -> Iterator[str]:
    """Run `sceneprint serve` on a free loopback port during the `with` block.

    Parameters
    ----------
    data : folder for the database, blobs and log
    workers : number of processes that sign frames

    Yields
    ------
    url : URL of the ready service

    Raises
    ------
    Unreachable : If the service did not start; the message includes the end of its log
    """
    log = data / "service.log"
    arguments = ["--port", "0", "--data", str(data), "--workers", str(workers)]
    with log.open("wb") as errors:
        process = subprocess.Popen(
            [sys.executable, "-m", "sceneprint", "serve", *arguments], stdout=subprocess.PIPE,
            stderr=errors, bufsize=0,
        )  # fmt: skip
    try:
        line = "" if process.stdout is None else _first_line(process.stdout)
        if not line.startswith(_READY):
            last = log.read_text(errors="replace").strip().splitlines()[-1:]
            raise Unreachable(
                f"The service did not start: {' '.join(last) or 'it printed nothing'}. Run "
                "`sceneprint doctor` to see what is missing."
            )
        yield line.removeprefix(_READY).strip()
    finally:
        process.terminate()
        try:
            with suppress(subprocess.TimeoutExpired):
                process.wait(STOP_S)
        finally:  # Ctrl-C may end the wait
            process.kill()
            process.wait()
            if process.stdout is not None:
                process.stdout.close()


def _first_line(pipe: IO[bytes]) -> str:
    """Return the first line from a pipe, or the part of it before the other end was closed.

    Raise Unreachable if no line arrives in time.
    """
    data, until = b"", time.monotonic() + START_S
    with DefaultSelector() as selector:
        selector.register(pipe, EVENT_READ)
        while b"\n" not in data:
            if not selector.select(max(until - time.monotonic(), 0.0)):
                raise Unreachable(
                    f"The service did not start within {START_S:g} s. "
                    "Run `sceneprint doctor` to see what is missing, or try again."
                )
            more = os.read(pipe.fileno(), 4096)  # `read` returns a partial line at once
            if not more:
                break
            data += more
    return data.partition(b"\n")[0].decode(errors="replace")
