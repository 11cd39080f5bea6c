"""`make siege`: broken uploads, every operation fuzzed, too many requests, noisy neighbours.

`python -m benchmarks.siege --page docs/reliability.md` puts the figures into the page.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from itertools import cycle, product
from pathlib import Path

from benchmarks.machine import describe_machine
from benchmarks.pages import put_between
from benchmarks.siege.attacks import ATTACKS, SESSION, Order, attacker
from benchmarks.siege.contract import ContractFigures, try_contract
from benchmarks.siege.mutations import MutationFigures, besiege
from benchmarks.siege.neighbours import (
    NeighbourFigures,
    besiege_neighbour,
    neighbour_table,
    work_as_victim,
)
from benchmarks.siege.overload import OverloadFigures, overload
from benchmarks.soak.load import MODEL, Part, Shot, free_port, service, shots
from sceneprint.engine import Engine
from sceneprint.engine.admin.operations import create_tenant
from sceneprint.engine.ingest.uploads import Upload
from sceneprint.settings import Settings
from sceneprint.store import queue
from sceneprint_client import Client
from sceneprint_client.api import FrameMeta

#: Seconds in which a service has to begin, on a machine that others use too.
_BEGIN_S = 90.0
BEGIN, END = "<!-- siege:begin -->", "<!-- siege:end -->"
#: Whom `contracts` asks, in its order.
ASKED_OF = (
    "an open service", "what is there", "its own map, with a key for one map",
    "another map, with a key for one map", "no key",
)  # fmt: skip


@contextmanager
def besieged(
    data: Path, indexed: list[Shot], maps: tuple[str, ...] = ("siege",), key: str | None = None,
    **settings: object,
) -> Iterator[tuple[str, Part]]:  # fmt: skip
    """A service with one worker and maps that hold some frames.

    Parameters
    ----------
    data : its data folder
    indexed : frames that are in each map before
    maps : their names
    key : that may make them, where one is asked for
    settings : as for Settings
    """
    port = free_port()
    part = service(data, port, 1, None, **settings)
    part.begin()
    url = f"http://127.0.0.1:{port}"
    try:
        await_service(url)
        with Client(url, key) as client:
            for name in maps:
                client.create_map(name, model=MODEL)
                for one in indexed:
                    client.upload(name, one.png, one.meta, wait_s=60)
        yield url, part
    finally:
        part.end()


def await_service(url: str) -> None:
    """Wait until a service answers; TimeoutError where it does not begin."""
    until = time.monotonic() + _BEGIN_S
    with Client(url) as client:
        while not client.healthy():
            if time.monotonic() > until:
                raise TimeoutError(f"{url} did not begin within {_BEGIN_S:g} s; look into its log")
            time.sleep(0.1)


def known_of(url: str, map_name: str = "siege", key: str | None = None) -> dict[str, str]:
    """Names of what there is of a map, for parameters of the paths."""
    with Client(url, key) as client:
        frame = next(iter(client.frames(map_name)))
        query = client.query(map_name, frame_id=frame.frame_id)
    return {
        "path.map_name": map_name, "path.frame_id": frame.frame_id, "path.job_id": frame.job_id,
        "path.query_id": query.query_id,
    }  # fmt: skip


def contracts(folder: Path, frames: list[Shot], examples: int, seed: int) -> list[ContractFigures]:
    """Every operation: of an open service, of what is there; and of one that asks for keys: of
    the map that a key is for, of another, which it may not see, and without one.
    """
    found = []
    with besieged(folder / "open", frames) as (url, _):
        found.append(try_contract(url, folder, examples=examples, seed=seed))
    with besieged(folder / "known", frames) as (url, _):
        known = known_of(url)
        found.append(try_contract(url, folder, known=known, examples=examples, seed=seed))
    keyed, maps = folder / "keyed", ("siege", "other")
    keyed.mkdir()
    with Engine(Settings(data_dir=keyed, database_url=None)) as engine:
        own = engine.create_key("fuzzer", {"siege": "write"}).secret
        every = engine.create_key("operator").secret
    walls = {"host": "0.0.0.0", "requests_per_s": 0}
    with besieged(keyed, frames, maps, every, **walls) as (url, _):
        for name in maps:
            known = known_of(url, name, every)
            found.append(
                try_contract(url, folder, key=own, known=known, examples=examples, seed=seed)
            )
        # each of these is refused, and comes late: the edges of every schema would take hours
        few = max(examples // 5, 1)
        found.append(try_contract(url, folder, examples=few, seed=seed, phases="examples,fuzzing"))
    return found


def neighbours(
    folder: Path, frames: list[Shot], seconds: float, counts: Sequence[int] = (1, 2, 10),
    attacks: Iterable[str] = tuple(ATTACKS), database_url: str | None = None,
) -> list[NeighbourFigures]:  # fmt: skip
    """Every attack, with so many keys of one tenant each, while another tenant works.

    What an attack leaves in the queue is cancelled before the next.
    """
    folder.mkdir()
    where = {} if database_url is None else {"database_url": database_url}
    settings = Settings.model_validate({"data_dir": folder, "database_url": database_url})
    with Engine(settings) as engine:
        every, victim = (engine.create_key(name).secret for name in ("operator", "victim"))
        create_tenant(engine.store, "noisy")
        noisy = [
            engine.create_key(f"noisy-{i}", {"noisy": "admin"}, tenant="noisy").secret
            for i in range(max(counts))
        ]
    maps = ("noisy", "victim")
    with (
        besieged(folder, frames, maps, every, host="0.0.0.0", **where) as (url, _),
        attacker() as (begin, stop),
        Engine(settings) as engine,
    ):
        _fill_noisy(engine, frames)
        work_as_victim(url, victim, frames, 0.0)  # what is loaded once
        found = []
        for name, count in product(attacks, counts):
            order = Order(name, url, noisy[:count], frames)
            found.append(besiege_neighbour(order, begin, stop, victim, seconds))
            _empty_queue(engine)
        return found


#: Frames of `noisy` that are never signed, so that a page of it is full, and those that have poses.
_ROWS, _POSED = 1000, 16


def _fill_noisy(engine: Engine, frames: list[Shot]) -> None:
    """Give `noisy` a full page of frames, and a session of frames with poses that are indexed."""
    for start in range(0, _ROWS, 50):
        rows = [
            Upload(one.png, one.meta, frame_id=f"row-{start + i}")
            for i, one in zip(range(50), cycle(frames))
        ]
        engine.uploads.add_all("noisy", rows)
    _empty_queue(engine)
    posed = []
    for i, one in zip(range(_POSED), cycle(frames)):
        matrix = [[1, 0, 0, 0.1 * i], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
        pose = {"parent_frame": "map", "matrix": matrix}
        told = one.meta.model_dump() | {"session": SESSION, "sequence": i, "pose": pose}
        posed.append(Upload(one.png, FrameMeta.model_validate(told), frame_id=f"posed-{i}"))
    engine.uploads.add_all("noisy", posed)
    _await_idle(engine)


def _empty_queue(engine: Engine) -> None:
    """Cancel what waits or runs."""
    with engine.store.database.write() as connection:
        queue.cancel_jobs(connection)
    _await_idle(engine)


def _await_idle(engine: Engine) -> None:
    """Wait until no job waits or runs; TimeoutError where some still do after long."""
    until = time.monotonic() + _BEGIN_S
    while _pending(engine):
        if time.monotonic() > until:
            raise TimeoutError(f"jobs still wait or run after {_BEGIN_S:g} s")
        time.sleep(0.1)


def _pending(engine: Engine) -> int:
    with engine.store.database.read() as connection:
        counts = queue.count_jobs(connection)
    return sum(counts.get(state, 0) for state in queue.PENDING)


def table(
    mutations: MutationFigures, contracts: list[ContractFigures], overloaded: OverloadFigures
) -> list[str]:
    """The figures as lines of Markdown."""
    kinds = ", ".join(f"{n} {kind}" for kind, n in sorted(mutations.sent.items()))
    answers = ", ".join(f"{n} of {status}" for status, n in mutations.statuses.items())
    asked = [f"{one.passed} of {one.requests}" for one in contracts]
    loaded = ", ".join(f"{n} of {status}" for status, n in overloaded.statuses.items())
    return [
        f"### {sum(mutations.sent.values())} broken uploads within {mutations.seconds:.0f} s",
        "",
        "| | |",
        "|---|--:|",
        f"| files | {kinds} |",
        f"| answers | {answers} |",
        f"| **5xx, or no answer** | **{len(mutations.failed)}** |",
        f"| **processes that ended** | **{mutations.crashed}** |",
        f"| most memory of service, worker or reader of recordings | "
        f"{mutations.peak_bytes / 2**20:.0f} MiB |",
        f"| most memory of a decoder | {mutations.decoder_bytes / 2**20:.0f} MiB |",
        f"| decoders replaced | {mutations.replaced} |",
        "",
        f"### Every operation of the OpenAPI document ({contracts[0].operations})",
        "",
        "| asked of | answered as declared, none with 5xx |",
        "|---|--:|",
        *(f"| {of} | {count} |" for of, count in zip(ASKED_OF, asked, strict=True)),
        "",
        f"### {overloaded.offered:.0f} requests a second where {overloaded.sustainable:.0f} can "
        f"be done, for {overloaded.seconds:.0f} s",
        "",
        "| | |",
        "|---|--:|",
        f"| answers | {loaded} |",
        f"| sent away without `Retry-After` | {overloaded.without_word} |",
        f"| latency of the accepted, median and p99 | {overloaded.accepted_ms[0]:.0f} ms, "
        f"{overloaded.accepted_ms[1]:.0f} ms |",
        f"| latency of those sent away | {overloaded.away_ms[0]:.0f} ms, "
        f"{overloaded.away_ms[1]:.0f} ms |",
        f"| frames acknowledged, **lost** | {overloaded.acknowledged}, **{overloaded.lost}** |",
        f"| queries as fast as before, after | {overloaded.recovery_s:.1f} s |",
        "",
    ]


def main() -> int:
    """Run all of it; exit code 1 where anything failed, was lost, or was not as declared."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--uploads", type=int, default=20_000, help="that are broken")
    parser.add_argument("--examples", type=int, default=20, help="requests of each operation")
    parser.add_argument("--seconds", type=float, default=120, help="of too many requests")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--neighbours", type=float, default=5.0, help="seconds of each attack of a neighbour"
    )
    parser.add_argument(
        "--only-neighbours", action="store_true", help="print the table of noisy neighbours alone"
    )
    parser.add_argument("--attacks", nargs="+", choices=list(ATTACKS), default=list(ATTACKS))
    parser.add_argument("--keys", nargs="+", type=int, default=[1, 2, 10])
    parser.add_argument("--database-url", help="of noisy neighbours; default: SQLite")
    parser.add_argument("--page", type=Path, help="whose figures to replace")
    options = parser.parse_args()
    load = os.getloadavg()[1]  # of what else there is to do
    every = shots(160)
    if options.only_neighbours:
        with tempfile.TemporaryDirectory(prefix="sceneprint-siege-") as name:
            met = neighbours(
                Path(name) / "data", every[:8], options.neighbours, options.keys, options.attacks,
                database_url=options.database_url,
            )  # fmt: skip
        print("\n".join(neighbour_table(met)))
        return int(any(one.under.refused for one in met))
    with tempfile.TemporaryDirectory(prefix="sceneprint-siege-") as name:
        folder = Path(name)
        with besieged(folder / "overload", every[:40]) as (url, _):
            overloaded = overload(url, every[40:], options.seconds)
        print(overloaded)
        with besieged(folder / "mutations", every[:4]) as (url, part):
            mutations = besiege(url, [part], every, options.uploads, options.seed)
        print(mutations)
        tried = contracts(folder, every[:4], options.examples, options.seed)
        met = neighbours(
            folder / "neighbours", every[:8], options.neighbours, database_url=options.database_url
        )
    for line in (*mutations.failed[:20], *(one.report for one in tried if not one.sound)):
        print(line, file=sys.stderr)
    machine = describe_machine()
    when = (
        f"Measured {datetime.now(UTC):%Y-%m-%d} on {machine.processor}, "
        f"{machine.cores} processors; `make siege`."
    )
    if load > machine.cores / 4:
        when += (
            f" The machine was shared with other work: before it began, {load:.1f} processes "
            "wanted a processor on average."
        )
    lines = ["", when, "", *table(mutations, tried, overloaded)]
    lines += ["### One tenant attacks while another works", "", *neighbour_table(met), ""]
    print("\n".join(lines))
    if options.page is not None:
        put_between(options.page, BEGIN, END, lines)
    unanswered = overloaded.statuses.get(0, 0) + overloaded.lost
    wrong = len(mutations.failed) + mutations.crashed + unanswered
    wrong += sum(one.under.refused for one in met)
    return int(bool(wrong) or not all(one.sound for one in tried))


if __name__ == "__main__":
    sys.exit(main())
