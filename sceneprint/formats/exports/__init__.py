"""What other systems write: databases, folders and files with depth and poses, as sequences.

path  --file_sequences-->  FrameSequence, ...
"""

from __future__ import annotations

from pathlib import Path

from sceneprint.formats.dataset.frame_reference import FrameSequence
from sceneprint.formats.exports.rtabmap import is_rtabmap, rtabmap_sequences


def file_sequences(path: Path) -> tuple[FrameSequence, ...] | None:
    """Return the sequences of one file that another system wrote; None if it is no such file.

    Parameters
    ----------
    path : a file, absolute

    Raises
    ------
    DatasetError : as `rtabmap_sequences`.
    """
    return rtabmap_sequences(path) if is_rtabmap(path) else None
