"""What a sequence is called, as it is sent with the uploads of its frames."""

from __future__ import annotations

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
