"""Injected faults: parts of the fleet killed at random, started again, and when.

schedule(seconds, kills, promotions, seed)  -->  FaultInjector.run  -->  kills, promotions
"""

from __future__ import annotations

import os
import random
import signal
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field

import httpx

from benchmarks.fleet.fleet import Fleet, Process, await_service

#: How often each is killed, in proportion: the process that signs, as well as who keeps it.
VICTIMS = {"service": 3, "worker": 2, "signing process": 2}
PRIMARY, FROZEN, CUT_OFF = "primary", "frozen primary", "network of a host"
#: Seconds for which a primary is frozen: less than a connection is believed to live.
FROZEN_S = 5.0
#: Seconds for which a host does not reach the servers: longer than workers have a job for.
CUT_OFF_S = 12.0
#: Part of the time before the first and after the last kill.
CALM = 0.1
#: Seconds until a killed part begins again; and until somebody promotes the standby.
AWAY_S, UNNOTICED_S = (0.0, 3.0), 1.0
#: Seconds for which nothing comes to an asynchronous standby before its primary dies.
STALL_S = 2.0
#: Seconds between two looks whether an address answers queries.
LOOK_S = 0.1


@dataclass(frozen=True)
class Kill:
    """A part was killed; times of `time.monotonic`."""

    victim: str
    at: float


@dataclass(frozen=True)
class Promotion:
    """A standby took the place of its primary.

    Parameters
    ----------
    stalled : when the standby received no more; None where it did to the end
    killed, promoted : when
    resumed : by address of a service, seconds until it answered a query again
    unreceived : ids of the frames that the standby had not received
    """

    stalled: float | None
    killed: float
    promoted: float
    resumed: dict[str, float]
    unreceived: frozenset[str]


def schedule(
    seconds: float, kills: int, promotions: int, rng: random.Random, freezes: int = 0,
    partitions: int = 0,
) -> list[tuple[float, str]]:  # fmt: skip
    """Seconds from the beginning, and what is killed then."""
    first, last = CALM * seconds, (1 - CALM) * seconds
    victims = rng.choices(list(VICTIMS), list(VICTIMS.values()), k=kills)
    told = [(rng.uniform(first, last), victim) for victim in victims]
    part = (last - first) / max(promotions, 1)
    told += [(first + part * (i + rng.random()), PRIMARY) for i in range(promotions)]
    told += [(rng.uniform(first, last), FROZEN) for _ in range(freezes)]
    told += [(rng.uniform(first, last), CUT_OFF) for _ in range(partitions)]
    return sorted(told)


@dataclass
class FaultInjector:
    """Works through a schedule.

    Parameters
    ----------
    fleet : whose parts are killed
    asked : a query that any service must answer
    rng : of the victims
    asynchronous : whether a standby is first cut off from its primary
    """

    fleet: Fleet
    asked: Callable[[str], bool]
    rng: random.Random
    asynchronous: bool = False
    kills: list[Kill] = field(default_factory=list)
    promotions: list[Promotion] = field(default_factory=list)

    def run(self, due: list[tuple[float, str]], tell: Callable[[str], None]) -> None:
        """Kill what is due when it is due; later where the part before is not back yet."""
        begun = time.monotonic()
        for at, victim in due:
            time.sleep(max(begun + at - time.monotonic(), 0.0))
            tell(victim)
            if victim == PRIMARY:
                self._promote()
            elif victim == FROZEN:
                self.kills.append(Kill(victim, time.monotonic()))
                with self.fleet.pair.frozen():
                    time.sleep(FROZEN_S)
            elif victim == CUT_OFF:
                self.kills.append(Kill(victim, time.monotonic()))
                with self.fleet.partitioned(self.rng.randrange(len(self.fleet.services))):
                    time.sleep(CUT_OFF_S)
            else:
                self._kill(victim)

    def _kill(self, victim: str) -> None:
        if victim == "service":
            self._again(self.rng.choice(self.fleet.services), victim)
            return
        worker = self.rng.choice(self.fleet.workers)
        signing = worker.children() if victim == "signing process" else []
        if not signing:
            self._again(worker, "worker")
            return
        self.kills.append(Kill(victim, time.monotonic()))
        with suppress(ProcessLookupError):
            os.kill(signing[0], signal.SIGKILL)

    def _again(self, part: Process, victim: str) -> None:
        self.kills.append(Kill(victim, time.monotonic()))
        part.kill()
        time.sleep(self.rng.uniform(*AWAY_S))
        part.begin()

    def _promote(self) -> None:
        """Kill the primary, let its standby follow it, and see how soon queries are answered."""
        pair, urls = self.fleet.pair, self.fleet.urls
        for url in urls:
            await_service(url)
        stalled = None
        if self.asynchronous:
            pair.stall()
            stalled = time.monotonic()
            time.sleep(STALL_S)
        killed = time.monotonic()
        self.kills.append(Kill(PRIMARY, killed))
        pair.kill_primary()
        time.sleep(UNNOTICED_S)
        pair.promote()
        promoted = time.monotonic()
        resumed: dict[str, float] = {}
        watching = [
            threading.Thread(target=self._watch, args=(url, promoted, resumed)) for url in urls
        ]
        for one in watching:
            one.start()
        unreceived = pair.unreceived()
        for one in watching:
            one.join()
        self.promotions.append(Promotion(stalled, killed, promoted, resumed, frozenset(unreceived)))
        pair.renew()

    def _watch(self, url: str, promoted: float, resumed: dict[str, float]) -> None:
        """Note when a service answers a query again."""
        while time.monotonic() < promoted + 120:
            with suppress(httpx.TransportError):
                if self.asked(url):
                    resumed[url] = time.monotonic() - promoted
                    return
            time.sleep(LOOK_S)
        resumed[url] = float("inf")
