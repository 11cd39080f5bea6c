"""One run of the fleet: robots, injected faults, and what came of it.

drive(folder, Plan)  -->  FleetFigures
"""

from __future__ import annotations

import random
import threading
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import httpx
import numpy as np
from tqdm import tqdm

from benchmarks.fleet.audit import Found, await_idle, check
from benchmarks.fleet.failover_client import FailoverClient, RequestLog, Wait
from benchmarks.fleet.faults import FaultInjector, Kill, Promotion, schedule
from benchmarks.fleet.fleet import Fleet, await_service
from benchmarks.fleet.recordings import Shot, recordings, walks
from benchmarks.fleet.robots import Ledger, Listener, Robot, asked
from benchmarks.fleet.rolling_upgrade import upgrade
from sceneprint_client import Client

#: The map that most robots share; every so many robots have one of their own.
MAP, MODEL, OWN = "fleet", "depth", 4
#: Seconds that a robot may take to have its last frame acknowledged.
PATIENCE_S = 240.0


@dataclass(frozen=True)
class Plan:
    """What is run.

    Parameters
    ----------
    seconds : for which the robots walk
    robots : how many
    rate : frames a second of each
    kills, promotions : of services and workers, and of the primary
    freezes : of the primary, for some seconds
    seed : of victims and moments
    services, workers : processes
    asynchronous : the standby does not have to have received what is acknowledged
    objects : blobs are in an object store
    delays : messages to the database and to the object store take their time
    data : folder of recordings; None: synthetic rooms
    before : checkout of the version before, which the fleet begins as: instead of being killed,
        its parts are replaced by this version
    """

    seconds: float = 120.0
    robots: int = 8
    rate: float = 1.0
    kills: int = 20
    promotions: int = 2
    freezes: int = 0
    seed: int = 0
    services: int = 2
    workers: int = 4
    asynchronous: bool = False
    objects: bool = False
    delays: bool = False
    data: Path | None = None
    before: Path | None = None

    @property
    def frames(self) -> int:
        """The most that a robot sends."""
        return int(self.seconds * self.rate) + 1


@dataclass
class FleetFigures:
    """What came of it.

    Parameters
    ----------
    plan : that was run
    found : what is there in the end
    kills : by victim
    outages : see `outages`
    promotions : of the standby
    steps : of the upgrade
    refused : answers that asked to come back, by request and status
    waits_ms : milliseconds of uploads and of queries until they were answered: median, p99
    memory : most bytes of a process of the services, and of the workers
    answers : queries by status
    repeated : requests that were sent again
    faults : answers that should not be, and errors in any log that are not of an outage
    damaged, leftovers : findings of `sceneprint fsck`
    lost : acknowledged frames that are not there, beyond those that a standby had not received
    window : acknowledged frames that the standbys had not received
    seconds : of all
    """

    plan: Plan
    found: Found
    kills: Counter[str]
    outages: dict[str, list[float]]
    promotions: Sequence[Promotion]
    steps: Sequence[str]
    refused: Counter[str]
    waits_ms: Mapping[str, tuple[float, float]]
    memory: tuple[int, int]
    answers: Counter[str]
    repeated: int
    faults: list[str]
    damaged: int
    leftovers: int
    lost: int
    window: int
    seconds: float

    @property
    def sound(self) -> bool:
        """Whether nothing was lost, doubled, half there or wrong."""
        found = self.found
        there = found.acknowledged - len(found.missing)
        wrong = (
            self.lost, found.stuck, found.doubled, found.strangers, found.heard_twice,
            found.disagreeing, self.damaged, len(self.faults), found.indexed - found.found,
            there - found.indexed - found.stated,
        )  # fmt: skip
        tried = found.acknowledged > 0 and self.window == len(found.missing)
        return tried and not any(wrong) and (self.plan.asynchronous or not found.unheard)


def drive(folder: Path, plan: Plan) -> FleetFigures:
    """Run a fleet in an empty folder; nothing of it runs afterwards."""
    begun = time.monotonic()
    with recordings(plan.data, plan.robots * plan.frames) as data:
        walked = walks(data, plan.robots, plan.frames)
    fleet = Fleet(
        folder, plan.services, plan.workers, synchronous=not plan.asynchronous,
        objects=plan.objects, before=plan.before, delays=plan.delays,
    )  # fmt: skip
    try:
        return _driven(fleet, plan, walked, begun)
    finally:
        fleet.end()


