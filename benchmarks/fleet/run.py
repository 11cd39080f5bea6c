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
from functools import partial
from pathlib import Path

import httpx
import numpy as np
from tqdm import tqdm

from benchmarks.fleet.audit import Found, await_idle, check
from benchmarks.fleet.failover_client import SILENCE_S, FailoverClient, RequestLog, Wait, bearer
from benchmarks.fleet.faults import CUT_OFF_S, FaultInjector, Kill, Promotion, schedule
from benchmarks.fleet.fleet import Fleet, await_service
from benchmarks.fleet.lock_samples import LockSampler, LockShares
from benchmarks.fleet.postgres_pair import DATABASE
from benchmarks.fleet.recordings import Shot, recordings, walks
from benchmarks.fleet.robots import (
    OFFLINE_PATIENCE_S,
    Crowd,
    Ledger,
    Listener,
    OfflineRobot,
    Robot,
    asked,
)
from sceneprint.store.deletion import DAY_S
from sceneprint_client import Client

#: The map that most robots share; every so many robots have one of their own, of so many.
MAP, MODEL, OWN, OWN_MAPS = "fleet", "depth", 4, 19
#: Map of the robots that are offline at first, and the part of the time for which they are.
OFFLINE_MAP, OFFLINE = "fleet-offline", 0.4
#: Seconds that a robot may take to have its last frame acknowledged.
PATIENCE_S = 240.0
#: Least part of the time for which locks have to be sampled.
SAMPLED = 0.5
#: Robots of a crowd, at least.
CROWD = 100
#: Threads that drive the robots.
DRIVERS = 32


