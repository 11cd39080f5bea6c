"""What HTTP and the store add to a query, and whether the service stays awake under load.

`python -m benchmarks.service [DATASET]` measures this row alone.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.context import SpawnProcess
from multiprocessing.queues import Queue
from multiprocessing.sharedctypes import Synchronized
from multiprocessing.synchronize import Barrier
from multiprocessing.synchronize import Event as EventType
from pathlib import Path
from queue import Empty
from tempfile import TemporaryDirectory

import httpx
import numpy as np
from tqdm import tqdm

from benchmarks.library import Library, accepted, are_same
from benchmarks.machine import processor_seconds
from benchmarks.readiness import MAP, fill_map
from sceneprint.formats.dataset import FrameReference, find_sequences
from sceneprint_client import Client
from sceneprint_lab.cli.demo import serving, write_building

#: Processes that query at once, for their throughput beside that of one.
CROWD = 8
#: Processes that query at once while a worker signs, and for how long.
CLIENTS, SECONDS = 4, 20.0
#: Requests a second to /healthz.
RATE = 50.0
#: Seconds that a process of the load may take to end.
END_S = 60.0


@dataclass(frozen=True)
class Throughput:
    """Queries of some clients at once.

    `per_second`: of all together. `p50`, `p99`: milliseconds to an answer. `least`: answers that
    the slowest client got, over those of the mean client.
    """

    per_second: float
    p50: float
    p99: float
    least: float


@dataclass(frozen=True)
class ServiceFigures:
    """Medians in milliseconds; `ratio` is the median of the ratios of single queries.

    `stages`: of the library, one after the other. `http`, `cpu`: lower quartile, median and upper
    quartile, until the answer and of the service's processors. `idle`, `loaded`: p50 and p99 of
    /healthz. `throughput`: by number of clients.
    """

    frames: int
    queries: int
    stages: dict[str, float]
    library: float
    http: tuple[float, float, float]
    cpu: tuple[float, float, float]
    ratio: float
    idle: tuple[float, float]
    loaded: tuple[float, float]
    queries_per_second: float
    throughput: dict[int, Throughput]

    @property
    def gain(self) -> float:
        """Queries a second of a crowd over those of one client."""
        return self.throughput[CROWD].per_second / self.throughput[1].per_second


def measure(
    frames: Sequence[FrameReference], n_queries: int = 20, seconds: float = SECONDS,
    map_frames: int = 0,
) -> ServiceFigures:  # fmt: skip
    """Fill a map with all but a few frames, and look those up over HTTP and with the library.

    Parameters
    ----------
    frames : of a data set
    n_queries : how many are looked up, spread among the others
    seconds : how long the service is kept under load
    map_frames : of the map, if `frames` are fewer: the rest is random. As R grows with the map,
        answers are then not compared with the library's

    Raises
    ------
    AssertionError : service and library answer differently, and so do not do the same work.
    """
    asked = {int(i) for i in np.linspace(1, len(frames) - 2, n_queries)}
    database = [frame for i, frame in enumerate(frames) if i not in asked]
    queries = [frames[i] for i in sorted(asked)]
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory()))
        fill_map(folder, max(map_frames - len(database), 0), "depth")
        url = stack.enter_context(serving(folder, workers=1))
        client = stack.enter_context(Client(url))
        added = [client.upload(MAP, one) for one in tqdm(database, "upload", disable=None)]
        library = Library(database)
        client.wait([one.job_id for one in added])
        names = {one.frame_id: i for i, one in enumerate(added)}
        client.query(MAP, queries[0])  # warm
        library.ask(queries[0])
        http, cpu, stages = [], [], []
        for frame in queries:  # in turn, so that both meet the same machine
            start, used = time.perf_counter(), processor_seconds(folder, "serve")
            answer = client.query(MAP, frame)
            http.append(1e3 * (time.perf_counter() - start))
            cpu.append(1e3 * (processor_seconds(folder, "serve") - used))
            spent, expected = library.ask(frame)
            stages.append(spent)
            assert map_frames > len(database) or are_same(accepted(answer, names), expected)
        idle = _healthz(url, min(seconds, 3.0))
        throughput = {n: _throughput(url, queries, n, seconds) for n in (1, CROWD)}
        loaded, rate = _loaded(url, queries, seconds)
    sums = [sum(one.values()) for one in stages]
    return ServiceFigures(
        frames=max(map_frames, len(database)),
        queries=len(queries),
        stages={name: statistics.median(one[name] for one in stages) for name in stages[0]},
        library=statistics.median(sums),
        http=_quartiles(http),
        cpu=_quartiles(cpu),
        ratio=statistics.median(h / s for h, s in zip(http, sums, strict=True)),
        idle=idle,
        loaded=loaded,
        queries_per_second=rate,
        throughput=throughput,
    )


def _quartiles(values: Sequence[float]) -> tuple[float, float, float]:
    lower, median, upper = np.percentile(values, (25, 50, 75)).tolist()
    return lower, median, upper


def _throughput(
    url: str, frames: Sequence[FrameReference], clients: int, seconds: float
) -> Throughput:
    """Queries of some clients, each of which asks again when it is answered.

    Raises
    ------
    RuntimeError : a client died, and the figures would be of fewer.
    """
    context = get_context("spawn")
    ready, answers = context.Barrier(clients), context.Queue()
    crowd = [
        context.Process(target=_time_queries, args=(url, list(frames), seconds, ready, answers, i))
        for i in range(clients)
    ]
    try:
        for one in crowd:
            one.start()
        taken: list[list[float]] = []
        while len(taken) < clients:
            _see_alive([one for one in crowd if one.exitcode])
            with suppress(Empty):
                taken.append(answers.get(timeout=1.0))
    finally:
        for one in crowd:
            one.join(END_S)
            one.terminate()
    counts = [len(own) for own in taken]
    p50, p99 = np.percentile([ms for own in taken for ms in own], (50, 99)).tolist()
    return Throughput(sum(counts) / seconds, p50, p99, min(counts) / (sum(counts) / clients))


def _time_queries(
    url: str, frames: Sequence[FrameReference], seconds: float, ready: Barrier,
    answers: Queue[list[float]], place: int,
) -> None:  # fmt: skip
    """Ask for frames in turn, beginning with one of its own; milliseconds of each answer."""
    taken: list[float] = []
    with Client(url) as client:
        client.query(MAP, frames[place % len(frames)])
        ready.wait()
        until = time.perf_counter() + seconds
        while (start := time.perf_counter()) < until:
            client.query(MAP, frames[(place + len(taken)) % len(frames)])
            taken.append(1e3 * (time.perf_counter() - start))
    answers.put(taken)


def _healthz(url: str, seconds: float) -> tuple[float, float]:
    """p50 and p99 of /healthz, asked at a steady rate, milliseconds."""
    taken = []
    with httpx.Client(base_url=url) as client:
        until = time.perf_counter() + seconds
        while (start := time.perf_counter()) < until:
            assert client.get("/healthz").status_code == 200
            taken.append(1e3 * (time.perf_counter() - start))
            time.sleep(max(1 / RATE - (time.perf_counter() - start), 0.0))
    p50, p99 = np.percentile(taken, (50, 99)).tolist()
    return p50, p99


def _loaded(
    url: str, queries: Sequence[FrameReference], seconds: float
) -> tuple[tuple[float, float], float]:
    """/healthz while clients query and a worker signs, and queries answered a second.

    Raises
    ------
    RuntimeError : a process of the load died, and the figures would be of less.
    """
    context = get_context("spawn")
    stop, done = context.Event(), context.Value("i", 0)
    begun = [context.Event() for _ in range(CLIENTS)]
    load = [
        context.Process(target=_query_on, args=(url, list(queries), stop, done, one))
        for one in begun
    ]
    load.append(context.Process(target=_upload_on, args=(url, list(queries), stop)))
    try:
        for one in load:
            one.start()
        for event in begun:  # until all are at work
            while not event.wait(0.1):
                _see_alive(load)
        begin, counted = time.perf_counter(), done.value
        figures = _healthz(url, seconds)
        rate = (done.value - counted) / (time.perf_counter() - begin)
        _see_alive(load)
    finally:
        _end(load, stop)
    return figures, rate


def _see_alive(load: Sequence[SpawnProcess]) -> None:
    codes = [one.exitcode for one in load if not one.is_alive()]
    if codes:
        raise RuntimeError(f"{len(codes)} of {len(load)} processes of the load died: {codes}")


def _end(load: Sequence[SpawnProcess], stop: EventType) -> None:
    """Let all end, and end those that do not."""
    stop.set()
    until = time.monotonic() + END_S
    for one in load:
        if one.pid is not None:  # it was started
            one.join(max(until - time.monotonic(), 0.0))
            if one.is_alive():
                one.terminate()
                one.join()


def _query_on(
    url: str, frames: Sequence[FrameReference], stop: EventType, done: Synchronized[int],
    begun: EventType,
) -> None:  # fmt: skip
    with Client(url) as client:
        while not stop.is_set():
            for frame in frames:
                if stop.is_set():
                    return
                client.query(MAP, frame)
                with done.get_lock():
                    done.value += 1
                begun.set()


def _upload_on(url: str, frames: Sequence[FrameReference], stop: EventType) -> None:
    """Keep the worker busy: the same frames in one map after another."""
    with Client(url) as client:
        for number in range(10_000):
            client.create_map(f"load-{number}")
            jobs = [client.upload(f"load-{number}", frame).job_id for frame in frames]
            client.wait(jobs)
            if stop.is_set():
                return


def table(f: ServiceFigures) -> list[str]:
    """The figures as lines of Markdown."""
    return [
        f"### A query over HTTP, {f.frames:,} frames in the map, k = 5, all stages, warm: "
        f"median of {f.queries}",
        "",
        "| | ms |",
        "|---|--:|",
        *(f"| {stage} | {ms:.1f} |" for stage, ms in f.stages.items()),
        f"| **library, sum** | **{f.library:.1f}** |",
        f"| **over HTTP** | **{_spread(f.http)}** |",
        f"| **processor time of the service** | **{_spread(f.cpu)}** |",
        f"| **HTTP / library** | **{f.ratio:.2f}** |",
        f"| /healthz, idle: p50, p99 | {f.idle[0]:.1f}, {f.idle[1]:.1f} |",
        f"| /healthz while {CLIENTS} clients query and a worker signs: p50, p99 | "
        f"{f.loaded[0]:.1f}, {f.loaded[1]:.1f} |",
        "",
        f"Queries answered meanwhile: {f.queries_per_second:.1f} a second.",
        "",
        "| clients at once | queries a second | p50, ms | p99, ms | slowest client / mean |",
        "|--:|--:|--:|--:|--:|",
        *(
            f"| {n} | {one.per_second:.1f} | {one.p50:.0f} | {one.p99:.0f} | {one.least:.2f} |"
            for n, one in f.throughput.items()
        ),
        "",
        f"{CROWD} clients are answered **{f.gain:.2f}** times as often as one.",
        "",
    ]


def _spread(quartiles: tuple[float, float, float]) -> str:
    return "{1:.1f} ({0:.1f} to {2:.1f})".format(*quartiles)


@contextmanager
def frames_of(dataset: Path | None, most: int = 320) -> Iterator[list[FrameReference]]:
    """Frames of a data set, or of a synthetic building that is gone afterwards, evenly thinned."""
    with TemporaryDirectory(prefix="sceneprint-bench-") as temporary:
        if dataset is None:
            dataset = Path(temporary) / "building"
            for _ in tqdm(write_building(dataset, 6), "synthetic rooms", 6, disable=None):
                pass
        found = [frame for sequence in find_sequences(dataset) for frame in sequence.frames]
        yield found[:: max(len(found) // most, 1)][:most]


def main() -> int:
    """Measure this row alone."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path, nargs="?")
    parser.add_argument("--frames", type=int, default=320)
    parser.add_argument("--map-frames", type=int, default=0, help="of the map, random ones too")
    options = parser.parse_args()
    with frames_of(options.dataset, options.frames) as frames:
        print(*table(measure(frames, map_frames=options.map_frames)), sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
