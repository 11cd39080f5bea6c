"""Checks of a running service, for `sceneprint doctor`."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from sceneprint import __version__
from sceneprint.errors import Forbidden, KeyRequired, SceneprintError

if TYPE_CHECKING:
    from sceneprint_client import Client, Status
    from sceneprint_client.api import Map
    from sceneprint_client.api.admin import ModelInfo, Stats

Verdict = Literal["ok", "note", "WRONG"]

#: Minimum free space, bytes; with less than the first, a check fails, and with less than the
#: second, it warns.
LEAST_FREE, LITTLE_FREE = 100 << 20, 5 << 30
#: Maximum difference between clocks, seconds; a check warns about a larger one.
APART_S = 2.0


@dataclass(frozen=True)
class Check:
    """The result of a check.

    Parameters
    ----------
    verdict : ok; note (something optional is missing, or is created on first use); or WRONG
        (something required is missing)
    subject : name of the checked object
    text : finding and advice
    """

    verdict: Verdict
    subject: str
    text: str


def disk_check(subject: str, free: int) -> Check:
    """Return a check that a disk with `free` bytes has room for more frames."""
    text = f"{free / 1e9:.1f} GB free; a frame takes approximately 0.25 MB"
    if free < LEAST_FREE:
        return Check("WRONG", subject, f"{text}. Free some space, or uploads will be rejected.")
    return Check("note" if free < LITTLE_FREE else "ok", subject, text)


def seconds_apart(before: float, there: float, after: float) -> float:
    """Return the minimum possible difference between two clocks, seconds.

    Parameters
    ----------
    before, after : readings of this clock before and after the other clock was read
    there : reading of the other clock
    """
    return max(before - there, there - after, 0.0)


# Checks of the responses of a running service.

#: Maximum age of a waiting job, seconds; if no worker is running, an older job is an error.
LONGEST_S = 60.0
#: Maximum number of names per line.
_MOST_NAMES = 5


def service_checks(client: Client, url: str) -> Iterator[Check]:
    """Yield checks of a service at `url`; raise SceneprintError if it stops responding."""
    try:
        status = client.status()
    except KeyRequired as error:
        yield Check("WRONG", "service", f"{url}: {error}")
        return
    except SceneprintError as error:
        yield Check("WRONG", "service", f"{url} answers, but is not ready: {error}")
        return
    yield version_check(url, status)
    yield ready_check(status)
    before = time.time()
    try:
        stats = client.stats(minutes=1)
    except KeyRequired:
        text = f"{url} requires a key; pass one with --key to check workers, queue and disk"
        yield Check("note", "workers", text)
        return
    except Forbidden:
        text = "the service shows them only to a key for all maps; pass such a key with --key"
        yield Check("note", "workers", text)
    else:
        yield clock_check(before, stats.at.timestamp(), time.time())
        yield store_check(stats)
        yield scrub_check(stats)
        if stats.bytes.free is not None:
            yield disk_check("service disk", stats.bytes.free)
        yield worker_check(stats, read_only=status.read_only)
        yield queue_check(stats)
    yield model_check(list(client.maps()), client.models())


def version_check(url: str, status: Status) -> Check:
    """Return a check that compares the versions of the service and of this command."""
    text = f"{url} answers, version {status.version}"
    if status.frames is not None:
        text += f", {sum(status.frames.values())} frames"
    if status.version == __version__:
        return Check("ok", "service", text)
    return Check("note", "service", f"{text}; this is version {__version__}")


def ready_check(status: Status) -> Check:
    """Return a check that the service accepts uploads; a note if it is read-only."""
    if status.read_only:
        text = "read-only: it answers queries but refuses uploads. Make its data folder writable"
        return Check("note", "ready", f"{text}.")
    return Check("ok", "ready", "accepts uploads and answers queries")


def clock_check(before: float, there: float, after: float) -> Check:
    """Return a check that compares the clocks of this machine and of the service."""
    apart = seconds_apart(before, there, after)
    text = f"the service's clock differs from this machine's by {apart:.1f} s"
    if apart > APART_S:
        text += ": capture times from robots are wrong. Synchronize both with a time server."
        return Check("note", "service clock", text)
    return Check("ok", "service clock", text)


def store_check(stats: Stats) -> Check:
    """Return a check with the sizes of the database, the blobs and the indexes."""
    sizes = stats.bytes
    # Responses do not contain the address of the database.
    place = "database" if sizes.database is None else f"database of {sizes.database / 1e6:.1f} MB"
    text = f"{place}, blobs of {sizes.blobs / 1e6:.1f} MB, indexes of {sizes.index / 1e6:.1f} MB"
    return Check("ok", "store", text)


def scrub_check(stats: Stats) -> Check:
    """Return the progress of the scrub; a note if nothing was verified, or data is damaged."""
    scrub = stats.scrub
    if scrub is None:
        return Check("note", "scrub", "no stored data has been verified yet")
    ended = "the first pass is running"
    if scrub.finished_at is not None:
        ended = f"the last pass ended {scrub.finished_at:%Y-%m-%dT%H:%M:%SZ}"
    text = f"{scrub.blobs} blobs of {scrub.bytes / 1e6:.1f} MB read, {ended}"
    if scrub.damaged:
        text += (
            f"; {scrub.damaged} lost or damaged: derived data is rebuilt, and `sceneprint fsck` "
            "lists uploads to send again"
        )
        return Check("note", "scrub", text)
    return Check("ok", "scrub", f"{text}, none damaged")


def worker_check(stats: Stats, *, read_only: bool) -> Check:
    """Return a check that workers are running."""
    workers = stats.workers or []
    busy = sum(worker.job_id is not None for worker in workers)
    if workers or read_only:
        run = "1 worker runs" if len(workers) == 1 else f"{len(workers)} workers run"
        return Check("ok", "workers", f"{run}, {busy} busy")
    text = "none runs, so frames are stored but not signed. Start workers with `sceneprint work`"
    if max(stats.oldest_waiting_s.values(), default=0.0) > LONGEST_S:
        return Check("WRONG", "workers", f"{text}, and read their log.")
    return Check("note", "workers", f"{text}, or wait if the service has just started.")


def queue_check(stats: Stats) -> Check:
    """Return the number of waiting jobs, with a note if jobs have failed permanently."""
    jobs = "1 job" if stats.waiting == 1 else f"{stats.waiting} jobs"
    text = f"{jobs} waiting, {stats.jobs.get('running', 0)} running"
    if stats.oldest_waiting_s:
        text += f", the oldest for {max(stats.oldest_waiting_s.values()):.0f} s"
    dead = stats.jobs.get("dead", 0)
    if dead:
        text += f"; {dead} failed in every attempt: `sceneprint jobs --state dead` shows why"
    return Check("note" if dead else "ok", "queue", text)


def model_check(maps: Iterable[Map], models: Iterable[ModelInfo]) -> Check:
    """Return the models of the maps, with a note if a preset is outdated."""
    presets = {model.name: model for model in models if model.preset}
    by_model: dict[str, list[str]] = defaultdict(list)
    older = []
    for record in maps:
        by_model[record.model].append(record.name)
        preset = presets.get(record.model.rpartition("-")[0])
        if preset is not None and preset.model_id != record.model_id and record.reencoding is None:
            older.append((record.name, preset))
    lines = [f"{model}: {_listed(names)}" for model, names in sorted(by_model.items())]
    text = "; ".join(lines) or "no maps yet"
    if older:
        name, preset = older[0]
        count = "1 map has" if len(older) == 1 else f"{len(older)} maps have"
        text += (
            f"; {count} an older model than this version contains: `sceneprint reencode {name} "
            f"--model {preset.name}` updates it"
        )
    return Check("note" if older else "ok", "models", text)


def _listed(names: list[str]) -> str:
    rest = len(names) - _MOST_NAMES
    return ", ".join(names[:_MOST_NAMES]) + (f" and {rest} more" if rest > 0 else "")
