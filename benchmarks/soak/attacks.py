"""Attacks by one tenant, and the delays of other tenants during the attacks.

The attacks run in their own process, so they do not compete with other clients for an interpreter.
"""

from __future__ import annotations

import io
import json
import multiprocessing
import os
import socket
import time
import zipfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from multiprocessing.synchronize import Event
from typing import Any

import httpx
import numpy as np

from benchmarks.soak.failover_client import LATER, Exchange, RequestLog, bearer
from benchmarks.soak.recordings import Shot

#: Timeout of a request, seconds.
PATIENCE_S = 60.0
#: Session of the posed frames of `noisy`.
SESSION = "run"
#: Number of connections of an attack, independent of the number of its keys.
_CONNECTIONS = 40
#: Niceness of the attacking process, so that its own work does not slow other clients.
_NICENESS = 5
_PNG = {"Content-Type": "image/png"}
_FRAMES, _MAP = "/v1/maps/noisy/frames", "/v1/maps/noisy"


@dataclass
class Attack:
    """An attack by one tenant.

    Parameters
    ----------
    name, url : name of the attack, and address of the service
    secrets : keys of the attacker, all of one tenant
    shots : frames to upload to the map `noisy`
    """

    name: str
    url: str
    secrets: Sequence[str]
    shots: list[Shot]
    sent: int = 0
    refused: int = 0

    def count(self, status: int) -> None:
        """Record the status of an answer."""
        self.sent += 1
        self.refused += status in LATER

    def shot(self, number: int) -> Shot:
        """Return a frame to send."""
        return self.shots[number % len(self.shots)]


@dataclass(frozen=True)
class AttackFigures:
    """Delays of other tenants before and during an attack.

    Parameters
    ----------
    calm_s, under_s : 99th percentiles, seconds, of requests and of the time until frames are signed
    victim_refused : number of repetitions of requests of other tenants
    sent, refused : number of requests of the attacker, and of rejected requests among them
    """

    name: str
    calm_s: tuple[float, float]
    under_s: tuple[float, float]
    victim_refused: int
    sent: int
    refused: int


#: Event that ends the attack.
_stop: list[Event] = []


def _prepare(stop: Event) -> None:
    _stop.append(stop)
    os.nice(_NICENESS)


def _attack(attack: Attack) -> tuple[int, int]:
    """Attack until the event is set; return the numbers of sent and rejected requests."""
    ATTACKS[attack.name](attack)
    return attack.sent, attack.refused


def run_attacks(
    url: str, secrets: Sequence[str], shots: list[Shot], seconds: float, log: RequestLog,
    drain: Callable[[], None], names: Sequence[str] = (),
) -> Iterator[AttackFigures]:  # fmt: skip
    """Yield the figures of every attack, each after an equally long period without an attack.

    Parameters
    ----------
    seconds : duration of each attack
    log : requests of the other tenants
    drain : function that removes the jobs of an attack from the queue
    names : names of the attacks; default: all
    """
    spawn = multiprocessing.get_context("spawn")
    stop = spawn.Event()
    with ProcessPoolExecutor(1, spawn, _prepare, (stop,)) as pool:
        pool.submit(os.getpid).result()  # waits until the process has started
        for name in names or ATTACKS:
            stop.clear()
            begun = time.monotonic()
            time.sleep(seconds)
            running = pool.submit(_attack, Attack(name, url, secrets, shots))
            time.sleep(min(seconds / 4, 1.0))  # waits until the attack has started
            middle = time.monotonic()
            time.sleep(seconds)
            stop.set()
            sent, refused = running.result()
            drain()  # meanwhile, pending requests of others are answered
            calm, under = (_percentiles(log, start, start + seconds) for start in (begun, middle))
            repeated = sum(e.tries - 1 for e in _between(log, middle, middle + seconds))
            yield AttackFigures(name, calm, under, repeated, sent, refused)


def _between(log: RequestLog, first: float, last: float) -> list[Exchange]:
    """Return the requests that were open at any time in an interval."""
    with log.lock:
        return [e for e in log.exchanges if e.begun <= last and e.answered >= first]


