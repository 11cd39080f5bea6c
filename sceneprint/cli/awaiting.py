"""Waiting until the frames of an upload are signed."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tqdm import tqdm

from sceneprint.cli.tally import Tally

if TYPE_CHECKING:
    from sceneprint.client import Client
    from sceneprint.schemas import Job

#: Seconds without a frame signed after which no worker is believed to be there.
STALL_S = 120.0


def wait_for_all(client: Client, map_name: str, tally: Tally, *, may_be_redundant: bool) -> bool:
    """Wait for the jobs as long as some end now and then; whether all did.

    Parameters
    ----------
    client : of the service
    map_name : of the map
    tally : of the upload, which is told of every job that is over
    may_be_redundant : whether frames were sent to be kept only where the map lacks the place
    """
    total = len(tally.waiting)
    with tqdm(total=total, desc="sign", unit="frame", disable=None) as bar:
        while tally.waiting:
            before = total - len(tally.waiting)

            def progress(done: int, _: int, before: int = before) -> None:
                bar.update(before + done - bar.n)

            over = [
                job
                for job in client.wait(tally.waiting, timeout_s=STALL_S, progress=progress)
                if job.state.over
            ]
            for job in over:
                redundant = may_be_redundant and _is_redundant(client, map_name, job)
                tally.end(job, redundant=redundant)
            if not over:
                return False
    return True


def _is_redundant(client: Client, map_name: str, job: Job) -> bool:
    """Whether a frame was signed and not kept: its job alone does not tell."""
    from sceneprint.schemas import FrameState, JobState

    if job.state is not JobState.SUCCEEDED:
        return False
    return client.frame(map_name, str(job.frame_id)).state is FrameState.REDUNDANT
