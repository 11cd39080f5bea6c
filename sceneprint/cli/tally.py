"""What has become of the frames of an upload."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from sceneprint.cli.connection import one_line

if TYPE_CHECKING:
    from sceneprint.schemas import Added, Job


@dataclass
class Tally:
    """Counts frames by what has become of them."""

    new: int = 0
    there: int = 0  #: in the map before
    refused: int = 0
    indexed: int = 0
    rejected: int = 0
    failed: int = 0
    redundant: int = 0  #: not kept, as the map had their places
    #: Names of the frames that are not signed yet, by their jobs; one content has one job.
    waiting: dict[str, list[str]] = field(default_factory=dict)
    errors: list[tuple[str, str]] = field(default_factory=list)  #: name of a frame, and why

    def count(self, name: str, added: Added, new: bool) -> None:
        """A frame that was received, or is there."""
        from sceneprint.schemas import FrameState

        self.new += new
        self.there += not new
        if added.state in (FrameState.RECEIVED, FrameState.SIGNING):
            self.waiting.setdefault(added.job_id, []).append(name)
        elif added.state is FrameState.INDEXED:
            self.indexed += 1
        elif added.state is FrameState.REDUNDANT:
            self.redundant += 1
        else:
            self._lose(name, added.reason, rejected=added.state is FrameState.REJECTED)

    def refuse(self, name: str, reason: str) -> None:
        """A frame that was not received."""
        self.refused += 1
        self.errors.append((name, reason))

    def end(self, job: Job, *, redundant: bool = False) -> None:
        """A job that is over, and whether its frame was not kept."""
        from sceneprint.schemas import JobState

        for name in self.waiting.pop(job.job_id):
            if redundant:
                self.redundant += 1
            elif job.state is JobState.SUCCEEDED:
                self.indexed += 1
            else:
                reason = job.error or job.state.sentence
                self._lose(name, reason, rejected=job.state is JobState.FAILED)

    def report(self, total: int, seconds: float) -> None:
        """Print the sum, and a line for each frame that was not indexed."""
        refused = f", {self.refused} refused" if self.refused else ""
        waiting = f", {len(self.waiting)} waiting" if self.waiting else ""
        redundant = f", {self.redundant} redundant" if self.redundant else ""
        print(
            f"{total} frames: {self.new} received, {self.there} already there{refused}; "
            f"{self.indexed} indexed, {self.rejected} rejected, {self.failed} failed"
            f"{redundant}{waiting}; {(self.new + self.there) / max(seconds, 1e-9):.1f} frames/s"
        )
        for name, reason in sorted(self.errors):
            print(f"{one_line(name)}: {one_line(reason)}", file=sys.stderr)

    def _lose(self, name: str, reason: str | None, *, rejected: bool) -> None:
        self.rejected += rejected
        self.failed += not rejected
        what = "rejected" if rejected else "failed"
        self.errors.append((name, f"{what}: {reason or 'no reason'}"))
