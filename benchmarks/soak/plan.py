"""Plans of a soak: a store, robots, and faults to inject."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from benchmarks.soak.failover_client import SILENCE_S

#: Names of faults on the command line. A kill hits a service, a worker or a signing process. The
#: number of `operation` is the requests per operation, of `attack` the seconds per attack.
FAULTS = (
    "kill", "failover", "freeze", "partition", "full-disk", "offline-hour",
    "broken-upload", "attack", "operation",
)  # fmt: skip
#: Name and model of the map that most robots share. Every fourth robot uses one of 19 other maps.
MAP, MODEL, OWN, OWN_MAPS = "fleet", "depth", 4, 19
#: Number of robots from which surfaces are not built automatically.
CROWD = 100


@dataclass(frozen=True)
class Plan:
    """Settings of a run.

    Parameters
    ----------
    faults : number of each fault; for the offline hour, the number of frames that a robot spools
    attacks : names of the attacks; default: all
    seconds : duration of the walks; attacks may end earlier
    robots, rate : number of robots, and frames per second of each
    signed : whether robots wait until their frame is signed
    readers : number of clients that repeat exact searches
    services, workers : number of processes
    asynchronous : whether the standby may lack acknowledged rows
    objects, delays : whether blobs are in an object store, and whether messages are delayed
    retention_s : retention of the maps of single robots, seconds; the shared map has no retention
    most_turn_ms : maximum time for which a frame may block all writers, excluding the time of
        network partitions
    most_query_ms, most_bytes : bounds of the 99th percentile of queries, and of a process's memory
    data : folder of recordings; default: synthetic rooms
    """

    store: Literal["sqlite", "postgresql"] = "postgresql"
    faults: Mapping[str, int] = field(default_factory=dict)
    attacks: Sequence[str] = ()
    seconds: float = 120.0
    robots: int = 8
    rate: float = 1.0
    signed: bool = False
    readers: int = 2
    services: int = 2
    workers: int = 4
    asynchronous: bool = False
    objects: bool = False
    delays: bool = False
    retention_s: float | None = None
    most_turn_ms: float = 50.0
    most_query_ms: float = 1e3 * (SILENCE_S + 5)
    most_bytes: int = 1 << 30
    seed: int = 0
    data: Path | None = None

    def count(self, fault: str) -> int:
        """Return the number of injections of a fault."""
        return self.faults.get(fault, 0)

    @property
    def is_crowd(self) -> bool:
        """Return whether there are too many robots to build surfaces."""
        return self.robots >= CROWD

    @property
    def frames(self) -> int:
        """Maximum number of frames that a robot sends."""
        return int(self.seconds * self.rate) + 1

    def map_of(self, robot: int) -> str:
        """Return the name of the map of a robot."""
        own = robot % OWN == OWN - 1
        if self.retention_s is not None:  # most frames are to be deleted
            own = not own
        return f"{MAP}-{robot % (OWN * OWN_MAPS)}" if own else MAP


_FLEET = {"kill": 20, "failover": 2}
#: Plans by the marks of their tables in docs/fault_injection.md.
PLANS = {
    "soak": Plan("sqlite", {"kill": 100, "full-disk": 3}, seconds=400, workers=2, rate=0.5),
    "soak-crowd": Plan("sqlite", workers=2, rate=2.0, readers=8),
    "siege": Plan(
        "sqlite", {"broken-upload": 20_000, "attack": 5, "operation": 20}, robots=2, rate=2.0,
        seconds=900, signed=True, services=1, workers=1,
    ),
    "fleet": Plan(faults=_FLEET),
    "fleet-asynchronous": Plan(faults=_FLEET, asynchronous=True),
    "fleet-delays": Plan(faults={**_FLEET, "freeze": 2}, objects=True, delays=True),
    "fleet-crowd": Plan(
        faults={"kill": 12, "failover": 1, "freeze": 1, "partition": 2, "offline-hour": 360},
        robots=1000, rate=0.003, seconds=200, objects=True, delays=True, retention_s=40,
    ),
}  # fmt: skip
