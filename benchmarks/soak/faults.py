"""Fault injection at random times: processes are killed, frozen or cut off, and the disk fills."""

from __future__ import annotations

import os
import random
import signal
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field

import httpx

from benchmarks.soak.plan import Plan
from benchmarks.soak.processes import Fleet, await_service

#: Relative frequencies of killed processes; a worker supervises a separate signing process.
VICTIMS = {"service": 3, "worker": 2, "signing process": 2}
PRIMARY, FROZEN, CUT_OFF = "primary", "frozen primary", "network of a host"
FULL = "full disk"
#: Faults at random times, by their names in a schedule.
AT_RANDOM = {"freeze": FROZEN, "partition": CUT_OFF, "full-disk": FULL}
#: Duration of the freeze of a primary, seconds, shorter than the timeout of a connection.
FROZEN_S = 5.0
#: Duration of the network partition of a host, seconds, longer than the lease of a job.
CUT_OFF_S = 12.0
#: Duration for which the disk is full, seconds.
FULL_S = 6.0
#: Share of the run without faults, at its start and at its end.
CALM = 0.1
#: Range of the delay before a killed part restarts, and delay before the promotion, seconds.
AWAY_S, UNNOTICED_S = (0.0, 3.0), 1.0
#: Time without replication before the primary of an asynchronous standby is killed, seconds.
STALL_S = 2.0


@dataclass(frozen=True)
class Kill:
    """A fault, with times by `time.monotonic`."""

    victim: str
    at: float


@dataclass(frozen=True)
class Promotion:
    """Promotion of a standby to primary.

    Parameters
    ----------
    killed, promoted : times of the kill and the promotion
    resumed : seconds until each service, by address, answered a query again
    unreceived : ids of frames that the standby had not received
    """

    killed: float
    promoted: float
    resumed: dict[str, float]
    unreceived: frozenset[str]


def schedule(
    seconds: float, faults: Mapping[str, int], rng: random.Random
) -> list[tuple[float, str]]:
    """Return the times of the faults, in seconds from the start, with their kinds."""
    first, last = CALM * seconds, (1 - CALM) * seconds
    victims = rng.choices(list(VICTIMS), list(VICTIMS.values()), k=faults.get("kill", 0))
    due = [(rng.uniform(first, last), victim) for victim in victims]
    promotions = faults.get("failover", 0)
    part = (last - first) / max(promotions, 1)
    due += [(first + part * (i + rng.random()), PRIMARY) for i in range(promotions)]
    for fault, name in AT_RANDOM.items():
        due += [(rng.uniform(first, last), name) for _ in range(faults.get(fault, 0))]
    return sorted(due)


@dataclass
class FaultInjector:
    """Injector of a schedule of faults.

    Parameters
    ----------
    fleet, plan : processes and plan of the run
    answers : function that returns whether a service answers a query
    rng : generator that selects the victims
    """

    fleet: Fleet
    plan: Plan
    answers: Callable[[str], bool]
    rng: random.Random
    kills: list[Kill] = field(default_factory=list)
    promotions: list[Promotion] = field(default_factory=list)

    def run(self, due: list[tuple[float, str]], show: Callable[[str], None]) -> None:
        """Inject each fault when it is due and the previous fault is over."""
        begun = time.monotonic()
        inject = {
            PRIMARY: self._promote, FROZEN: self._freeze, CUT_OFF: self._cut_off,
            FULL: self._fill_disk,
        }  # fmt: skip
        for at, victim in due:
            time.sleep(max(begun + at - time.monotonic(), 0.0))
            show(victim)
            if victim in inject:
                self.kills.append(Kill(victim, time.monotonic()))
                inject[victim]()
            else:
                self._kill(victim)

    def _kill(self, victim: str) -> None:
        part = self.rng.choice(self.fleet.services if victim == "service" else self.fleet.workers)
        if victim == "signing process" and (signing := part.children()):
            self.kills.append(Kill(victim, time.monotonic()))
            with suppress(ProcessLookupError):
                os.kill(signing[0], signal.SIGKILL)
            return
        self.kills.append(Kill("service" if victim == "service" else "worker", time.monotonic()))
        part.kill()
        time.sleep(self.rng.uniform(*AWAY_S))
        part.start()

    def _freeze(self) -> None:
        assert self.fleet.pair is not None
        with self.fleet.pair.frozen():
            time.sleep(FROZEN_S)

    def _cut_off(self) -> None:
        with self.fleet.partitioned(self.rng.randrange(len(self.fleet.services))):
            time.sleep(CUT_OFF_S)

    def _fill_disk(self) -> None:
        """Fill the disk when all services are ready, because none can start on a full disk."""
        for url in self.fleet.urls:
            await_service(url)
        with self.fleet.full_disk():
            time.sleep(FULL_S)
        for part in (*self.fleet.services, *self.fleet.workers):
            if not part.is_running:  # a killed worker that could not restart
                part.start()

    def _promote(self) -> None:
        """Kill the primary, promote its standby, and measure the time until queries succeed."""
        pair, urls = self.fleet.pair, self.fleet.urls
        assert pair is not None
        for url in urls:
            await_service(url)
        if self.plan.asynchronous:
            pair.stall()
            time.sleep(STALL_S)
        killed = time.monotonic()
        self.kills[-1] = Kill(PRIMARY, killed)
        pair.primary.kill()
        time.sleep(UNNOTICED_S)
        pair.promote()
        promoted = time.monotonic()
        resumed: dict[str, float] = {}
        with ThreadPoolExecutor(len(urls)) as pool:
            for url in urls:
                pool.submit(self._watch, url, promoted, resumed)
            unreceived = pair.unreceived()
        self.promotions.append(Promotion(killed, promoted, resumed, frozenset(unreceived)))
        pair.renew()

    def _watch(self, url: str, promoted: float, resumed: dict[str, float]) -> None:
        """Record when a service answers a query again."""
        resumed[url] = float("inf")
        while time.monotonic() < promoted + 120:
            with suppress(httpx.TransportError):
                if self.answers(url):
                    resumed[url] = time.monotonic() - promoted
                    return
            time.sleep(0.1)
