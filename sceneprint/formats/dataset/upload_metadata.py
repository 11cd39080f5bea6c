"""What a sequence is called, as it is sent with the uploads of its frames."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from sceneprint.formats.dataset.frame_reference import FrameSequence, Layout


def session_of(sequence: FrameSequence) -> str:
    """Name of a sequence, the same whether its own folder was named or the scene's."""
    if sequence.layout is Layout.RECORDING or sequence.parent_frame == sequence.name:
        return sequence.name
    return f"{sequence.parent_frame}/{sequence.folder.name}"


def parent_frame_of(sequence: FrameSequence, robot: str | None) -> str:
    """What poses lead to: folders of two robots may share a name, and their poses no frame."""
    own = sequence.parent_frame
    return own if robot is None else f"{robot}/{own}"


def numbered_sequences(
    sequences: Iterable[FrameSequence], session: str | None
) -> list[FrameSequence]:
    """Sequences with the places of their frames within the sessions that they are sent to.

    Several sequences of one session are numbered one after the other, so that their frames do not
    mix; frames of one folder that were named one by one keep the folder's numbers, or are numbered
    as they were named.

    Parameters
    ----------
    sequences : in the order in which they follow each other
    session : of all of them; None: each has its own
    """
    told, found = list(sequences), []
    names = [session or session_of(one) for one in told]
    alone = {name for name in names if names.count(name) == 1}
    first: dict[tuple[str, Path], int] = {}
    free: dict[str, int] = {}  # the next number of each session
    for name, one in zip(names, told, strict=True):
        if name in alone:
            found.append(one)
            continue
        offset = first.setdefault((name, one.folder), free.get(name, 0))
        frames = []
        for frame in one.frames:
            place = free.get(name, 0)
            if frame.sequence is not None:
                place = offset + frame.sequence
            frames.append(replace(frame, sequence=place))
            free[name] = max(free.get(name, 0), place + 1)
        found.append(replace(one, frames=tuple(frames)))
    return found
