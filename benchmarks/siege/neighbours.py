"""Noisy neighbours: keys of one tenant do their worst while another tenant works.

attack, number of keys  --besiege_neighbour-->  NeighbourFigures
"""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field

import httpx
import numpy as np

from benchmarks.soak.load import Shot

#: Statuses with which a request is sent away.
_AWAY = (429, 503, 507)
#: Seconds that a request, and the signing of a frame, may take.
_PATIENCE_S = 60.0
#: Connections that an attack has in all, whatever the number of its keys.
_CONNECTIONS = 40
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
    calm, under : the victim without it and with it
    sent, refused : requests of the attacker, and those of them that were sent away
    """

    attack: str
    keys: int
    calm: VictimFigures
    under: VictimFigures
    sent: int
    refused: int


@dataclass
class Attack:
    """An attack in hand.

    Parameters
    ----------
    url : of the service
    secrets : keys of the attacker, all of one tenant
    shots : frames to upload to the map `noisy`, which has some
    """

    url: httpx.URL
    secrets: Sequence[str]
    shots: list[Shot]
    stop: threading.Event = field(default_factory=threading.Event)
    sent: int = 0
    refused: int = 0

    def count(self, status: int) -> None:
        """Count an answer."""
        self.sent += 1
        self.refused += status in _AWAY


def hold_two_headers(attack: Attack) -> None:
    """Queries whose bodies never end, each with a second, made-up Authorization header."""
    _hold(attack, "POST /v1/maps/noisy/queries", "Content-Length: 5000\r\n", two=True)


def hold_streams(attack: Attack) -> None:
    """As many event streams as connections."""
    _hold(attack, "GET /v1/events", "Accept: text/event-stream\r\n", count=80)


def hold_bodies(attack: Attack) -> None:
    """Large bodies of which most comes, and the rest never does."""
    head = "Content-Type: application/octet-stream\r\nContent-Length: 70000000\r\n"
    _hold(attack, "POST /v1/maps/noisy/frames", head, body=bytes(8 << 20), count=16)


def flood_queue(attack: Attack) -> None:
    """Frames at the highest priority, as fast as they are taken."""

    def send(client: httpx.Client, number: int) -> httpx.Response:
        shot = attack.shots[number % len(attack.shots)]
        return client.put(
            f"/v1/maps/noisy/frames/noise-{time.monotonic_ns()}-{number}", content=shot.png,
            params={"meta": shot.meta.model_dump_json(), "priority": "10"},
            headers={"Content-Type": "image/png"},
        )  # fmt: skip

    _repeat(attack, send, connections=4)


def flood_lists(attack: Attack) -> None:
    """The longest pages, on many connections at once."""
    _repeat(attack, lambda client, _: client.get("/v1/maps/noisy/frames?limit=1000"))


def flood_queries(attack: Attack) -> None:
    """Queries, on many connections at once."""

    def send(client: httpx.Client, number: int) -> httpx.Response:
        shot = attack.shots[number % len(attack.shots)]
        return client.post(
            "/v1/maps/noisy/queries", content=shot.png, headers={"Content-Type": "image/png"},
            params={"meta": shot.meta.model_dump_json()},
        )  # fmt: skip

    _repeat(attack, send)


#: All of them, as the table names them.
ATTACKS: dict[str, Callable[[Attack], None]] = {
    "held queries, two headers": hold_two_headers,
    "event streams": hold_streams,
    "queue at priority 10": flood_queue,
    "large slow bodies": hold_bodies,
    "pages of 1000 rows": flood_lists,
    "queries": flood_queries,
}


def _hold(
    attack: Attack, line: str, head: str, *, body: bytes = b"", two: bool = False,
    count: int = _CONNECTIONS,
) -> None:  # fmt: skip
    """Connections that are begun and held, again and again where they are closed."""
    with ExitStack() as stack:
        while not attack.stop.is_set():
            for number in range(count):
                secret = attack.secrets[number % len(attack.secrets)]
                again = f"Authorization: Bearer made-up-{number}\r\n" if two else ""
                wire = stack.enter_context(socket.socket())
                wire.settimeout(1.0)
                try:
                    wire.connect((attack.url.host, attack.url.port))
                    text = f"{line} HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {secret}"
                    wire.sendall(f"{text}\r\n{again}{head}\r\n".encode() + body)
                    attack.count(int(wire.recv(12)[9:12] or b"0"))
                except TimeoutError:
                    attack.count(0)  # it is held
                except OSError:
                    attack.count(503)
                if attack.stop.is_set():
                    return
            attack.stop.wait(2.0)
            stack.close()


def _repeat(
    attack: Attack, send: Callable[[httpx.Client, int], httpx.Response],
    connections: int = _CONNECTIONS,
) -> None:  # fmt: skip
    """Requests on some connections, each after the answer to the last."""

    def go_on(first: int) -> None:
        secret, number = attack.secrets[first % len(attack.secrets)], first
        with _client(attack.url, secret) as client:
            while not attack.stop.is_set():
                try:
                    attack.count(send(client, number).status_code)
                except httpx.HTTPError:
                    attack.count(503)
                number += connections

    with ThreadPoolExecutor(connections) as pool:
        list(pool.map(go_on, range(connections)))


def _client(url: httpx.URL, secret: str) -> httpx.Client:
    headers = {"Authorization": f"Bearer {secret}"}
    return httpx.Client(base_url=url, headers=headers, timeout=_PATIENCE_S, trust_env=False)


def work_as_victim(url: httpx.URL, secret: str, shots: list[Shot], seconds: float) -> VictimFigures:
    """Ask, list, listen, upload and query, one after the other, for some time, once at least."""
    found, until, number = VictimFigures(), time.perf_counter() + seconds, 0
    own = {"Content-Type": "image/png"}
    with _client(url, secret) as client:
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
                found.refused += status >= 500 or status in _AWAY
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
    url: str, name: str, secrets: Sequence[str], victim: str, shots: list[Shot], seconds: float,
    calm: VictimFigures,
) -> NeighbourFigures:  # fmt: skip
    """Let one tenant attack while another works.

    Parameters
    ----------
    url : of a service with the maps `noisy` and `victim`, which hold frames
    name : of the attack
    secrets : keys of the attacker's tenant
    victim : key of the other tenant
    shots : frames to upload and to ask with
    seconds : of the attack
    calm : the victim's figures without it
    """
    attack = Attack(httpx.URL(url), secrets, shots)
    with ThreadPoolExecutor(1) as pool:
        running = pool.submit(ATTACKS[name], attack)
        try:
            time.sleep(min(seconds / 4, 2.0))  # so that it has begun
            under = work_as_victim(httpx.URL(url), victim, shots, seconds)
        finally:
            attack.stop.set()
        running.result()
    return NeighbourFigures(name, len(secrets), calm, under, attack.sent, attack.refused)


def neighbour_table(found: Sequence[NeighbourFigures]) -> list[str]:
    """The figures as lines of Markdown."""

    def p99(seconds: list[float]) -> str:
        return f"{1e3 * float(np.percentile(seconds, 99)):.0f}"

    lines = [
        "| attack | keys | request p99, calm | under attack | frame signed p99, calm "
        "| under attack | victim refused | attacker sent | refused |",
        "|---|--:|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for one in found:
        calm, under = one.calm, one.under
        lines.append(
            f"| {one.attack} | {one.keys} | {p99(calm.requests_s)} ms | {p99(under.requests_s)} ms "
            f"| {p99(calm.signed_s)} ms | {p99(under.signed_s)} ms | **{under.refused}** "
            f"| {one.sent} | {one.refused} |"
        )
    return lines
