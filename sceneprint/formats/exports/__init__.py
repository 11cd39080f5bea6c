"""What other systems write: databases, folders and files with depth and poses, as sequences.

path  --file_sequences-->  FrameSequence, ...
folder  --folder_layout-->  Layout          folder, Layout  --folder_sequence-->  FrameSequence
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from sceneprint.formats.dataset.frame_reference import FrameSequence, Layout
from sceneprint.formats.exports import record3d
from sceneprint.formats.exports.nerfstudio import TRANSFORMS, nerfstudio_sequence
from sceneprint.formats.exports.polycam import is_polycam, polycam_sequence
from sceneprint.formats.exports.rtabmap import is_rtabmap, rtabmap_sequences
from sceneprint_client.formats import format_named, function_at
from sceneprint_client.sidecars import INTRINSICS_FILE

_OF_FOLDER: dict[Layout, Callable[[Path, str], FrameSequence]] = {
    Layout.POLYCAM: polycam_sequence,
    Layout.NERFSTUDIO: nerfstudio_sequence,
    Layout.RECORD3D: record3d.record3d_sequence,
}


def is_export(path: Path) -> bool:
    """Return whether a path is one file that another system wrote, with frames in it."""
    found = format_named(path.name, "capture")
    return found is not None and (found.name != "rtabmap" or is_rtabmap(path))


def file_sequences(path: Path, name: str | None = None) -> tuple[FrameSequence, ...]:
    """Return the sequences of one file that another system wrote.

    Parameters
    ----------
    path : a file, absolute, for which `is_export` holds
    name : of the sequences; default: that of the file

    Raises
    ------
    DatasetError : the file is damaged, of a version that is not read, or holds no frame.
    """
    name = name or path.stem
    found = format_named(path.name, "capture")
    if found is None or found.name == "rtabmap":
        return rtabmap_sequences(path, name)
    sequence: FrameSequence = function_at(found.reader)(path, name)
    return (sequence,)


def folder_layout(folder: Path, files: list[str], folders: list[str]) -> Layout | None:
    """Return the layout of a folder that another system wrote; None for any other folder.

    Parameters
    ----------
    folder : the folder
    files, folders : names in it
    """
    if is_polycam(folder, folders):
        return Layout.POLYCAM
    if record3d.is_record3d(files, folders):
        return Layout.RECORD3D
    # an intrinsics.json was written for us, and says what is meant
    if TRANSFORMS in files and INTRINSICS_FILE not in files:
        return Layout.NERFSTUDIO
    return None


def folder_sequence(folder: Path, layout: Layout, name: str) -> FrameSequence:
    """Return the frames of a folder of such a layout.

    Raises
    ------
    DatasetError : the folder is damaged, or holds no frame with depth.
    """
    return _OF_FOLDER[layout](folder, name)
