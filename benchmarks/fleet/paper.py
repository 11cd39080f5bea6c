"""What a large fleet would take, reckoned from what single things cost here.

Costs  --paper-->  lines of Markdown
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from benchmarks.fleet.resource_usage import Work

#: The fleet, in sites that have a map each, and how often each robot sends a frame that is kept,
#: and asks where it is, seconds.
ROBOTS, FRAMES, MAPS, EVERY_S = 1_000, (10_000_000, 100_000_000), 50, 10.0
#: List prices of an object store in US dollars: a million PUTs (and others that write), a million
#: GETs and HEADs, and a GB kept for a month. DELETEs cost nothing.
PUTS, GETS, GB_MONTH = 5.0, 0.4, 0.023
MONTH_S = 30 * 86_400
#: Share of a processor, and of the turn, that is work on an ordinary day.
USED = 0.6
#: Bytes a frame of an index on a node's disk beside the signature and its sketch, and in each
#: process beside what it maps: the key, and the places of keys.
INDEX, OWN = 8, 16


@dataclass
class Costs:
    """All that was measured.

    Parameters
    ----------
    model, signature_bytes : that signed
    frames : how many were uploaded and signed
    upload, sign, query : see Work; the query has all stages, k = 5
    tables : bytes a frame of tables with their indexes, by name
    blobs : bytes a frame of uploads, and of geometry artifacts
    commit_ms : p50 and p99 of the smallest write in its turn, without and with a standby
    memory : bytes that a service and a worker have for themselves, after some work
    """

    model: str
    signature_bytes: int
    frames: int
    upload: Work
    sign: Work
    query: Work
    tables: Mapping[str, float]
    blobs: tuple[float, float]
    commit_ms: Mapping[str, tuple[float, float]]
    memory: Mapping[str, int] = field(default_factory=dict)


def paper(found: Costs) -> list[str]:
    """The arithmetic, as lines of Markdown."""
    rate = ROBOTS / EVERY_S
    work = {"uploads": found.upload, "signing": found.sign, "queries": found.query}
    database_ms = sum(one.database_ms for one in work.values())
    turn_ms = found.upload.turn_ms + found.sign.turn_ms
    wal_bytes = found.upload.wal_bytes + found.sign.wal_bytes
    wal = rate * wal_bytes
    lines = [
        f"### On paper: {ROBOTS:,} robots in {MAPS} maps, `{found.model}`",
        "",
        f"Each robot sends a frame that is kept, and asks where it is, every {EVERY_S:g} s: "
        f"{rate:g} frames and {rate:g} queries a second. Processors are assumed to be "
        f"{USED:.0%} busy.",
        "",
        "| | how | |",
        "|---|---|--:|",
        *(
            f"| processors for {name} | {rate:g} x {one.own_ms:.1f} ms / {USED:g} | "
            f"{rate * one.own_ms / 1e3 / USED:.0f} |"
            for name, one in work.items()
        ),
        f"| processors of the database | {rate:g} x {database_ms:.1f} ms / {USED:g} | "
        f"{rate * database_ms / 1e3 / USED:.1f} |",
        f"| a map's turn is full at | 1 / {turn_ms:.1f} ms | {1e3 / turn_ms:.0f} frames a second |",
        f"| log of the database (WAL), and to each standby | {rate:g} x {wal_bytes:,.0f} bytes | "
        f"{wal / 1e6:.1f} MB a second, {wal * 86400 / 1e9:,.0f} GB a day |",
        *(
            f"| memory of a {name} process, without its index | measured | {size / 1e6:,.0f} MB |"
            for name, size in sorted(found.memory.items())
        ),
        *_requests(found, rate),
        "",
    ]
    for frames in FRAMES:
        lines += _of_frames(found, frames)
    return lines


def _requests(found: Costs, rate: float) -> list[str]:
    """What requests to an object store cost in a month."""
    asked = dict.fromkeys(("writes", "GET", "HEAD"), 0.0)
    for one in (found.upload, found.sign, found.query):
        for method, count in one.requests.items():
            kind = "writes" if method in ("PUT", "POST") else method
            asked[kind] = asked.get(kind, 0.0) + count
    reads = asked["GET"] + asked["HEAD"]
    month = rate * MONTH_S / 1e6
    return [
        f"| requests of objects that write | {month:,.0f} million frames a month x "
        f"{asked['writes']:.1f} x ${PUTS:g} a million | ${month * asked['writes'] * PUTS:,.0f} a "
        "month |",
        f"| that read | {month:,.0f} million x {reads:.1f} x ${GETS:g} a million | "
        f"${month * reads * GETS:,.0f} a month |",
    ]


def _of_frames(found: Costs, frames: int) -> list[str]:
    """What so many frames take, as lines of Markdown."""
    rows, blobs = sum(found.tables.values()), sum(found.blobs)
    # signature, sketch, and the rest
    segment, each = found.signature_bytes * 9 // 8 + INDEX, frames / MAPS
    lines = [
        f"### On paper: {frames:,} frames in {MAPS} maps, `{found.model}`",
        "",
        "| | how | |",
        "|---|---|--:|",
        f"| rows of the database | {rows:,.0f} bytes a frame | {frames * rows / 1e9:,.0f} GB |",
        f"| blobs | {blobs:,.0f} bytes a frame | {frames * blobs / 1e12:.1f} TB |",
        f"| keeping them | ${GB_MONTH:g} a GB and month | "
        f"${frames * blobs / 1e9 * GB_MONTH:,.0f} a month |",
    ]
    return [
        *lines,
        f"| index of a node that asks one map of {each:,.0f} frames: memory of each process, "
        f"mapped from disk | {OWN} and {segment:,} bytes a frame | {each * OWN / 1e6:.0f} MB, "
        f"{each * segment / 1e6:,.0f} MB |",
        f"| of one that asks all maps | the same | {frames * OWN / 1e6:,.0f} MB, "
        f"{frames * segment / 1e9:.1f} GB |",
        f"| reading all blobs, at 100 MB/s | {blobs:,.0f} bytes a frame | "
        f"{frames * blobs / 1e8 / 3600:,.0f} h |",
        "",
    ]
