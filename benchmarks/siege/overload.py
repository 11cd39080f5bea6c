"""Ten times what the service can do: each request is answered, or sent away with 429 or 503.

sustainable rate, measured  --overload-->  OverloadFigures
"""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from dataclasses import dataclass, field
from urllib.parse import urlencode

import httpx
import numpy as np

from benchmarks.soak.load import Shot

#: Answers that send away, with the word to come back.
_AWAY = (429, 503)
#: Seconds in which a request has to be answered, however many there are.
_PATIENCE_S = 60.0
#: Share of the requests that are queries; the rest uploads.
_QUERIES = 0.5
#: Seconds between two looks whether the service is itself again.
_LOOK_S = 0.25


@dataclass
class _Seen:
    """What came back, as it comes."""

    statuses: Counter[int] = field(default_factory=Counter)
    accepted_s: list[float] = field(default_factory=list)
    away_s: list[float] = field(default_factory=list)
    without_word: int = 0  # sent away without Retry-After
    frames: set[str] = field(default_factory=set)


@dataclass(frozen=True)
class OverloadFigures:
    """What came of it.

    Parameters
    ----------
    sustainable : requests a second that eight clients get answered
    offered : requests a second that were sent
    seconds : of the overload
    statuses : answers by status; 0: no answer
    without_word : sent away without Retry-After
    accepted_ms, away_ms : medians and 99th percentiles of the latency
    acknowledged, lost : frames, and those of them that are not in the map in the end
    recovery_s : after the overload until a query is answered as fast as before it, thrice over
    """

    sustainable: float
    offered: float
    seconds: float
    statuses: dict[int, int]
    without_word: int
    accepted_ms: tuple[float, float]
    away_ms: tuple[float, float]
    acknowledged: int
    lost: int
    recovery_s: float


def overload(
    url: str, shots: list[Shot], seconds: float, factor: float = 10.0, measure_s: float = 5.0
) -> OverloadFigures:
    """Find out what a service can do, and ask so many times as much of it.

    Parameters
    ----------
    url : of a service with an empty map `siege`
    shots : to upload and to ask with
    seconds : of the overload
    factor : of the sustainable rate
    measure_s : of the measuring of that rate
    """
    return asyncio.run(_overload(url, shots, seconds, factor, measure_s))


async def _overload(
    url: str, shots: list[Shot], seconds: float, factor: float, measure_s: float
) -> OverloadFigures:
    async with httpx.AsyncClient(base_url=url, timeout=_PATIENCE_S, trust_env=False) as client:
        first, calm = _Seen(), time.perf_counter()
        done = await asyncio.gather(
            *(_steady(httpx.URL(url), shots, i, measure_s, first) for i in range(8))
        )
        sustainable = sum(done) / (time.perf_counter() - calm)
        usual_s = float(np.median(first.accepted_s))
        seen, start, number = _Seen(), time.perf_counter(), 0
        tasks: set[asyncio.Task[None]] = set()
        while (now := time.perf_counter() - start) < seconds:
            while number < now * sustainable * factor:
                task = asyncio.create_task(_send(httpx.URL(url), shots, 1000 + number, seen))
                tasks.add(task)
                task.add_done_callback(tasks.discard)
                number += 1
            await asyncio.sleep(0.005)
        over = time.perf_counter()
        recovery_s = await _recovered(httpx.URL(url), shots, usual_s, over)
        await asyncio.gather(*tasks)
        lost = await _lost(client, first.frames | seen.frames)
    return OverloadFigures(
        sustainable=sustainable,
        offered=number / seconds,
        seconds=seconds,
        statuses=dict(sorted(seen.statuses.items())),
        without_word=seen.without_word,
        accepted_ms=_latency(seen.accepted_s),
        away_ms=_latency(seen.away_s),
        acknowledged=len(first.frames | seen.frames),
        lost=lost,
        recovery_s=recovery_s,
    )


async def _steady(
    url: httpx.URL, shots: list[Shot], offset: int, seconds: float, seen: _Seen
) -> int:
    """One client that waits for each answer; returns how many came."""
    until, n = time.perf_counter() + seconds, 0
    while time.perf_counter() < until:
        await _send(url, shots, offset + 8 * n, seen)
        n += 1
    return n


async def _send(url: httpx.URL, shots: list[Shot], number: int, seen: _Seen) -> None:
    """One request on a connection of its own, written by hand: many must cost little here."""
    shot = shots[number % len(shots)]
    is_query = (number * 7919) % 100 < 100 * _QUERIES
    # each upload is a frame of its own, under an id of its own, whatever its content
    method, path = ("POST", "queries") if is_query else ("PUT", f"frames/siege-{number}")
    given = urlencode({"meta": shot.meta.model_dump_json()})
    head = (
        f"{method} /v1/maps/siege/{path}?{given} HTTP/1.1\r\nHost: localhost\r\n"
        f"Content-Type: image/png\r\nContent-Length: {len(shot.png)}\r\nConnection: close\r\n\r\n"
    )
    start = time.perf_counter()
    try:
        async with asyncio.timeout(_PATIENCE_S):
            reader, writer = await asyncio.open_connection(url.host, url.port)
            try:
                writer.write(head.encode() + shot.png)
                answer = await reader.read()
            finally:
                writer.close()
        status = int(answer[9:12])
    except (OSError, TimeoutError, ValueError):
        seen.statuses[0] += 1
        return
    took = time.perf_counter() - start
    seen.statuses[status] += 1
    if status in _AWAY:
        seen.away_s.append(took)
        seen.without_word += b"retry-after: " not in answer.lower()
        return
    seen.accepted_s.append(took)
    if status in (200, 201, 202) and not is_query:
        seen.frames.add(f"siege-{number}")


async def _recovered(url: httpx.URL, shots: list[Shot], usual_s: float, over: float) -> float:
    """Seconds until three queries in a row take at most twice as long as usual."""
    good = 0
    while good < 3:
        seen = _Seen()
        await _send(url, shots, _first_query(len(shots)), seen)
        fast = bool(seen.accepted_s) and seen.accepted_s[0] < 2 * usual_s
        good = good + 1 if fast else 0
        if time.perf_counter() - over > _PATIENCE_S:
            return float("inf")
        if not fast:
            await asyncio.sleep(_LOOK_S)
    return time.perf_counter() - over


def _first_query(n: int) -> int:
    return next(i for i in range(n * 100) if (i * 7919) % 100 < 100 * _QUERIES)


async def _lost(client: httpx.AsyncClient, frames: set[str]) -> int:
    """Acknowledged frames that the map does not have."""
    there: set[str] = set()
    cursor: str | None = None
    while True:
        asked = {"limit": "1000"} | ({} if cursor is None else {"cursor": cursor})
        page = (await client.get("/v1/maps/siege/frames", params=asked)).json()
        there |= {one["frame_id"] for one in page["items"]}
        cursor = page["next_cursor"]
        if cursor is None:
            return len(frames - there)


def _latency(seconds: list[float]) -> tuple[float, float]:
    if not seconds:
        return (0.0, 0.0)
    return (
        round(1e3 * float(np.median(seconds)), 1),
        round(1e3 * float(np.percentile(seconds, 99)), 1),
    )
