"""Attacks of one tenant, and how long others wait meanwhile.

Attacks run in a process of their own, which stands for other machines: within the process of the
other clients they would take turns at its interpreter.
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
from multiprocessing.synchronize import Event
from typing import Any

import httpx
import numpy as np

from benchmarks.soak.failover_client import LATER, Exchange, RequestLog, bearer
from benchmarks.soak.recordings import Shot

#: Seconds that a request may take.
PATIENCE_S = 60.0
#: Session of the frames of `noisy` that have poses.
SESSION = "run"
#: Connections that an attack has in all, whatever the number of its keys.
_CONNECTIONS = 40
#: A client sends for little, a service works for much: else the attacker's own work would be
#: what its victim waits for, as all share the processors here.
_NICENESS = 5
_PNG = {"Content-Type": "image/png"}


@dataclass
class Attack:
    """An attack of one tenant.

    Parameters
    ----------
    name : of the attack
    url : of the service
    secrets : keys of the attacker, all of one tenant
    shots : frames to upload to the map `noisy`, which has some
    """

    name: str
    url: str
    secrets: Sequence[str]
    shots: list[Shot]
    sent: int = 0
    refused: int = 0

    def count(self, status: int) -> None:
        """Count an answer."""
        self.sent += 1
        self.refused += status in LATER

    def shot(self, number: int) -> Shot:
        """Return a frame to send."""
        return self.shots[number % len(self.shots)]


@dataclass(frozen=True)
class AttackFigures:
    """The other tenants just before an attack, and during it.

    Parameters
    ----------
    name : of the attack
    calm_s, under_s : 99th percentiles of requests, and of frames until they are signed, seconds
    victim_refused : requests of the other tenants that had to be repeated
    sent, refused : requests of the attacker, and those that were sent away
    """

    name: str
    calm_s: tuple[float, float]
    under_s: tuple[float, float]
    victim_refused: int
    sent: int
    refused: int


#: Set when the attack is to end.
_stop: list[Event] = []


def _prepare(stop: Event) -> None:
    _stop.append(stop)
    os.nice(_NICENESS)


def _attack(attack: Attack) -> tuple[int, int]:
    """Attack until the event is set; return the requests sent and refused."""
    ATTACKS[attack.name](attack)
    return attack.sent, attack.refused


def run_attacks(
    url: str, secrets: Sequence[str], shots: list[Shot], seconds: float, log: RequestLog,
    drain: Callable[[], None],
) -> Iterator[AttackFigures]:  # fmt: skip
    """Run every attack while others work, after as long a time without it.

    Parameters
    ----------
    url, secrets, shots : see Attack
    seconds : of each attack
    log : of the other tenants
    drain : removes what an attack leaves in the queue
    """
    spawn = multiprocessing.get_context("spawn")
    stop = spawn.Event()
    with ProcessPoolExecutor(1, spawn, _prepare, (stop,)) as pool:
        pool.submit(os.getpid).result()  # its code is loaded
        for name in ATTACKS:
            stop.clear()
            begun = time.monotonic()
            time.sleep(seconds)
            running = pool.submit(_attack, Attack(name, url, secrets, shots))
            time.sleep(min(seconds / 4, 1.0))  # so that it has begun
            middle = time.monotonic()
            time.sleep(seconds)
            stop.set()
            sent, refused = running.result()
            drain()  # what others sent meanwhile is answered then
            calm, under = (_percentiles(log, one, one + seconds) for one in (begun, middle))
            repeated = sum(one.tries - 1 for one in _between(log, middle, middle + seconds))
            yield AttackFigures(name, calm, under, repeated, sent, refused)


def _between(log: RequestLog, first: float, last: float) -> list[Exchange]:
    """Return the requests that were on their way at some time."""
    with log.lock:
        return [one for one in log.exchanges if one.begun <= last and one.answered >= first]


def _percentiles(log: RequestLog, first: float, last: float) -> tuple[float, float]:
    """Return 99th percentiles of requests, and of uploads until their frames were signed."""
    own = _between(log, first, last)
    signed = [one.answered - one.begun for one in own if one.kind == "upload"]
    other = [one.answered - one.begun for one in own if one.kind != "upload"]
    if not signed or not other:
        raise RuntimeError("no other tenant was answered")
    return float(np.percentile(other, 99)), float(np.percentile(signed, 99))


def attack_table(found: Sequence[AttackFigures]) -> list[str]:
    """Return the figures as lines of Markdown."""
    lines = [
        "| attack | request p99, calm | under attack | ratio | frame signed p99, calm "
        "| under attack | ratio | victim refused | attacker sent | refused |",
        "|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for one in found:
        times = " | ".join(
            f"{1e3 * calm:.0f} ms | {1e3 * under:.0f} ms | {under / calm:.1f}"
            for calm, under in zip(one.calm_s, one.under_s, strict=True)
        )
        lines.append(
            f"| {one.name} | {times} | **{one.victim_refused}** | {one.sent} | {one.refused} |"
        )
    return lines


# Connections that are held.


def hold_two_headers(attack: Attack) -> None:
    """Queries whose bodies never end, each with a second, made-up Authorization header."""
    _hold(attack, "POST /v1/maps/noisy/queries", "Content-Length: 5000\r\n", two=True)


def hold_streams(attack: Attack) -> None:
    """As many event streams as connections, as dashboards and listeners hold."""
    _hold(attack, "GET /v1/events", "Accept: text/event-stream\r\n", count=80)


def hold_bodies(attack: Attack) -> None:
    """Large bodies of which most comes, and the rest never does."""
    head = "Content-Type: application/octet-stream\r\nContent-Length: 70000000\r\n"
    _hold(attack, "POST /v1/maps/noisy/frames", head, body=bytes(8 << 20), count=16)


# Requests again and again.

Send = Callable[[Attack, httpx.Client, int], httpx.Response]


def _frame(attack: Attack, client: httpx.Client, number: int) -> httpx.Response:
    """A new frame at the highest priority."""
    shot = attack.shot(number)
    return client.put(
        f"/v1/maps/noisy/frames/noise-{time.monotonic_ns()}-{number}", content=shot.png,
        params={"meta": shot.meta.model_dump_json(), "priority": "10"}, headers=_PNG,
    )  # fmt: skip


def _same_frame(attack: Attack, client: httpx.Client, number: int) -> httpx.Response:
    """A frame that is there, each time with another Idempotency-Key."""
    shot = attack.shot(0)
    key = {"Idempotency-Key": f"{time.monotonic_ns()}-{number}"}
    return client.post(
        "/v1/maps/noisy/frames", content=shot.png, headers=_PNG | key,
        params={"meta": shot.meta.model_dump_json()},
    )  # fmt: skip


def _archive(attack: Attack, client: httpx.Client, number: int) -> httpx.Response:
    """An archive of all frames, each time of other bytes."""
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w") as archive:
        camera = attack.shot(0).meta.intrinsics
        assert camera is not None
        archive.writestr("run/intrinsics.json", json.dumps(camera.model_dump(mode="json")))
        archive.writestr("run/note.bin", f"{time.monotonic_ns()}-{number}".encode() * 100_000)
        for i, shot in enumerate(attack.shots):
            archive.writestr(f"run/{i}.png", shot.png)
    return client.post(
        "/v1/maps/noisy/imports", content=made.getvalue(),
        headers={"Content-Type": "application/zip"},
    )  # fmt: skip


def _query(attack: Attack, client: httpx.Client, number: int) -> httpx.Response:
    shot = attack.shot(number)
    return client.post(
        "/v1/maps/noisy/queries", content=shot.png, headers=_PNG,
        params={"meta": shot.meta.model_dump_json()},
    )  # fmt: skip


def _session(attack: Attack, client: httpx.Client, _number: int) -> httpx.Response:
    """A whole session deleted, and restored."""
    answer = client.delete("/v1/maps/noisy/sessions", params={"session": SESSION})
    attack.count(answer.status_code)
    if answer.status_code != 200:
        return answer
    deletion = (answer.json()["deletion"] or {}).get("deletion_id", "none")
    return client.post(f"/v1/maps/noisy/deletions/{deletion}/restore")


def _unknown_key(_attack: Attack, client: httpx.Client, number: int) -> httpx.Response:
    made_up = {"Authorization": f"Bearer made-up-{time.monotonic_ns()}-{number}"}
    return client.get("/v1/keys/me", headers=made_up)


def _gets(*paths: str) -> Send:
    """One of some paths after the other; `FRAME` in them is an indexed frame of the map."""
    known: list[str] = []

    def send(_attack: Attack, client: httpx.Client, number: int) -> httpx.Response:
        if not known:
            page = client.get("/v1/maps/noisy/frames", params={"state": "indexed", "limit": "1"})
            if page.status_code != 200:
                return page
            known.append(page.json()["items"][0]["frame_id"])
        return client.get(paths[number % len(paths)].replace("FRAME", known[0]))

    return send


def _posts(path: str, body: dict[str, Any]) -> Send:
    return lambda _, client, __: client.post(path, json=body)


def _repeated(send: Send, connections: int = _CONNECTIONS) -> Callable[[Attack], None]:
    """Requests on some connections, each after the answer to the last."""

    def repeat(attack: Attack) -> None:
        secrets = attack.secrets

        def go_on(first: int) -> None:
            number = first
            headers = bearer(secrets[first % len(secrets)])
            with httpx.Client(
                base_url=attack.url, headers=headers, timeout=PATIENCE_S, trust_env=False
            ) as client:
                while not _stop[0].is_set():
                    try:
                        attack.count(send(attack, client, number // connections).status_code)
                    except httpx.HTTPError:
                        attack.count(503)
                    number += connections

        with ThreadPoolExecutor(connections) as pool:
            list(pool.map(go_on, range(connections)))

    return repeat


#: All of them, as the table names them.
ATTACKS: dict[str, Callable[[Attack], None]] = {
    "held queries, two headers": hold_two_headers,
    "event streams": hold_streams,
    "large slow bodies": hold_bodies,
    "queue at priority 10": _repeated(_frame, 4),
    "one frame, many Idempotency-Keys": _repeated(_same_frame),
    "archives": _repeated(_archive, 4),
    "pages of 1000 rows": _repeated(_gets("/v1/maps/noisy/frames?limit=1000")),
    "all other lists": _repeated(
        _gets(
            "/v1/jobs?limit=1000", "/v1/events?after=0&limit=1000", "/v1/queries?limit=1000",
            "/v1/maps/noisy/sessions?limit=1000", "/v1/maps/noisy/deletions?limit=1000",
        )
    ),
    "queries": _repeated(_query),
    "clouds and pictures": _repeated(
        _gets("/v1/maps/noisy/frames/FRAME/cloud.ply", "/v1/maps/noisy/frames/FRAME/preview.png")
    ),
    "edits, each audited": _repeated(
        lambda _, client, __: client.patch(
            "/v1/maps/noisy", json={"title": str(time.monotonic_ns())}
        )
    ),
    "unknown keys": _repeated(_unknown_key),
    "sessions deleted and restored": _repeated(_session, 4),
    "coverage": _repeated(_posts("/v1/maps/noisy/coverage", {}), 4),
    "associations": _repeated(_posts("/v1/maps/noisy/associations", {"sessions": [SESSION]}), 4),
    "surface and its plan": _repeated(
        lambda attack, client, number: (
            _posts("/v1/maps/noisy/surface", {})(attack, client, number)
            if number % 4 == 0
            else client.get(f"/v1/maps/noisy/surface/plan.png?width={256 + number % 1000}")
        )
    ),
}  # fmt: skip


def _hold(
    attack: Attack, line: str, head: str, *, body: bytes = b"", two: bool = False,
    count: int = _CONNECTIONS,
) -> None:  # fmt: skip
    """Connections that are begun and held, again and again where they are closed."""
    url, secrets = httpx.URL(attack.url), attack.secrets
    with ExitStack() as stack:
        while not _stop[0].is_set():
            for number in range(count):
                secret = secrets[number % len(secrets)]
                again = f"Authorization: Bearer made-up-{number}\r\n" if two else ""
                wire = stack.enter_context(socket.socket())
                wire.settimeout(1.0)
                try:
                    wire.connect((url.host, url.port))
                    text = f"{line} HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {secret}"
                    wire.sendall(f"{text}\r\n{again}{head}\r\n".encode() + body)
                    attack.count(int(wire.recv(12)[9:12] or b"0"))
                except TimeoutError:
                    attack.count(0)  # it is held
                except OSError:
                    attack.count(503)
                if _stop[0].is_set():
                    return
            _stop[0].wait(2.0)
            stack.close()