def _driven(fleet: Fleet, plan: Plan, walked: list[list[Shot]], begun: float) -> FleetFigures:
    rng = random.Random(plan.seed)
    ledger, log, stop = Ledger(), RequestLog(), threading.Event()
    key = fleet.begin()
    with ExitStack() as opened:
        clients = [opened.enter_context(Client(url, key)) for url in fleet.urls]
        robots, listeners = _crowd(fleet, plan, walked, clients[0], ledger, log, stop)
        probe = walked[0][0]
        injector = FaultInjector(
            fleet, lambda url: _answers(url, key, probe), rng, plan.asynchronous
        )
        bar = opened.enter_context(tqdm(total=plan.seconds, unit="s", disable=None, leave=False))
        telling = threading.Thread(target=_tell, args=(bar, ledger, stop), daemon=True)
        walking = time.monotonic()
        for one in (*listeners, *robots, telling):
            one.start()
        steps = list[str]()
        try:
            if plan.before is not None:
                steps = upgrade(fleet, plan.seconds, bar.set_postfix_str)
            else:
                due = schedule(plan.seconds, plan.kills, plan.promotions, rng, plan.freezes)
                injector.run(due, bar.set_postfix_str)
            stop.wait(max(walking + plan.seconds - time.monotonic(), 0.0))
        finally:
            stop.set()
        for robot in robots:
            robot.join(PATIENCE_S)
            if robot.is_alive():
                log.fault(f"{robot.name} does not come to its end")
        for url in fleet.urls:
            await_service(url)
        await_idle(clients[0])
        found = check(ledger.kept, clients, listeners)
        for listener in listeners:
            listener.stop()
        memory = fleet.memory()
        fleet.stop()
        leftovers, damaged = fleet.fsck()
    unreceived = {name for one in injector.promotions for name in one.unreceived}
    window = {one.frame_id for one in ledger.kept} & unreceived
    return FleetFigures(
        plan=plan,
        found=found,
        kills=Counter(one.victim for one in injector.kills),
        outages=outages(injector.kills, log.waits),
        promotions=injector.promotions,
        steps=steps,
        refused=log.refused,
        waits_ms={
            kind: (1e3 * float(np.quantile(seconds, 0.5)), 1e3 * float(np.quantile(seconds, 0.99)))
            for kind, seconds in sorted(log.seconds.items())
        },
        memory=memory,
        answers=ledger.answers,
        repeated=log.repeated,
        faults=log.faults,
        damaged=damaged,
        leftovers=leftovers,
        lost=len(found.missing - window),
        window=len(window),
        seconds=time.monotonic() - begun,
    )


def _crowd(
    fleet: Fleet, plan: Plan, walked: list[list[Shot]], client: Client, ledger: Ledger,
    log: RequestLog, stop: threading.Event,
) -> tuple[list[Robot], list[Listener]]:  # fmt: skip
    """Robots with keys and maps, and who hears the events of each map."""
    robots = []
    maps = dict.fromkeys(f"{MAP}-{i}" if i % OWN == OWN - 1 else MAP for i in range(plan.robots))
    for name in maps:
        client.create_map(name, model=MODEL)
    for i, walk in enumerate(walked):
        name = f"{MAP}-{i}" if i % OWN == OWN - 1 else MAP
        secret = client.create_key(f"robot-{i}", {name: "write"}).secret
        own = FailoverClient(fleet.urls, secret, log, first=i)
        robots.append(Robot(f"robot-{i}", name, walk, plan.rate, own, ledger, log, stop))
    listeners = []
    for i, name in enumerate(maps):
        secret = client.create_key(f"listener-{i}", {name: "read"}).secret
        listeners.append(Listener(name, FailoverClient(fleet.urls, secret, log, first=i)))
    return robots, listeners


def _answers(url: str, key: str, shot: Shot) -> bool:
    """Whether a service answers a query."""
    return httpx.post(
        f"{url}/v1/maps/{MAP}/queries", headers={"Authorization": f"Bearer {key}"}, timeout=5,
        trust_env=False, **asked(shot, k="1", stages="retrieve", keep="false"),
    ).is_success  # fmt: skip


def _tell(bar: tqdm[None], ledger: Ledger, stop: threading.Event) -> None:
    while not stop.wait(1.0):
        bar.set_description(f"{len(ledger.kept)} acknowledged")
        bar.update(1)


def outages(kills: Sequence[Kill], waits: Sequence[Wait]) -> dict[str, list[float]]:
    """For each kill the longest that a robot had no answer because of it, by victim, seconds.

    A wait is put down to the first kill in it, or to the last one before: what was killed then was
    not back yet.
    """
    longest = [0.0] * len(kills)
    for wait in waits:
        within = [i for i, one in enumerate(kills) if wait.begun <= one.at <= wait.answered]
        before = [i for i, one in enumerate(kills) if one.at < wait.begun]
        for i in within[:1] or before[-1:]:
            longest[i] = max(longest[i], wait.answered - max(wait.begun, kills[i].at))
    found: dict[str, list[float]] = {}
    for kill, seconds in zip(kills, longest, strict=True):
        found.setdefault(kill.victim, []).append(seconds)
    return found
