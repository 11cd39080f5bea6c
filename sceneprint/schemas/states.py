"""The states of frames and jobs."""

from __future__ import annotations

from enum import StrEnum


class FrameState(StrEnum):
    """What has become of an uploaded frame; `sentence` says it for people."""

    RECEIVED = "received"
    SIGNING = "signing"
    INDEXED = "indexed"
    REJECTED = "rejected"
    FAILED = "failed"
    REDUNDANT = "redundant"
    DELETED = "deleted"

    @property
    def sentence(self) -> str:
        """The state in a sentence."""
        return _OF_FRAMES[self]


class JobState(StrEnum):
    """What has become of a piece of work; `sentence` says it for people."""

    QUEUED = "queued"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"
    DEAD = "dead"

    @property
    def sentence(self) -> str:
        """The state in a sentence."""
        return _OF_JOBS[self]

    @property
    def over(self) -> bool:
        """Whether nothing more will happen to the job."""
        return self not in (JobState.QUEUED, JobState.RUNNING)


_OF_FRAMES = {
    FrameState.RECEIVED: "Stored durably, and waiting for a worker.",
    FrameState.SIGNING: "A worker is signing it.",
    FrameState.INDEXED: "Signed, and found by queries from now on.",
    FrameState.REJECTED: "Nothing in it can be signed; `reason` says why. Trying again is no use.",
    FrameState.FAILED: "Signing broke down again and again; the job has the traceback.",
    FrameState.REDUNDANT: "Not kept, as asked: the map has this place; `reason` names the frame.",
    FrameState.DELETED: (
        "Removed on request, or as older than its map keeps frames; found by no query."
    ),
}

_OF_JOBS = {
    JobState.QUEUED: "Waiting for a worker, for the first time or for another try.",
    JobState.RUNNING: "A worker holds its lease.",
    JobState.SUCCEEDED: "Done, and what it made is stored.",
    JobState.FAILED: "Its input cannot be used; `error` says why.",
    JobState.CANCELLED: "Given up on request, such as by deleting its frame.",
    JobState.DEAD: "Given up after too many tries; `traceback` has the last one.",
}