@dataclass(frozen=True)
class Plan:
    """What is run.

    Parameters
    ----------
    seconds : for which the robots walk
    robots : how many
    rate : frames a second of each
    kills, promotions : of services and workers, and of the primary
    freezes, partitions : of the primary, and of a host, for some seconds
    offline : frames that one more robot spools before it has a network; 0: there is none
    retention_s : for which maps of single robots keep a frame, while the shared one keeps all;
        None: they do too
    seed : of victims and moments
    services, workers : processes
    asynchronous : the standby does not have to have received what is acknowledged
    objects : blobs are in an object store
    delays : messages to the database and to the object store take their time
    data : folder of recordings; None: synthetic rooms
    most_turn_ms : of a frame, for which all writers may have to wait for one, beside the time for
        which hosts are cut off
    most_query_ms : 99 of 100 queries are answered within: little later than a robot gives up an
        address that is silent
    most_bytes : of a process
    """

    seconds: float = 120.0
    robots: int = 8
    rate: float = 1.0
    kills: int = 20
    promotions: int = 2
    freezes: int = 0
    partitions: int = 0
    offline: int = 0
    retention_s: float | None = None
    most_turn_ms: float = 25.0
    most_query_ms: float = 1e3 * (SILENCE_S + 5)
    most_bytes: int = 1 << 30
    seed: int = 0
    services: int = 2
    workers: int = 4
    asynchronous: bool = False
    objects: bool = False
    delays: bool = False
    data: Path | None = None

    @property
    def is_crowd(self) -> bool:
        """Return whether there are too many robots for their maps to have surfaces."""
        return self.robots >= CROWD

    @property
    def frames(self) -> int:
        """The most that a robot sends."""
        return int(self.seconds * self.rate) + 1

    def map_of(self, robot: int) -> str:
        """Which map a robot sends to."""
        own = robot % OWN == OWN - 1
        if self.retention_s is not None:  # as many frames are to go as come, but for a few
            own = not own
        return f"{MAP}-{robot % (OWN * OWN_MAPS)}" if own else MAP


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
    waits_ms : milliseconds of uploads and of queries until they were answered: median, p99
    memory : most bytes of a process of the services, and of the workers
    answers : queries by status
    repeated : requests that were sent again
    faults : answers that should not be, and errors in any log that are not of an outage
    damaged, leftovers : findings of `sceneprint fsck`
    lost : acknowledged frames that are not there, beyond those that a standby had not received
    window : acknowledged frames that the standbys had not received
    locks : see LockShares
    spooled, spooled_twice : frames of the robot that was offline that were looked for, and that
        were sent again
    seconds : of all
    """

    plan: Plan
    found: Found
    kills: Counter[str]
    outages: dict[str, list[float]]
    promotions: Sequence[Promotion]
    waits_ms: Mapping[str, tuple[float, float]]
    memory: tuple[int, int]
    answers: Counter[str]
    repeated: int
    faults: list[str]
    damaged: int
    leftovers: int
    lost: int
    window: int
    locks: LockShares
    spooled: int
    spooled_twice: int
    seconds: float

    @property
    def turn_ms(self) -> tuple[float, float]:
        """Of a frame, milliseconds for which all writers, and those of its map, wait for one."""
        each = 1e3 / max(self.found.acknowledged, 1)
        return self.locks.everybody * each, self.locks.one_map * each

    @property
    def exceeded(self) -> list[str]:
        """Bounds of the plan that do not hold."""
        plan, (_, query_ms) = self.plan, self.waits_ms.get("query", (0.0, 0.0))
        # a host that is cut off may have the turn for as long
        cut_off_ms = 1e3 * plan.partitions * CUT_OFF_S / max(self.found.acknowledged, 1)
        most_turn_ms = plan.most_turn_ms + cut_off_ms
        found = {
            "the turn of all writers takes": (self.turn_ms[0], most_turn_ms, "ms a frame"),
            "the 99th percentile of queries is": (query_ms, plan.most_query_ms, "ms"),
            "a process had": (max(self.memory) / 1e6, plan.most_bytes / 1e6, "MB"),
        }
        return [
            f"{what} {value:,.1f} {unit}, above {most:,.0f}"
            for what, (value, most, unit) in found.items()
            if value > most
        ]

    @property
    def sound(self) -> bool:
        """Whether nothing was lost, doubled, half there or wrong, and the bounds hold."""
        found = self.found
        there = found.acknowledged - len(found.missing) - found.aged
        wrong = (
            self.lost, found.stuck, found.doubled, found.strangers, found.heard_twice,
            found.disagreeing, self.damaged, len(self.faults), found.looked_for - found.found,
            there - found.indexed - found.stated, len(self.exceeded),
        )  # fmt: skip
        tried = found.acknowledged > 0 and self.window == len(found.missing)
        # a server that fell, or was frozen, is not sampled
        tried &= self.locks.seconds >= SAMPLED * self.plan.seconds
        tried &= self.spooled == self.plan.offline
        return tried and not any(wrong) and (self.plan.asynchronous or not found.unheard)


def drive(folder: Path, plan: Plan) -> FleetFigures:
    """Run a fleet in an empty folder; nothing of it runs afterwards."""
    begun = time.monotonic()
    extra = -(-plan.offline // plan.frames)  # walks, of the robot that is offline
    with recordings(plan.data, (plan.robots + extra) * plan.frames) as data:
        walked = walks(data, plan.robots + extra, plan.frames)
    spooled = [shot for walk in walked[plan.robots :] for shot in walk][: plan.offline]
    walked = walked[: plan.robots]
    fleet = Fleet(
        folder, plan.services, plan.workers, synchronous=not plan.asynchronous,
        objects=plan.objects, delays=plan.delays,
        partitions=plan.partitions > 0, surfaces=not plan.is_crowd,
    )  # fmt: skip
    try:
        return _Run(fleet, plan, walked, spooled, begun).figures()
    finally:
        fleet.end()


class _Run:
    """A run in progress; see `drive`."""

    def __init__(
        self, fleet: Fleet, plan: Plan, walked: list[list[Shot]], spooled: list[Shot], begun: float
    ) -> None:
        self._fleet, self._plan, self._begun = fleet, plan, begun
        self._walked, self._spooled = walked, spooled
        self._ledger, self._log, self._stop = Ledger(), RequestLog(), threading.Event()
        self._rng = random.Random(plan.seed)
        self._locks = LockSampler(lambda: fleet.pair.primary.url(DATABASE).replace("+psycopg", ""))

    def figures(self) -> FleetFigures:
        """Run it to its end."""
        fleet, plan, log = self._fleet, self._plan, self._log
        key = fleet.begin()
        with ExitStack() as opened:
            clients = [opened.enter_context(Client(url, key)) for url in fleet.urls]
            robots, listeners = self._people(clients[0])
            offline = self._offline_robot(clients[0])
            if offline:
                listeners.append(self._listener(clients[0], OFFLINE_MAP))
            injector = FaultInjector(
                fleet, partial(_answers, key=key, shot=self._walked[0][0]), self._rng,
                plan.asynchronous,
            )  # fmt: skip
            self._walk(robots, [*listeners, *offline], injector)
            for one in offline:
                one.join(OFFLINE_PATIENCE_S)
                if one.is_alive():
                    log.fault(f"{one.name} does not come to its end")
            for url in fleet.urls:
                await_service(url)
            await_idle(clients[0])
            self._locks.stop()
            found = check(self._ledger.kept, clients, listeners, self._aging)
            for listener in listeners:
                listener.stop()
            memory = fleet.memory()
            fleet.stop()
            leftovers, damaged = fleet.fsck()
        unreceived = {name for one in injector.promotions for name in one.unreceived}
        window = {one.frame_id for one in self._ledger.kept} & unreceived
        return FleetFigures(
            plan=plan,
            found=found,
            kills=Counter(one.victim for one in injector.kills),
            outages=outages(injector.kills, log.waits),
            promotions=injector.promotions,
            waits_ms={
                kind: (1e3 * float(np.quantile(of, 0.5)), 1e3 * float(np.quantile(of, 0.99)))
                for kind, of in sorted(log.seconds.items())
            },
            memory=memory,
            answers=self._ledger.answers,
            repeated=log.repeated,
            faults=log.faults,
            damaged=damaged,
            leftovers=leftovers,
            lost=len(found.missing - window),
            window=len(window),
            locks=self._locks.shares,
            spooled=sum(one.map_name == OFFLINE_MAP for one in self._ledger.kept),
            spooled_twice=sum(one.there for one in offline),
            seconds=time.monotonic() - self._begun,
        )

    @property
    def _maps(self) -> list[str]:
        """Maps of the robots."""
        return list(dict.fromkeys([MAP, *map(self._plan.map_of, range(self._plan.robots))]))

    @property
    def _aging(self) -> dict[str, float]:
        """Seconds for which maps keep a frame, those that keep none for long."""
        kept_s = self._plan.retention_s
        return {} if kept_s is None else dict.fromkeys({*self._maps} - {MAP}, kept_s)

    def _walk(
        self, robots: list[Robot], others: list[Listener | OfflineRobot], injector: FaultInjector
    ) -> None:
        """Let all of them begin, inject the faults, and stop the robots when it is time."""
        plan, stop, fleet = self._plan, self._stop, self._fleet
        clients = [
            FailoverClient(fleet.urls, self._log, first=i) for i in range(min(plan.robots, DRIVERS))
        ]
        crowd = Crowd(robots, plan.rate, clients, self._ledger, self._log, stop)
        with tqdm(total=plan.seconds, unit="s", disable=None, leave=False) as bar:
            telling = threading.Thread(target=_tell, args=(bar, self._ledger, stop), daemon=True)
            walking = time.monotonic()
            for one in (*others, crowd, telling, self._locks):
                one.start()
            try:
                due = schedule(
                    plan.seconds, plan.kills, plan.promotions, self._rng, plan.freezes,
                    plan.partitions,
                )  # fmt: skip
                injector.run(due, bar.set_postfix_str)
                stop.wait(max(walking + plan.seconds - time.monotonic(), 0.0))
            finally:
                stop.set()
        crowd.join(PATIENCE_S)

    def _people(self, client: Client) -> tuple[list[Robot], list[Listener]]:
        """Robots with keys and maps, and who hears the events of each map."""
        plan = self._plan
        for name in self._maps:
            kept_s = self._aging.get(name)
            days = None if kept_s is None else kept_s / DAY_S
            client.create_map(name, model=MODEL, retention_days=days)
        robots = []
        for i, walk in enumerate(self._walked):
            name, map_name = f"robot-{i}", plan.map_of(i)
            key = client.create_key(name, {map_name: "write"}).secret
            # not all at the same moment
            begins_s = i / plan.robots / plan.rate
            robots.append(Robot(i, name, map_name, key, walk, begins_s))
        return robots, [self._listener(client, name) for name in self._maps]

    def _listener(self, client: Client, map_name: str) -> Listener:
        secret = client.create_key(f"listener-of-{map_name}", {map_name: "read"}).secret
        return Listener(map_name, secret, FailoverClient(self._fleet.urls, self._log))

    def _offline_robot(self, client: Client) -> list[OfflineRobot]:
        """The robot that is offline, if there is one."""
        if not self._spooled:
            return []
        client.create_map(OFFLINE_MAP, model=MODEL)
        name = "robot-offline"
        key = client.create_key(name, {OFFLINE_MAP: "write"}).secret
        robot = Robot(self._plan.robots, name, OFFLINE_MAP, key, self._spooled, 0.0)
        file, offline_s = self._fleet.folder / "spool.db", OFFLINE * self._plan.seconds
        return [OfflineRobot(robot, file, offline_s, self._fleet.urls, self._ledger, self._log)]


def _answers(url: str, *, key: str, shot: Shot) -> bool:
    """Whether a service answers a query."""
    return httpx.post(
        f"{url}/v1/maps/{MAP}/queries", headers=bearer(key), timeout=5,
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
