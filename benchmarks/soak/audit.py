"""Comparison of the content and the answers of a store with the acknowledgements of clients."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Container, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, select

from benchmarks.soak.plan import MODEL
from benchmarks.soak.recordings import Shot
from benchmarks.soak.robots import Acknowledged, K, Ledger, Listener, Search
from benchmarks.waiting import until
from sceneprint.decoders import LocalDecoders
from sceneprint.engine.ingest.frame_decoder import read_upload
from sceneprint.errors import SceneprintError
from sceneprint.pipeline import Signer, open_signer, sign
from sceneprint.store.tables import audit, events
from sceneprint_client import Client
from sceneprint_client.api import Frame, FrameState

#: Time limits of the workers to finish the queue, and of events to arrive, seconds.
PATIENCE_S, EVENTS_S = 600.0, 20.0
#: Number of frames whose neighbours are compared between services, and maximum of queried frames.
COMPARED, LOOKED_UP = 20, 1_000
#: States in which a frame is stored but not searched, with a reason.
STATED = (FrameState.REJECTED, FrameState.FAILED, FrameState.REDUNDANT)
#: Changes by clients that have an event and an entry in the audit log.
CHANGES = ("map.created", "frame.received")


@dataclass
class AuditCounts:
    """Final state of the store, by numbers of frames.

    Parameters
    ----------
    acknowledged : acknowledged frames, without deleted frames
    indexed, stated : frames that queries find, and frames with a state that explains their absence
    aged : frames that retention deleted on time, with an event
    looked_up, found : indexed frames that were queried, and those that were found at distance 0
    missing : ids of acknowledged frames that are not stored
    returned, stuck : deleted frames that are stored, and frames that are still queued
    doubled, strangers : frames with duplicate content, and frames without acknowledgement
    unheard, heard_twice : events of acknowledged frames that were not, or repeatedly, received
    disagreeing : answers and lists that differ between addresses
    separated : changes without their event or their entry in the audit log
    searches, wrong : number of searches by readers and by this check, and their errors
    """

    acknowledged: int = 0
    indexed: int = 0
    stated: int = 0
    aged: int = 0
    looked_up: int = 0
    found: int = 0
    missing: set[str] = field(default_factory=set)
    returned: int = 0
    stuck: int = 0
    doubled: int = 0
    strangers: int = 0
    unheard: int = 0
    heard_twice: int = 0
    disagreeing: int = 0
    separated: int = 0
    searches: int = 0
    wrong: list[str] = field(default_factory=list)


def await_idle(client: Client) -> None:
    """Wait until a service answers and no job waits or runs."""

    def is_idle() -> bool:
        with suppress(SceneprintError):
            jobs = client.status().jobs or {}
            return not jobs.get("queued", 0) and not jobs.get("running", 0)
        return False

    until(is_idle, PATIENCE_S, 0.5)


def check(
    ledger: Ledger, stable: Sequence[str], clients: Sequence[Client],
    listeners: Sequence[Listener], aging: Mapping[str, float] = MappingProxyType({}),
) -> AuditCounts:  # fmt: skip
    """Check every acknowledged frame at every address.

    Parameters
    ----------
    ledger : all acknowledgements
    stable : ids of the frames that readers searched
    aging : retention of some maps, seconds
    """
    expected = {f.frame_id: f for f in ledger.frames if f.frame_id not in ledger.deleted}
    maps = sorted({frame.map_name for frame in ledger.frames})
    lists = [{name: list(client.frames(name)) for name in maps} for client in clients]
    stored = {frame.frame_id: frame for frames in lists[0].values() for frame in frames}
    present = {name: frame for name, frame in stored.items() if name in expected}
    indexed = {name for name, frame in present.items() if frame.state == FrameState.INDEXED}
    stated = sum(frame.state in STATED for frame in present.values())
    contents = Counter((frame.map, frame.content_id) for frame in stored.values())
    # Frames of maps with retention may be deleted during the queries.
    lasting = [f for f in expected.values() if f.frame_id in indexed and f.map_name not in aging]
    looked_up = lasting[:: -(-len(lasting) // LOOKED_UP) or 1]
    with ThreadPoolExecutor(len(clients)) as pool:
        parts = [looked_up[i :: len(clients)] for i in range(len(clients))]
        actual = sum(pool.map(_count_found, clients, parts))
    gone = set(expected) - set(stored)
    aged = {
        str(name)
        for listener in listeners
        for name, at in listener.retired.items()
        if name in gone
        and at - expected[name].begun >= aging.get(expected[name].map_name, math.inf)
    }  # fmt: skip
    result = AuditCounts(
        len(expected), len(indexed), stated, len(aged), len(looked_up), actual, gone - aged,
        returned=len(stored.keys() & ledger.deleted.keys()),
        stuck=len(present) - len(indexed) - stated,
        doubled=sum(contents.values()) - len(contents),
        strangers=len(stored.keys() - expected.keys() - ledger.deleted.keys()),
        disagreeing=sum(_plain(other, aging) != _plain(lists[0], aging) for other in lists[1:]),
    )  # fmt: skip
    some = sorted(lasting, key=lambda frame: frame.frame_id)[:: max(len(lasting) // COMPARED, 1)]
    _compare_searches(result, ledger, stable, clients, some)
    _compare_events(result, [expected[name] for name in (*present, *sorted(aged))], listeners)
    return result


def _plain(lists: dict[str, list[Frame]], aging: Container[str]) -> dict[str, dict[str, str]]:
    return {
        name: {frame.frame_id: frame.state for frame in frames}
        for name, frames in lists.items()
        if name not in aging
    }


def _search(client: Client, frame: Acknowledged, k: int) -> list[tuple[str, int]]:
    answer = client.query(
        frame.map_name, frame.shot.png, frame.shot.meta, stages=("retrieve",), k=k, exact=True,
        keep=False,
    )  # fmt: skip
    return [(match.frame_id, int(match.distance)) for match in answer.matches]


def _count_found(client: Client, frames: Sequence[Acknowledged]) -> int:
    """Return the number of frames that a query with the same content finds at distance 0."""
    return sum((frame.frame_id, 0) in _search(client, frame, 2) for frame in frames)


def _compare_searches(
    result: AuditCounts, ledger: Ledger, stable: Sequence[str], clients: Sequence[Client],
    some: Sequence[Acknowledged],
) -> None:  # fmt: skip
    """Compare searches at several addresses, and with signatures that the library computes."""
    frames = {frame.frame_id: frame for frame in ledger.frames}
    searches = list(ledger.searches)
    for frame in some:
        begun = time.monotonic()
        answers = [_search(client, frame, K) for client in clients]
        result.disagreeing += any(answer != answers[0] for answer in answers[1:])
        searches.append(Search(frame.frame_id, answers[0], begun, time.monotonic()))
    result.searches = len(searches)
    names = {*stable, *(search.frame_id for search in searches)}
    names |= {name for search in searches for name, _ in search.matches}
    vectors = {name: signature(frames[name].shot) for name in names & frames.keys()}
    for search in searches:
        own = stable if frames[search.frame_id].map_name == frames[stable[0]].map_name else ()
        result.wrong += wrong_matches(search, ledger.deleted, own, vectors)


@cache
def signature(shot: Shot) -> NDArray[np.int64]:
    """Return the signature of a frame according to the library."""
    signer, decoders = _signer()
    vector = sign(read_upload(shot.png, shot.meta, decoders).frame, signer).vector
    return vector.astype(np.int64)


@cache
def _signer() -> tuple[Signer, LocalDecoders]:
    return open_signer(MODEL), LocalDecoders(1)


def wrong_matches(
    search: Search, deleted: Mapping[str, tuple[float, float]], stable: Sequence[str],
    vectors: Mapping[str, NDArray[np.int64]],
) -> list[str]:  # fmt: skip
    """Return the errors in the matches of an exact search.

    Parameters
    ----------
    deleted : times at which the deletion of a frame was sent and acknowledged
    stable : ids of frames that are always in the map
    vectors : signatures by frame; matches may include other frames
    """

    def distance(name: str) -> int:
        return int(((vectors[search.frame_id] - vectors[name]) ** 2).sum())

    wrong = []
    for name, far in search.matches:
        if name in vectors and far != distance(name):
            wrong.append(f"{name} has the wrong distance {far}")
        if name in deleted and deleted[name][1] < search.begun:
            wrong.append(f"{name} was deleted before the search")
    names, distances = {name for name, _ in search.matches}, [far for _, far in search.matches]
    if distances != sorted(distances) or len(names) != len(distances):
        wrong.append("the matches are not in order, or one is repeated")
    # A frame that is deleted during the search is not replaced.
    meanwhile = sum(
        begun <= search.answered and done >= search.begun for begun, done in deleted.values()
    )
    if stable and len(names) + meanwhile < min(K, len(stable) - 1):
        wrong.append(f"{len(names)} matches, with at most {meanwhile} deletions during the search")
    return wrong + [
        f"{name} at {distance(name)} is missing"
        for name in stable
        if name not in (*names, search.frame_id) and distance(name) < max(distances, default=-1)
    ]


def count_separated(connection: Connection, map_names: Sequence[str]) -> int:
    """Return the number of changes to maps without their event or their entry in the audit log."""
    by_event, by_line = (
        Counter(tuple(row) for row in connection.execute(
            select(kind, name, target).where(kind.in_(CHANGES), name.in_(map_names))
        ))
        for kind, name, target in (
            (events.c.kind, events.c.map, events.c.frame_id),
            (audit.c.action, audit.c.map, audit.c.target),
        )
    )  # fmt: skip
    return (by_event - by_line).total() + (by_line - by_event).total()


def _compare_events(
    result: AuditCounts, stored: Sequence[Acknowledged], listeners: Sequence[Listener]
) -> None:
    """Count events of stored frames that were not received, or received repeatedly."""
    heard = {listener.map_name: listener.heard for listener in listeners}
    wanted = [(frame.map_name, ("frame.received", frame.frame_id)) for frame in stored]
    end = time.monotonic() + EVENTS_S
    while time.monotonic() < end and not all(heard[name][event] for name, event in wanted):
        time.sleep(0.2)
    result.unheard = sum(heard[name][event] == 0 for name, event in wanted)
    result.heard_twice = sum(heard[name][event] > 1 for name, event in wanted)
