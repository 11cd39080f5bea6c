"""What the fleet holds in the end, against what the robots were told.

Ledger, listeners, every service  -->  Found
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Container, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from types import MappingProxyType

from benchmarks.fleet.recordings import Shot
from benchmarks.fleet.robots import Kept, Listener
from sceneprint_client import Client
from sceneprint_client.api import Frame, FrameState

#: Seconds for the workers to come to the end of the queue, and for events to come.
PATIENCE_S, EVENTS_S = 600.0, 20.0
#: Frames that every service is asked for, and compared; most that are looked for by a query.
COMPARED, LOOKED_FOR = 20, 1_000
#: States in which a frame is not on its way any more, and is there.
STATED = (FrameState.REJECTED, FrameState.FAILED, FrameState.REDUNDANT)


@dataclass
class Found:
    """What is there.

    Parameters
    ----------
    acknowledged : frames
    indexed, stated : of them, those that queries find, and those whose state says why they do not
    aged : frames of maps that keep none for long, deleted for that and told to have been
    looked_for, found : of the indexed, those that were looked for by a query of the same content,
        and those that it has at distance 0
    missing : ids of those acknowledged that are not there
    stuck : of those that are there, on their way still
    doubled : frames beyond one of a content in a map
    strangers : frames that are there, that nobody was told of
    unheard, heard_twice : events of acknowledged frames that did not come, or came more than once
    disagreeing : answers and lists that are not the same at every address
    """

    acknowledged: int = 0
    indexed: int = 0
    stated: int = 0
    aged: int = 0
    looked_for: int = 0
    found: int = 0
    missing: set[str] = field(default_factory=set)
    stuck: int = 0
    doubled: int = 0
    strangers: int = 0
    unheard: int = 0
    heard_twice: int = 0
    disagreeing: int = 0


def await_idle(client: Client) -> None:
    """Return once no job is left to be done.

    Raises
    ------
    RuntimeError : it does not come to it.
    """
    until = time.monotonic() + PATIENCE_S
    while time.monotonic() < until:
        jobs = client.status().jobs or {}
        if not jobs.get("queued", 0) and not jobs.get("running", 0):
            return
        time.sleep(0.5)
    raise RuntimeError(f"jobs are left after {PATIENCE_S:g} s: {client.status().jobs}")


def check(
    kept: Sequence[Kept], clients: Sequence[Client], listeners: Sequence[Listener],
    aging: Mapping[str, float] = MappingProxyType({}),
) -> Found:  # fmt: skip
    """Look every acknowledged frame up, everywhere; `aging`: seconds for which some maps keep a
    frame.
    """
    maps = sorted({one.map_name for one in kept})
    lists = [{name: list(client.frames(name)) for name in maps} for client in clients]
    there = {frame.frame_id: frame for frames in lists[0].values() for frame in frames}
    told = {one.frame_id: one for one in kept}
    present = {name: frame for name, frame in there.items() if name in told}
    indexed = {name for name, one in present.items() if one.state == FrameState.INDEXED}
    stated = sum(one.state in STATED for one in present.values())
    contents = Counter((one.map, one.content_id) for one in there.values())
    # frames of such maps may go while they are looked for
    lasting = [
        one for one in told.values() if one.frame_id in indexed and one.map_name not in aging
    ]
    looked_for = lasting[:: -(-len(lasting) // LOOKED_FOR) or 1]
    with ThreadPoolExecutor(len(clients)) as pool:
        parts = [looked_for[i :: len(clients)] for i in range(len(clients))]
        found = sum(pool.map(_found, clients, parts))
    gone = set(told) - set(there)
    retired = {name: at for one in listeners for name, at in one.retired.items() if name in gone}
    aged = {
        str(name)
        for name, at in retired.items()
        if at - told[str(name)].begun >= aging.get(told[str(name)].map_name, math.inf)
    }
    result = Found(
        acknowledged=len(told),
        indexed=len(indexed),
        stated=stated,
        aged=len(aged),
        looked_for=len(looked_for),
        found=found,
        missing=gone - aged,
        stuck=len(present) - len(indexed) - stated,
        doubled=sum(contents.values()) - len(contents),
        strangers=len(there.keys() - told.keys()),
        disagreeing=sum(_plain(one, aging) != _plain(lists[0], aging) for one in lists[1:]),
    )
    some = sorted(lasting, key=lambda one: one.frame_id)[:: max(len(lasting) // COMPARED, 1)]
    result.disagreeing += sum(_disagree(clients, one) for one in some)
    _hear(result, [told[name] for name in (*present, *sorted(aged))], listeners)
    return result


def _plain(lists: dict[str, list[Frame]], aging: Container[str]) -> dict[str, dict[str, str]]:
    return {
        name: {one.frame_id: one.state for one in frames}
        for name, frames in lists.items()
        if name not in aging
    }


def _ranked(client: Client, map_name: str, shot: Shot, k: int) -> list[tuple[str, float]]:
    answer = client.query(
        map_name, shot.png, shot.meta, stages=("retrieve",), k=k, exact=True, keep=False
    )
    return [(one.frame_id, one.distance) for one in answer.matches]


def _found(client: Client, kept: Sequence[Kept]) -> int:
    """How many frames are their own nearest."""
    return sum((one.frame_id, 0) in _ranked(client, one.map_name, one.shot, 2) for one in kept)


def _disagree(clients: Sequence[Client], kept: Kept) -> bool:
    answers = [_ranked(one, kept.map_name, kept.shot, 20) for one in clients]
    return any(one != answers[0] for one in answers[1:])


def _hear(result: Found, there: Sequence[Kept], listeners: Sequence[Listener]) -> None:
    """Count what was not heard of frames that are there, and what was heard twice."""
    heard = {one.map_name: one.heard for one in listeners}
    wanted = [(one.map_name, ("frame.received", one.frame_id)) for one in there]
    until = time.monotonic() + EVENTS_S
    while time.monotonic() < until:
        if all(heard[name][event] for name, event in wanted):
            break
        time.sleep(0.2)
    result.unheard = sum(heard[name][event] == 0 for name, event in wanted)
    result.heard_twice = sum(heard[name][event] > 1 for name, event in wanted)
