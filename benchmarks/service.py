"""Measure the overhead of a service in a query, and concurrent queries."""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from multiprocessing import get_context
from multiprocessing.synchronize import Barrier
from pathlib import Path
from tempfile import TemporaryDirectory

import httpx
import numpy as np
from tqdm import tqdm

from benchmarks.encode import stage_rows
from benchmarks.library import Library, accepted, are_same
from benchmarks.machine import processor_ns, sum_over_processes
from benchmarks.readiness import MAP, fill_map
from benchmarks.waiting import PATIENCE_S
from sceneprint.formats.dataset import FrameReference
from sceneprint_client import Client
from sceneprint_lab.cli.demo import serving

#: Number of concurrent clients for the throughput, and duration of each load, seconds.
CROWD, SECONDS = 8, 20.0
#: Number of concurrent clients while a worker signs, and requests per second to /healthz.
CLIENTS, RATE = 4, 50.0


def measure(
    frames: Sequence[FrameReference], map_frames: int = 0, n_queries: int = 20
) -> list[str]:
    """Query frames over HTTP and with the library; return the tables.

    Raise AssertionError if the answers of service and library differ, so the times are not
    comparable.

    Parameters
    ----------
    map_frames : number of frames of the map; if `frames` are fewer, random frames are added and
        answers are not compared with those of the library, because R grows with the map
    n_queries : number of queries
    """
    places = {int(i) for i in np.linspace(1, len(frames) - 2, n_queries)}
    database = [frame for i, frame in enumerate(frames) if i not in places]
    queries = [frames[i] for i in sorted(places)]
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory()))
        fill_map(folder, max(map_frames - len(database), 0), "depth")
        url = stack.enter_context(serving(folder, workers=1))
        client = stack.enter_context(Client(url))
        added = [client.upload(MAP, frame) for frame in tqdm(database, "upload", disable=None)]
        library = Library(database)
        client.wait([upload.job_id for upload in added])
        names = {upload.frame_id: i for i, upload in enumerate(added)}
        client.query(MAP, queries[0])  # warm-up
        library.ask(queries[0])
        http, cpu, stages = [], [], []
        for frame in queries:  # alternate, so that both run under the same load
            start, used = time.perf_counter(), sum_over_processes(processor_ns, folder, "serve")
            answer = client.query(MAP, frame)
            http.append(1e3 * (time.perf_counter() - start))
            cpu.append(1e-6 * (sum_over_processes(processor_ns, folder, "serve") - used))
            spent, expected = library.ask(frame)
            stages.append(spent)
            assert map_frames > len(database) or are_same(accepted(answer, names), expected)
        idle = _healthz(url, 3.0)
        crowds = {n: _load(url, queries, n, uploads=False)[0] for n in (1, CROWD)}
        meanwhile, loaded = _load(url, queries, CLIENTS, uploads=True)
    sums = [sum(times.values()) for times in stages]
    ratio = statistics.median(h / s for h, s in zip(http, sums, strict=True))
    rates = {n: sum(map(len, crowd)) / SECONDS for n, crowd in crowds.items()}
    return [
        f"### A query over HTTP, {max(map_frames, len(database)):,} frames in the map, k = 5, all "
        f"stages, warm: median of {len(queries)}",
        "", "| | ms |", "|---|--:|", *stage_rows(stages),
        f"| **library, sum** | **{statistics.median(sums):.1f}** |",
        f"| **over HTTP** | **{_spread(http)}** |",
        f"| **processor time of the service** | **{_spread(cpu)}** |",
        f"| **HTTP / library** | **{ratio:.2f}** |",
        f"| /healthz, idle: p50, p99 | {idle[0]:.1f}, {idle[1]:.1f} |",
        f"| /healthz while {CLIENTS} clients query and a worker signs: p50, p99 | "
        f"{loaded[0]:.1f}, {loaded[1]:.1f} |",
        "", f"Answered queries: {sum(map(len, meanwhile)) / SECONDS:.1f} per second.", "",
        "| concurrent clients | queries per second | p50, ms | p99, ms | slowest client / mean |",
        "|--:|--:|--:|--:|--:|", *(_row(n, crowd) for n, crowd in crowds.items()), "",
        f"{CROWD} clients receive **{rates[CROWD] / rates[1]:.2f}** times as many answers as one.",
        "",
    ]  # fmt: skip


def _row(n: int, crowd: Sequence[Sequence[float]]) -> str:
    counts = [len(own) for own in crowd]
    p50, p99 = np.percentile([ms for own in crowd for ms in own], (50, 99))
    least = min(counts) / (sum(counts) / n)
    return f"| {n} | {sum(counts) / SECONDS:.1f} | {p50:.0f} | {p99:.0f} | {least:.2f} |"


def _spread(values: Sequence[float]) -> str:
    lower, median, upper = np.percentile(values, (25, 50, 75))
    return f"{median:.1f} ({lower:.1f} to {upper:.1f})"


def _load(
    url: str, frames: Sequence[FrameReference], clients: int, *, uploads: bool
) -> tuple[list[list[float]], tuple[float, float]]:
    """Let clients query concurrently, and a worker sign if `uploads`.

    Returns
    -------
    answers : milliseconds of each answer, by client
    healthz : p50 and p99 of /healthz during the load
    """
    context = get_context("spawn")
    n = clients + uploads
    barrier = context.Barrier(n + 1)
    with ProcessPoolExecutor(n, context, _join, (barrier,)) as pool:
        work = [pool.submit(_time_queries, url, list(frames), i) for i in range(clients)]
        if uploads:
            uploading = pool.submit(_upload, url, list(frames))
        barrier.wait(PATIENCE_S)
        healthz = _healthz(url, SECONDS)
        answers = [future.result() for future in work]
        if uploads:
            uploading.result()
    return answers, healthz


#: Barrier of a client process, for a common start after loading the code.
_barriers: list[Barrier] = []


def _join(barrier: Barrier) -> None:
    _barriers.append(barrier)


def _time_queries(url: str, frames: Sequence[FrameReference], place: int) -> list[float]:
    """Query frames consecutively, starting with `place`; return the milliseconds of each query."""
    times: list[float] = []
    with Client(url) as client:
        client.query(MAP, frames[place % len(frames)])
        _barriers[0].wait(PATIENCE_S)
        until = time.perf_counter() + SECONDS
        while (start := time.perf_counter()) < until:
            client.query(MAP, frames[(place + len(times)) % len(frames)])
            times.append(1e3 * (time.perf_counter() - start))
    return times


def _upload(url: str, frames: Sequence[FrameReference]) -> None:
    """Upload the same frames to a sequence of new maps, so that the worker is always busy."""
    with Client(url) as client:
        _barriers[0].wait(PATIENCE_S)
        until, number = time.perf_counter() + SECONDS, 0
        while time.perf_counter() < until:
            client.create_map(f"load-{number}")
            client.wait([client.upload(f"load-{number}", frame).job_id for frame in frames])
            number += 1


def _healthz(url: str, seconds: float) -> tuple[float, float]:
    """Return p50 and p99 of /healthz at a constant rate, milliseconds."""
    times = []
    with httpx.Client(base_url=url) as client:
        until = time.perf_counter() + seconds
        while (start := time.perf_counter()) < until:
            assert client.get("/healthz").status_code == 200
            times.append(1e3 * (time.perf_counter() - start))
            time.sleep(max(1 / RATE - (time.perf_counter() - start), 0.0))
    p50, p99 = np.percentile(times, (50, 99)).tolist()
    return p50, p99