def _percentiles(log: RequestLog, first: float, last: float) -> tuple[float, float]:
    """Return the 99th percentiles of requests, and of the time from upload to signing, seconds."""
    own = _between(log, first, last)
    signed = [exchange.answered - exchange.begun for exchange in own if exchange.kind == "upload"]
    other = [exchange.answered - exchange.begun for exchange in own if exchange.kind != "upload"]
    if not signed or not other:
        raise RuntimeError("No other tenant received an answer.")
    return float(np.percentile(other, 99)), float(np.percentile(signed, 99))


def attack_table(attacks: Sequence[AttackFigures]) -> list[str]:
    """Return the figures as lines of Markdown."""
    lines = [
        "| attack | request p99, calm | under attack | ratio | frame signed p99, calm "
        "| under attack | ratio | victim refused | attacker sent | refused |",
        "|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for attack in attacks:
        times = " | ".join(
            f"{1e3 * calm:.0f} ms | {1e3 * under:.0f} ms | {under / calm:.1f}"
            for calm, under in zip(attack.calm_s, attack.under_s, strict=True)
        )
        lines.append(
            f"| {attack.name} | {times} | **{attack.victim_refused}** | {attack.sent} "
            f"| {attack.refused} |"
        )
    return lines


Send = Callable[[Attack, httpx.Client, int], httpx.Response]


def _frame(attack: Attack, client: httpx.Client, number: int) -> httpx.Response:
    """Upload a new frame with the highest priority."""
    shot = attack.shot(number)
    return client.put(
        f"{_FRAMES}/noise-{time.monotonic_ns()}-{number}", content=shot.png, headers=_PNG,
        params={"meta": shot.meta.model_dump_json(), "priority": "10"},
    )  # fmt: skip


def _same_frame(attack: Attack, client: httpx.Client, number: int) -> httpx.Response:
    """Upload a stored frame with a new Idempotency-Key."""
    shot = attack.shot(0)
    key = {"Idempotency-Key": f"{time.monotonic_ns()}-{number}"}
    meta = {"meta": shot.meta.model_dump_json()}
    return client.post(_FRAMES, content=shot.png, headers=_PNG | key, params=meta)


def _archive(attack: Attack, client: httpx.Client, number: int) -> httpx.Response:
    """Import an archive of all frames with new bytes."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        camera = attack.shot(0).meta.intrinsics
        assert camera is not None
        archive.writestr("run/intrinsics.json", json.dumps(camera.model_dump(mode="json")))
        archive.writestr("run/note.bin", f"{time.monotonic_ns()}-{number}".encode() * 100_000)
        for i, shot in enumerate(attack.shots):
            archive.writestr(f"run/{i}.png", shot.png)
    kind = {"Content-Type": "application/zip"}
    return client.post(f"{_MAP}/imports", content=file.getvalue(), headers=kind)


def _query(attack: Attack, client: httpx.Client, number: int) -> httpx.Response:
    shot = attack.shot(number)
    meta = {"meta": shot.meta.model_dump_json()}
    return client.post(f"{_MAP}/queries", content=shot.png, headers=_PNG, params=meta)


def _session(attack: Attack, client: httpx.Client, _number: int) -> httpx.Response:
    """Delete a whole session and restore it."""
    answer = client.delete(f"{_MAP}/sessions", params={"session": SESSION})
    attack.count(answer.status_code)
    if answer.status_code != 200:
        return answer
    deletion = (answer.json()["deletion"] or {}).get("deletion_id", "none")
    return client.post(f"{_MAP}/deletions/{deletion}/restore")


def _unknown_key(_attack: Attack, client: httpx.Client, number: int) -> httpx.Response:
    return client.get("/v1/keys/me", headers=bearer(f"made-up-{time.monotonic_ns()}-{number}"))


def _rename(_attack: Attack, client: httpx.Client, _number: int) -> httpx.Response:
    return client.patch(_MAP, json={"title": str(time.monotonic_ns())})


def _surface(_attack: Attack, client: httpx.Client, number: int) -> httpx.Response:
    """Build the surface; in three of four calls, render a plan of it."""
    if number % 4 == 0:
        return client.post(f"{_MAP}/surface", json={})
    return client.get(f"{_MAP}/surface/plan.png?width={256 + number % 1000}")


def _gets(*paths: str) -> Send:
    """Return an attack by GET of alternating paths, in which `FRAME` is an indexed frame."""
    indexed: list[str] = []

    def send(_attack: Attack, client: httpx.Client, number: int) -> httpx.Response:
        if not indexed:
            page = client.get(_FRAMES, params={"state": "indexed", "limit": "1"})
            if page.status_code != 200:
                return page
            indexed.append(page.json()["items"][0]["frame_id"])
        return client.get(paths[number % len(paths)].replace("FRAME", indexed[0]))

    return send


def _posts(path: str, body: dict[str, Any]) -> Send:
    return lambda _, client, __: client.post(path, json=body)


def _repeat(send: Send, connections: int = _CONNECTIONS) -> Callable[[Attack], None]:
    """Return an attack by consecutive requests on several connections."""

    def work(attack: Attack, first: int) -> None:
        number = first
        headers = bearer(attack.secrets[first % len(attack.secrets)])
        with httpx.Client(
            base_url=attack.url, headers=headers, timeout=PATIENCE_S, trust_env=False
        ) as client:
            while not _stop[0].is_set():
                try:
                    attack.count(send(attack, client, number // connections).status_code)
                except httpx.HTTPError:
                    attack.count(503)
                number += connections

    def repeat(attack: Attack) -> None:
        with ThreadPoolExecutor(connections) as pool:
            list(pool.map(partial(work, attack), range(connections)))

    return repeat


def _hold(
    line: str, head: str, *, body: bytes = b"", two: bool = False, count: int = _CONNECTIONS
) -> Callable[[Attack], None]:
    """Return an attack by incomplete requests on connections that are reopened when closed.

    Parameters
    ----------
    line, head, body : parts of each request
    two : whether each request has a second, invalid Authorization header
    count : number of connections
    """

    def connect(attack: Attack, wire: socket.socket, number: int) -> None:
        url, secret = httpx.URL(attack.url), attack.secrets[number % len(attack.secrets)]
        again = f"Authorization: Bearer made-up-{number}\r\n" if two else ""
        wire.settimeout(1.0)
        try:
            wire.connect((url.host, url.port))
            text = f"{line} HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {secret}"
            wire.sendall(f"{text}\r\n{again}{head}\r\n".encode() + body)
            attack.count(int(wire.recv(12)[9:12] or b"0"))
        except TimeoutError:
            attack.count(0)  # the connection stays open
        except OSError:
            attack.count(503)

    def hold(attack: Attack) -> None:
        with ExitStack() as stack:
            while not _stop[0].is_set():
                for number in range(count):
                    connect(attack, stack.enter_context(socket.socket()), number)
                    if _stop[0].is_set():
                        return
                _stop[0].wait(2.0)
                stack.close()

    return hold


#: Attacks by their names in the table.
ATTACKS: dict[str, Callable[[Attack], None]] = {
    # Bodies without an end.
    "held queries, two headers": _hold(
        f"POST {_MAP}/queries", "Content-Length: 5000\r\n", two=True
    ),
    "event streams": _hold("GET /v1/events", "Accept: text/event-stream\r\n", count=80),
    # Bodies whose last part never arrives.
    "large slow bodies": _hold(
        f"POST {_FRAMES}",
        "Content-Type: application/octet-stream\r\nContent-Length: 70000000\r\n",
        body=bytes(8 << 20), count=16,
    ),
    "queue at priority 10": _repeat(_frame, 4),
    "one frame, many Idempotency-Keys": _repeat(_same_frame),
    "archives": _repeat(_archive, 4),
    "pages of 200 rows": _repeat(_gets(f"{_FRAMES}?limit=200")),
    "all other lists": _repeat(
        _gets(
            "/v1/jobs?limit=1000", "/v1/events?after=0&limit=1000", "/v1/queries?limit=1000",
            f"{_MAP}/sessions?limit=1000", f"{_MAP}/deletions?limit=1000",
        )
    ),
    "queries": _repeat(_query),
    "clouds and pictures": _repeat(
        _gets(f"{_FRAMES}/FRAME/cloud.ply", f"{_FRAMES}/FRAME/preview.png")
    ),
    "edits, each audited": _repeat(_rename),
    "unknown keys": _repeat(_unknown_key),
    "refused requests, audited": _repeat(_posts("/v1/keys", {})),
    "sessions deleted and restored": _repeat(_session, 4),
    "coverage": _repeat(_posts(f"{_MAP}/coverage", {}), 4),
    "associations": _repeat(_posts(f"{_MAP}/associations", {"sessions": [SESSION]}), 4),
    "surface and its plan": _repeat(_surface),
}  # fmt: skip
