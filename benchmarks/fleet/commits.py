"""Commits in a second of many writers, with a network between them and PostgreSQL.

`python -m benchmarks.fleet.commits [--maps N] [--clients N] [--delay-ms X] [--commits N]`: uploads,
then the index commits of the same frames, as services and workers make them. Each client has a
database of its own, as each is a process of a fleet; they are threads here, so that the
interpreter's lock counts too. A reader follows the events meanwhile, as services do for those who
listen: what it misses, or sees out of a map's order, and how late it is.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing import get_context
from multiprocessing.connection import Connection as Pipe
from multiprocessing.process import BaseProcess
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import TypeVar

import numpy as np

from benchmarks.fleet.delay_proxy import DelayProxy
from benchmarks.fleet.postgres import Server
from sceneprint.engine.admin.operations import next_events
from sceneprint.store import Database, open_database, queue
from sceneprint.store.events import Wanted
from sceneprint.store.maps import add_map, frame_of, keep_model, receive_frame
from sceneprint.store.signatures import StoredSignature, index_claimed_frame
from sceneprint.store.tables import FrameRow, JobRow, MapRow

T = TypeVar("T")

#: Seconds between two looks for events, and events of one, as in `service/event_stream.py`.
POLL_S, MOST = 0.1, 500
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
    """

    missed: int = 0
    disordered: int = 0
    late_ms: list[float] = field(default_factory=list)


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
    with tempfile.TemporaryDirectory() as folder:
        server = Server(Path(folder) / "server", durable=True)
        server.start()
        try:
            server.create("commits")
            near = open_database(server.url("commits"))
            rows = _maps(near, n_maps)
            proxy = DelayProxy(server.port, delay_ms / 1e3)
            far = server.url("commits").replace(f":{server.port}/", f":{proxy.port}/")
            clients = [open_database(far) for _ in range(n_clients)]
            reader, own = _reader(far, commits)
            try:
                uploads = [(rows[i % n_maps], i) for i in range(commits)]
                uploaded = _timed(clients, uploads, _upload)
                ended = _timed(clients, [_claim(near) for _ in range(commits)], _index)
                own.send("over")
                feed: Feed = own.recv()
            finally:
                reader.kill()
                reader.join()
                for one in (*clients, near):
                    one.close()
                proxy.end()
        finally:
            server.kill()
    return commits / uploaded, commits / ended, feed


def _reader(url: str, commits: int) -> tuple[BaseProcess, Pipe]:
    """A process of its own that follows the events, as a service does, and how to end it."""
    context = get_context("spawn")
    own, its = context.Pipe()
    process = context.Process(target=_follow, args=(its, url, commits), daemon=True)
    process.start()
    own.recv()
    return process, own


def _follow(pipe: Pipe, url: str, commits: int) -> None:
    database = open_database(url)
    feed, place, seen = Feed(), 0, dict[str | None, set[str]]()
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
                feed.late_ms.append(1e3 * (now - one.at))
                pause_s = POLL_S / 2
            if len(part.found) < MOST:
                break
    feed.missed = 2 * commits - sum(map(len, seen.values()))
    pipe.send(feed)
    database.close()


def _maps(database: Database, n: int) -> list[MapRow]:
    with database.write() as connection:
        keep_model(connection, MODEL, "toy", b"the file of a model")
        return [add_map(connection, f"map-{i}", None, MODEL) for i in range(n)]


def _upload(database: Database, work: tuple[MapRow, int]) -> None:
    row, number = work
    with database.write(map_number=row.number, single=True) as connection:
        if receive_frame(connection, row, {**KNOWN, "content_id": f"{number:064x}"}, 0) is None:
            raise RuntimeError("an upload was not taken")


def _claim(database: Database) -> tuple[JobRow, FrameRow]:
    with database.write(turn=False) as connection:
        held = queue.claim(connection, "commits", LEASE_S)
        if held is None:
            raise RuntimeError("a job is missing")
        return held, frame_of(connection, held.frame)


def _index(database: Database, work: tuple[JobRow, FrameRow]) -> None:
    held, frame = work
    with database.write(map_number=frame.map_number, single=True) as connection:
        if not index_claimed_frame(connection, held, frame, "map", MADE):
            raise RuntimeError("a frame was not indexed")


def _timed(clients: list[Database], works: list[T], do: Callable[[Database, T], None]) -> float:
    """Seconds until all is done by the clients at once."""
    waiting, errors = SimpleQueue[T](), list[Exception]()
    for work in works:
        waiting.put(work)

    def run(database: Database) -> None:
        try:
            while True:
                do(database, waiting.get_nowait())
        except Empty:
            return
        except Exception as error:
            errors.append(error)

    for client in clients:  # a first connection costs more than a commit
        with client.read():
            pass
    threads = [threading.Thread(target=run, args=[one]) for one in clients]
    begun = time.perf_counter()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if errors:
        raise errors[0]
    return time.perf_counter() - begun


def main(arguments: list[str] | None = None) -> int:
    """Measure, and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--maps", type=int, default=50)
    parser.add_argument("--clients", type=int, default=32)
    parser.add_argument("--delay-ms", type=float, default=0.5)
    parser.add_argument("--commits", type=int, default=1000)
    asked = parser.parse_args(arguments)
    uploads, ends, feed = measure(asked.maps, asked.clients, asked.delay_ms, asked.commits)
    late = np.percentile(feed.late_ms, [50, 99])
    print(
        f"{asked.maps} maps, {asked.clients} clients, {asked.delay_ms:g} ms: "
        f"{uploads:.1f} uploads/s, {ends:.1f} index commits/s; events: {feed.missed} missed, "
        f"{feed.disordered} out of order, {late[0]:.0f} ms late (p99 {late[1]:.0f} ms)"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
