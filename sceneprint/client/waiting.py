"""Waiting for workers: looks at what they do, with growing pauses."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

from sceneprint.client.backend import Backend
from sceneprint.schemas import Added, FrameState, Job

#: Pauses between two looks, seconds: the first, and the longest.
PAUSES_S = (0.02, 0.5)
#: Jobs that are looked at in one round; workers take them in about this order.
WINDOW = 8


def settle(backend: Backend, map_name: str, added: Added, until: float) -> Added:
    """An upload once its job is over, or as it is when the time has come.

    Parameters
    ----------
    backend : see Backend
    map_name : of its map
    added : the upload
    until : time of `time.monotonic`
    """
    for pause in _pauses(until):
        if added.state not in (FrameState.RECEIVED, FrameState.SIGNING):
            break
        backend.meanwhile(pause)
        now = backend.get_frame(map_name, added.frame_id)
        added = added.model_copy(update={"state": now.state, "reason": now.reason})
    return added


def wait_for(
    backend: Backend,
    order: list[str],
    timeout_s: float,
    progress: Callable[[int, int], None] | None,
) -> list[Job]:
    """Jobs once they are over; see `Client.wait`."""
    known: dict[str, Job] = {}
    waiting = list(dict.fromkeys(order))
    total, until = len(waiting), time.monotonic() + timeout_s
    for pause in _pauses(until):
        while waiting:  # without a pause, as long as some of the window are over
            window = waiting[:WINDOW]
            known |= {job_id: backend.get_job(job_id) for job_id in window}
            still = [job_id for job_id in window if not known[job_id].state.over]
            waiting[:WINDOW] = still
            if progress is not None:
                progress(total - len(waiting), total)
            if len(still) == len(window) or time.monotonic() > until:
                break
        if not waiting:
            break
        backend.meanwhile(pause)
    return [known[i] if i in known else backend.get_job(i) for i in order]


def _pauses(until: float) -> Iterator[float]:
    """Growing pauses that end at a time; none if it has come."""
    pause, longest = PAUSES_S
    while (left := until - time.monotonic()) > 0:
        yield min(pause, left)
        pause = min(1.4 * pause, longest)
