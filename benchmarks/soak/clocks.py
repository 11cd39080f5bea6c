"""Clocks that jump by a year, either way, while jobs wait and run: what was lost, and what waited.

Service and workers see the time of libfaketime, which this process shifts in a file; monotonic
clocks go on, as where an administrator or NTP sets the time. Debian has it as `libfaketime`.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from benchmarks.soak.answers import state_of
from benchmarks.soak.kills import (
    KillFigures,
    check_files,
    figures,
    is_idle,
    run_undisturbed,
    wait_until,
)
from benchmarks.soak.load import MAP, MODEL, Part, Shot, free_port, service, workers
from benchmarks.soak.writers import Plan
from sceneprint_client import Client

YEAR_S = 365 * 86_400
#: Seconds beside the true time, one after the other; the next to last step is two years back.
OFFSETS = (-YEAR_S, 0, YEAR_S, 0, YEAR_S, -YEAR_S, 0)
#: Maps whose frames are kept for some days, and for how many: beyond every jump, and within.
KEPT, SOON = ("years", 1000.0), ("month", 30.0)
_KEPT_FRAMES = 3


@dataclass(frozen=True)
class ClockFigures:
    """What came of it.

    Parameters
    ----------
    jumps : of all clocks
    waiting : jobs that waited or ran at a jump, in all
    longest_s : from a jump until no job waited, at most
    held : as of a soak; what counts frames counts those of the map without retention
    removed : frames that went though the days they are kept for were over by no clock
    due : frames that were kept for 30 days, and went at a clock of a year later
    """

    jumps: int
    waiting: int
    longest_s: float
    held: KillFigures
    removed: int
    due: int

    @property
    def sound(self) -> bool:
        """Whether jobs were there to jump over, and nothing was lost, doubled, wrong or removed."""
        held = self.held
        faults = (held.lost, held.doubled, held.half_written, held.differing, held.wrong)
        return self.waiting > 0 and not any(faults) and not self.removed


def find_library() -> Path | None:
    """Debian's libfaketime for programs with threads; None where it is not installed."""
    found = sorted(Path("/usr/lib").glob("*/faketime/libfaketimeMT.so.1"))
    return found[0] if found else None


def jump_clocks(folder: Path, shots: list[Shot], library: Path) -> ClockFigures:
    """Upload shots, a part of them before each jump, and compare with an undisturbed run.

    Parameters
    ----------
    folder : empty; two data folders and logs come to lie in it
    shots : to upload
    library : libfaketimeMT.so.1
    """
    calm, data, offset = folder / "calm", folder / "jumping", folder / "offset"
    last = shots[-_KEPT_FRAMES:]
    shots = shots[: -len(last)]
    run_undisturbed(calm, shots)
    plan, waiting, longest, early = Plan(range(len(shots))), 0, 0.0, 0
    with _jumping(data, offset, library) as (url, working), Client(url) as client:
        for name, days in (KEPT, SOON):
            client.create_map(name, model=MODEL, retention_days=days)
            for one in last:
                client.upload(name, one.png, one.meta)
        for number, seconds in enumerate(OFFSETS):
            part, kills = shots[number :: len(OFFSETS)], number % 2 == 0
            _upload(client, part[::2], plan)
            if kills:  # their leases run, and what comes now waits
                working.kill()
            _upload(client, part[1::2], plan)
            jobs = client.status().jobs or {}
            waiting += jobs.get("queued", 0) + jobs.get("running", 0)
            _set(offset, seconds)
            if kills:
                working.begin()
            start = time.monotonic()
            wait_until(lambda: is_idle(client), "all jobs are over")
            longest = max(longest, time.monotonic() - start)
            if seconds <= 0 and max(OFFSETS[: number + 1]) <= 0:
                early = _KEPT_FRAMES - len(list(client.frames(SOON[0])))
        due = _KEPT_FRAMES - len(list(client.frames(SOON[0])))
        removed = _KEPT_FRAMES - len(list(client.frames(KEPT[0])))
        leftovers, half_written = check_files(data)
        found, wanted = state_of(data, url), state_of(calm, None)
    held = figures(Counter(), plan, leftovers, half_written, found, wanted, 0.0)
    return ClockFigures(len(OFFSETS), waiting, longest, held, removed + early, due - early)


@contextmanager
def _jumping(data: Path, offset: Path, library: Path) -> Iterator[tuple[str, Part]]:
    """A service and two workers whose clocks are shifted by a file."""
    environment = {
        "LD_PRELOAD": str(library), "FAKETIME_TIMESTAMP_FILE": str(offset),
        "FAKETIME_NO_CACHE": "1", "FAKETIME_DONT_FAKE_MONOTONIC": "1", "NO_FAKE_STAT": "1",
    }  # fmt: skip
    _set(offset, 0)
    with Client.embedded(data) as client:
        client.create_map(MAP, model=MODEL)
    port = free_port()
    url = f"http://127.0.0.1:{port}"
    serving = service(data, port, environment=environment, waiting=512)
    working = workers(data, 2, environment)
    try:
        for part in (serving, working):
            part.begin()
        with Client(url) as client:
            wait_until(lambda: is_idle(client), "the service is ready")  # its code is loaded
        yield url, working
    finally:
        for part in (serving, working):
            part.kill()


def _upload(client: Client, shots: list[Shot], plan: Plan) -> None:
    for one in shots:
        frame_id = client.upload(MAP, one.png, one.meta).frame_id
        plan.acknowledge(one.number, frame_id)
        if Plan.is_deleted(one.number):
            client.delete_frame(MAP, frame_id)
            plan.deleted.add(frame_id)


def _set(offset: Path, seconds: int) -> None:
    """Shift the clocks: at once, and never half written."""
    new = offset.with_suffix(".new")
    new.write_text(f"{seconds:+d}\n")
    new.rename(offset)
