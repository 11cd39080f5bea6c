"""Frames of an archive into a map, some at a time; what is wrong with one costs no other.

    archive  --steps_of-->  Steps  --next_of-->  those taken at once  --take-->  ImportItems

A frame goes the way of every upload, so that what is done again after a crash finds it there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from sqlalchemy import Connection

from sceneprint.datasets import FrameReference
from sceneprint.datasets.archives import Archive
from sceneprint.datasets.metas import meta_of, parent_frame_of, session_of
from sceneprint.datasets.records import Sequence as FrameSequence
from sceneprint.engine.replaying import Outcome, item_of
from sceneprint.engine.slices import Task
from sceneprint.engine.uploads import Upload, Uploads
from sceneprint.errors import SceneprintError, StoreError, UnreadableArchive, UnreadableFrame
from sceneprint.schemas.ingest import ImportItem, ImportOptions
from sceneprint.store import queue

#: Frames that are taken in one commit, and bytes of more than one: a cloud may have 512 MiB, and
#: what is taken at once is in memory.
_AT_ONCE, _BYTES_AT_ONCE = 16, 128 << 20


@dataclass(frozen=True, eq=False)
class Step:
    """A frame of an archive, or why there is none."""

    name: str
    sequence: FrameSequence | None = None
    reference: FrameReference | None = None
    refused: SceneprintError | None = None


def steps_of(archive: Archive, every: int) -> Iterator[Step]:
    """All there is to tell of an archive, in the same order each time."""
    for name, reason in archive.refused:
        yield Step(name, refused=UnreadableArchive(reason))
    for sequence in archive.sequences:
        for reference in sequence.frames[::every]:
            yield Step(archive.name_of(reference), sequence, reference)


def next_of(archive: Archive, steps: Sequence[Step], done: int) -> Sequence[Step]:
    """The steps that are taken at once, at least one."""
    count = size = 0
    for step in steps[done : done + _AT_ONCE]:
        size += 0 if step.reference is None else archive.size_of(step.reference)
        if count and size > _BYTES_AT_ONCE:
            break
        count += 1
    return steps[done : done + count]


def take(
    uploads: Uploads, task: Task, archive: Archive, steps: Sequence[Step], options: ImportOptions
) -> list[ImportItem]:
    """Take some frames in one commit, as long as the job is this worker's.

    Parameters
    ----------
    uploads : what takes them
    task : of the import
    archive, steps : see `next_of`
    options : of the import
    """

    def fence(connection: Connection) -> None:  # cancelled, or of a map that was made anew
        queue.check_held(connection, task.claim)

    outcomes: list[Outcome | None] = []
    taken = []
    for step in steps:
        try:
            taken.append(_upload(archive, step, options))
            outcomes.append(None)
        except StoreError:
            raise
        except SceneprintError as error:
            outcomes.append(Outcome(None, error=type(error)(archive.told(error))))
        except MemoryError:
            outcomes.append(_too_large())
    rest = iter(_added(uploads, task.of_map.name, taken, fence))
    return [
        _item(step.name, outcome or next(rest))
        for step, outcome in zip(steps, outcomes, strict=True)
    ]


def _added(
    uploads: Uploads, map_name: str, taken: list[Upload], fence: Callable[[Connection], None]
) -> list[Outcome]:
    """Add them together; where memory does not do for that, one by one."""
    if not taken:
        return []
    try:
        return uploads.add_all(map_name, taken, fence=fence)[0]
    except MemoryError:
        if len(taken) == 1:
            return [_too_large()]
    return [one for each in taken for one in _added(uploads, map_name, [each], fence)]


def _too_large() -> Outcome:
    return Outcome(
        None,
        error=UnreadableFrame(
            "The frame takes more memory than a worker may have. Send a smaller one."
        ),
    )


def _upload(archive: Archive, step: Step, options: ImportOptions) -> Upload:
    if step.sequence is None or step.reference is None:
        raise step.refused or ValueError("neither a frame nor refused")
    meta = meta_of(
        step.reference,
        robot=options.robot,
        session=options.session or session_of(step.sequence),
        tags=options.tags,
        with_pose=options.with_poses,
        parent_frame=options.parent_frame or parent_frame_of(step.sequence, options.robot),
        base=options.T_base_sensor,
    )
    data = archive.data_of(step.reference)
    return Upload(data, meta, options.priority, options.if_novel)


def _item(name: str, outcome: Outcome) -> ImportItem:
    item = item_of(outcome)
    return ImportItem(
        name=name,
        status=item.status,
        frame_id=None if item.frame is None else item.frame.frame_id,
        job_id=None if item.frame is None else item.frame.job_id,
        problem=item.problem,
    )
