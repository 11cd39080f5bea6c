"""Archives given to `sceneprint upload`: sent whole, and waited for until all frames are taken."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from sceneprint.cli.awaiting import STALL_S
from sceneprint.cli.tally import Tally
from sceneprint.datasets.inflating import is_archive
from sceneprint.datasets.metas import checked
from sceneprint.errors import UnknownFrame
from sceneprint.schemas.ingest import ImportOptions

if TYPE_CHECKING:
    from sceneprint.client import Client
    from sceneprint.schemas import Job

#: Bytes that tell whether a file is an archive, and seconds between two looks at an import.
_HEAD, _PAUSE_S = 512, 2.0


def is_archive_file(path: Path) -> bool:
    """Whether a path is a file that begins as an archive does."""
    try:
        if not path.is_file():
            return False
        with path.open("rb") as file:
            return is_archive(file.read(_HEAD))
    except OSError:  # whoever reads it says so
        return False


def import_all(
    client: Client, options: argparse.Namespace, archives: list[Path], tally: Tally
) -> bool:
    """Send archives and count their frames; False where workers do nothing for long."""
    for path in archives:
        said = checked(
            ImportOptions,
            f"What is said of {path.name}",
            name=path.name.partition(".")[0][:64] or "import",
            robot=options.robot,
            session=options.session,
            tags=options.tag,
            parent_frame=options.parent_frame,
            with_poses=not options.no_pose,
            every=options.every,
            T_base_sensor=options.base,
            priority=options.priority,
            if_novel=options.if_novel,
        )
        with path.open("rb") as file:
            job = client.import_archive(options.map, file, said)
        if options.no_wait:
            print(f"{path.name}: received; import {job.job_id} takes its frames")
            continue
        job, moves = _waited(client, path.name, job)
        _count(client, options.map, job, tally)
        if not moves:
            return False
        if job.error is not None:
            tally.refuse(path.name, job.error)
    return True


def _waited(client: Client, name: str, job: Job) -> tuple[Job, bool]:
    """An import once it is over, or when it has not moved for long."""
    moved, seen = time.monotonic(), -1
    with tqdm(desc=name, unit="frame", disable=None) as bar:
        while not job.state.over:
            [job] = client.wait([job.job_id], timeout_s=_PAUSE_S)
            if job.progress is not None:
                bar.total = job.progress.total
                bar.update(job.progress.done - bar.n)
            done = -1 if job.progress is None else job.progress.done
            if done != seen:
                moved, seen = time.monotonic(), done
            elif time.monotonic() - moved > STALL_S:
                return job, False
    return job, True


def _count(client: Client, map_name: str, job: Job, tally: Tally) -> None:
    from sceneprint.schemas import Added, FrameState

    for item in client.import_items(map_name, job.job_id):
        if item.frame_id is None or item.job_id is None:
            tally.refuse(item.name, "refused" if item.problem is None else item.problem.detail)
            continue
        state = FrameState.RECEIVED
        if item.status == 200:  # it may be over long since
            try:
                state = client.frame(map_name, item.frame_id).state
            except UnknownFrame:  # deleted meanwhile
                continue
        added = Added(frame_id=item.frame_id, job_id=item.job_id, state=state, reason=None)
        tally.count(item.name, added, item.status == 202)
