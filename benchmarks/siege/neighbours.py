"""Noisy neighbours: keys of one tenant do their worst while another tenant works.

attack, number of keys  --besiege_neighbour-->  NeighbourFigures
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from multiprocessing.synchronize import Event
from typing import Any

import numpy as np

from benchmarks.siege.attacks import AWAY, Order, client_of
from benchmarks.soak.load import Shot

#: Bytes of a body that is spooled to disk, and that is no frame.
_JUNK = bytes(2 << 20)


@dataclass
class VictimFigures:
    """What the other tenant met.

    Parameters
    ----------
    requests_s : time of each request
    signed_s : time of each frame, from its upload until it was signed
    refused : requests that were sent away, or failed
    """

    requests_s: list[float] = field(default_factory=list)
    signed_s: list[float] = field(default_factory=list)
    refused: int = 0


@dataclass(frozen=True)
class NeighbourFigures:
    """What came of one attack.

    Parameters
    ----------
    attack, keys : which, and with how many keys of one tenant
    calm, under : the victim just before it, and beside it
    sent, refused : requests of the attacker, and those of them that were sent away
    """

    attack: str
    keys: int
    calm: VictimFigures
    under: VictimFigures
    sent: int
    refused: int

    @property
    def request_ratio(self) -> float:
        """How many times as long the slowest percent of the victim's requests took."""
        return p99(self.under.requests_s) / p99(self.calm.requests_s)

    @property
    def signed_ratio(self) -> float:
        """Likewise of frames, until they were signed."""
        return p99(self.under.signed_s) / p99(self.calm.signed_s)


def p99(seconds: Sequence[float]) -> float:
    """The 99th percentile."""
    return float(np.percentile(seconds, 99))


def work_as_victim(url: str, secret: str, shots: list[Shot], seconds: float) -> VictimFigures:
    """Ask, list, listen, upload and query, one after the other, for some time, once at least."""
    found, until, number = VictimFigures(), time.perf_counter() + seconds, 0
    own = {"Content-Type": "image/png"}
    with client_of(url, secret) as client:
        while number == 0 or time.perf_counter() < until:
            shot = shots[number % len(shots)]
            meta = {"meta": shot.meta.model_dump_json()}
            junk = {"Content-Type": "application/octet-stream"}
            for method, path, more in (
                ("GET", "/v1/keys/me", {}),
                ("GET", "/v1/maps/victim/frames?limit=10", {}),
                ("POST", "/v1/maps/victim/queries", {"content": _JUNK, "headers": junk}),
                ("POST", "/v1/maps/victim/queries",
                 {"content": shot.png, "params": meta, "headers": own}),
            ):  # fmt: skip
                start = time.perf_counter()
                status = client.request(method, path, **more).status_code  # type: ignore[arg-type]
                found.requests_s.append(time.perf_counter() - start)
                found.refused += status >= 500 or status in AWAY
            with client.stream("GET", "/v1/events", headers={"Accept": "text/event-stream"}) as one:
                found.refused += one.status_code != 200
            start = time.perf_counter()
            frame_id = f"own-{time.monotonic_ns()}"
            answer = client.put(
                f"/v1/maps/victim/frames/{frame_id}", content=shot.png, params=meta,
                headers=own | {"Prefer": "wait=50"},
            )  # fmt: skip
            found.signed_s.append(time.perf_counter() - start)
            found.refused += answer.status_code != 201
            number += 1
    return found


def besiege_neighbour(
    order: Order, begin: Callable[[Order], Any], stop: Event, victim: str, seconds: float
) -> NeighbourFigures:
    """Let one tenant attack while another works.

    Parameters
    ----------
    order : what the attacker does; its service has the maps `noisy` and `victim`
    begin, stop : of the attacker: see `attacks.attacker`
    victim : key of the other tenant
    seconds : of the attack, and before it of calm
    """
    calm = work_as_victim(order.url, victim, order.shots, seconds)
    stop.clear()
    running = begin(order)
    try:
        time.sleep(min(seconds / 4, 1.0))  # so that it has begun
        under = work_as_victim(order.url, victim, order.shots, seconds)
    finally:
        stop.set()
    sent, refused = running.result()
    return NeighbourFigures(order.name, len(order.secrets), calm, under, sent, refused)


def neighbour_table(found: Sequence[NeighbourFigures]) -> list[str]:
    """The figures as lines of Markdown: a line for each attack, medians over its rounds."""

    def ms(rounds: Sequence[Sequence[float]]) -> str:
        return f"{1e3 * float(np.median([p99(one) for one in rounds])):.0f} ms"

    lines = [
        "| attack | keys | request p99, calm | under attack | ratio | frame signed p99, calm "
        "| under attack | ratio | victim refused | attacker sent | refused |",
        "|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for name in dict.fromkeys(one.attack for one in found):
        rounds = [one for one in found if one.attack == name]
        keys = sorted({one.keys for one in rounds})
        request = float(np.median([one.request_ratio for one in rounds]))
        signed = float(np.median([one.signed_ratio for one in rounds]))
        lines.append(
            f"| {name} | {', '.join(map(str, keys))} "
            f"| {ms([one.calm.requests_s for one in rounds])} "
            f"| {ms([one.under.requests_s for one in rounds])} | {request:.1f} "
            f"| {ms([one.calm.signed_s for one in rounds])} "
            f"| {ms([one.under.signed_s for one in rounds])} | {signed:.1f} "
            f"| **{sum(one.under.refused for one in rounds)}** "
            f"| {sum(one.sent for one in rounds)} | {sum(one.refused for one in rounds)} |"
        )
    return lines
