"""Commits in a second of many writers, with a network between them and PostgreSQL.

`python -m benchmarks.fleet.commits [--maps N] [--clients N] [--delay-ms X] [--commits N]`: uploads,
then the index commits of the same frames, as services and workers make them: the clients are
spread over some processes, and uploads that wait in one are written together. A reader follows the
events meanwhile, as services do for those who listen: what it misses, or sees out of a map's order,
and how late it is.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from multiprocessing import get_context
from multiprocessing.connection import Connection as Pipe
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, TypeVar

import numpy as np

from benchmarks.fleet.delay_proxy import DelayProxy
from benchmarks.fleet.postgres import Server
from sceneprint.engine.admin.operations import next_events
from sceneprint.engine.ingest.write_groups import NewFrames
from sceneprint.store import Database, open_database, queue
from sceneprint.store.events import Wanted
from sceneprint.store.maps import add_map, frame_of, keep_model
from sceneprint.store.new_frames import NewFrame
from sceneprint.store.signatures import StoredSignature, index_claimed_frame
from sceneprint.store.tables import FrameRow, JobRow, MapRow

T = TypeVar("T")

#: Seconds between two looks for events, and events of one, as in `service/event_stream.py`.
POLL_S, MOST = 0.1, 500
#: Processes that clients share, each with a network of its own.
PROCESSES = 4
#: Commits of each client before those that are timed.
WARM = 10
MODEL, LEASE_S = "ab" * 32, 3600.0
MADE = StoredSignature(MODEL, bytes(400), "00" * 32, [1], [1])
#: What is known of each frame beside its content.
KNOWN: dict[str, object] = {
    "blob": "00" * 32, "bytes": 3, "intrinsics": {"width": 1}, "depth_scale": 1000.0,
    "depth_along_ray": False, "robot": None, "session": None, "captured_at": None, "tags": [],
    "pose_parent": None, "pose": None, "name": None, "sequence": None,
}  # fmt: skip


@dataclass
class Feed:
    """What a reader of events saw.

    Parameters
    ----------
    missed : events of uploads and index commits that it never saw
    disordered : frames whose end it saw before their upload
    late_ms : from each event's time to when it was read
    sizes : uploads that were written together
    """

    missed: int = 0
    disordered: int = 0
    late_ms: list[float] = field(default_factory=list)
    sizes: list[int] = field(default_factory=list)

    def __str__(self) -> str:
        late = np.percentile(self.late_ms, [50, 99])
        told = (
            f"{self.missed} missed, {self.disordered} out of order, {late[0]:.0f} ms late "
            f"(p99 {late[1]:.0f} ms)"
        )
        if not self.sizes:
            return told
        quarters = np.percentile(self.sizes, [12.5, 37.5, 62.5, 87.5], method="nearest")
        sizes = ", ".join(map(str, quarters))
        return f"{told}; uploads written together: {np.mean(self.sizes):.1f} ({sizes})"


def measure(
    n_maps: int, n_clients: int, delay_ms: float, commits: int
) -> tuple[float, float, Feed]:
    """Uploads and index commits in a second, and what a reader of their events saw.

    Parameters
    ----------
    n_maps : that the frames are spread over
    n_clients : writers at once
    delay_ms : that each message takes, in either direction
    commits : of each kind
    """
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        server = Server(Path(folder) / "server", durable=True)
        server.start()
        stack.callback(server.kill)
        server.create("commits")
        near = open_database(server.url("commits"))
        stack.callback(near.close)
        rows = make_maps(near, n_maps)
        urls = [_far(stack, server, delay_ms) for _ in range(min(PROCESSES, n_clients))]
        reader = stack.enter_context(in_process(follow, urls[0], 2 * (WARM * n_clients + commits)))
        shares = [n_clients // len(urls) + (i < n_clients % len(urls)) for i in range(len(urls))]
        clients = [
            stack.enter_context(in_process(_write, url, n))
            for url, n in zip(urls, shares, strict=True)
        ]
        # a connection prepares what it has executed some times
        warm, all_ = WARM * n_clients, WARM * n_clients + commits
        uploads = [(rows[i % n_maps], i) for i in range(all_)]
        _timed(clients, upload, uploads[:warm])
        uploaded, sizes = _timed(clients, upload, uploads[warm:])
        claimed = [claim(near) for _ in range(all_)]
        _timed(clients, index, claimed[:warm])
        ended, _ = _timed(clients, index, claimed[warm:])
        reader.send("over")
        feed: Feed = reader.recv()
        feed.sizes = sizes
    return commits / uploaded, commits / ended, feed


def _far(stack: ExitStack, server: Server, delay_ms: float) -> str:
    """The URL of a server behind a network of its own."""
    proxy = DelayProxy(server.port, delay_ms / 1e3)
    stack.callback(proxy.end)
    return server.url("commits").replace(f":{server.port}/", f":{proxy.port}/")


@contextmanager
def in_process(do: Callable[..., None], *given: object) -> Iterator[Pipe]:
    """A process of its own that begins by saying so, and is killed in the end."""
    context = get_context("spawn")
    own, its = context.Pipe()
    process = context.Process(target=do, args=(its, *given), daemon=True)
    process.start()
    try:
        own.recv()
        yield own
    finally:
        process.kill()
        process.join()


def follow(pipe: Pipe, url: str, n: int) -> None:
    """Read events as a service does until told that it is over, and say what was seen of n."""
    database = open_database(url)
    feed, place, seen = Feed(), 0, dict[str | None, set[str]]()
    begun = time.time()
    pipe.send("begun")
    is_last, pause_s = False, POLL_S
    while not is_last:
        is_last, pause_s = pipe.poll(pause_s), POLL_S
        while True:
            part = next_events(database, Wanted(kinds=("frame.",)), place, MOST)
            now, place = time.time(), part.place
            for one in part.found:
                of_frame = seen.setdefault(one.frame_id, set())
                of_frame.add(one.kind)
                feed.disordered += "frame.received" not in of_frame
                if one.at > begun:
                    feed.late_ms.append(1e3 * (now - one.at))
                pause_s = POLL_S / 2
            if len(part.found) < MOST:
                break
    feed.missed = n - sum(map(len, seen.values()))
    pipe.send(feed)
    database.close()


def make_maps(database: Database, n: int) -> list[MapRow]:
    """Maps without frames."""
    with database.write() as connection:
        keep_model(connection, MODEL, "toy", b"the file of a model")
        return [add_map(connection, f"map-{i}", None, MODEL) for i in range(n)]


class CountedFrames(NewFrames):
    """New frames, and how many were written together."""

    def __init__(self, database: Database) -> None:
        super().__init__(database)
        self.sizes: list[int] = []

    def _write_together(self, taken: list[Any]) -> None:
        super()._write_together(taken)
        self.sizes.append(len(taken))


class Writer:
    """What clients of one process write with."""

    def __init__(self, database: Database) -> None:
        self.database, self.new_frames = database, CountedFrames(database)


def upload(writer: Writer, work: tuple[MapRow, int]) -> None:
    """Write a frame to a map, as a service does, with those that come meanwhile."""
    row, number = work
    if not writer.new_frames.receive(NewFrame(row, {**KNOWN, "content_id": f"{number:064x}"})):
        raise RuntimeError("an upload was not taken")


def claim(database: Database) -> tuple[JobRow, FrameRow]:
    """Claim a job, as a worker does."""
    with database.write(turn=False) as connection:
        held = queue.claim(connection, "commits", LEASE_S)
        if held is None:
            raise RuntimeError("a job is missing")
        return held, frame_of(connection, held.frame)


def index(writer: Writer, work: tuple[JobRow, FrameRow]) -> None:
    """Write the signature of a claimed frame, as a worker does."""
    held, frame = work
    with writer.database.write(map_number=frame.map_number, single=True) as connection:
        if not index_claimed_frame(connection, held, frame, "map", MADE):
            raise RuntimeError("a frame was not indexed")


def _timed(
    clients: list[Pipe], do: Callable[[Writer, T], None], works: list[T]
) -> tuple[float, list[int]]:
    """Seconds until all is done by the clients at once, and how many frames were new together."""
    for i, client in enumerate(clients):
        client.send((do, works[i :: len(clients)]))
    for client in clients:
        client.recv()  # they have connected
    begun = time.perf_counter()
    for client in clients:
        client.send("begin")
    sizes = list[int]()
    for client in clients:
        error, own = client.recv()
        if error is not None:
            raise error
        sizes += own
    return time.perf_counter() - begun, sizes


def _write(pipe: Pipe, url: str, n_clients: int) -> None:
    """Some clients, which do what they are told as fast as they can."""
    writer = Writer(open_database(url))
    pipe.send("begun")
    while True:
        do, works = pipe.recv()
        waiting, errors = SimpleQueue[Any](), list[Exception]()
        for work in works:
            waiting.put(work)
        threads = [
            threading.Thread(target=_work, args=(writer, do, waiting, errors))
            for _ in range(n_clients)
        ]
        pipe.send("ready")
        pipe.recv()
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        pipe.send((errors[0] if errors else None, writer.new_frames.sizes))
        writer.new_frames.sizes = []


def _work(
    writer: Writer, do: Callable[[Writer, Any], None], waiting: SimpleQueue[Any],
    errors: list[Exception],
) -> None:  # fmt: skip
    try:
        while True:
            do(writer, waiting.get_nowait())
    except Empty:
        return
    except Exception as error:
        errors.append(error)


def tell(
    arguments: list[str] | None, about: str | None, commits: int,
    measured: Callable[[int, int, float, int], tuple[float, float, Feed]], how: str = "",
) -> int:  # fmt: skip
    """Measure as a command line asks for, and print.

    Parameters
    ----------
    arguments : of the command line
    about : what it does
    commits : of each kind, unless told
    measured : see `measure`
    how : said of the figures
    """
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("--maps", type=int, default=50)
    parser.add_argument("--clients", type=int, default=32)
    parser.add_argument("--delay-ms", type=float, default=0.5)
    parser.add_argument("--commits", type=int, default=commits)
    asked = parser.parse_args(arguments)
    uploads, ends, feed = measured(asked.maps, asked.clients, asked.delay_ms, asked.commits)
    print(
        f"{asked.maps} maps, {asked.clients} clients, {asked.delay_ms:g} ms{how}: "
        f"{uploads:.0f} uploads/s, {ends:.0f} index commits/s; events: {feed}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(tell(None, __doc__, 1000, measure))
