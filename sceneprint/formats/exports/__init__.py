"""Readers for exports of other systems: databases, folders and files with depth and poses.

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
    """Return whether a path is a file in which another system stores frames."""
    file_format = format_named(path.name, "capture")
    return file_format is not None and (file_format.name != "rtabmap" or is_rtabmap(path))


def file_sequences(path: Path, name: str | None = None) -> tuple[FrameSequence, ...]:
    """Return the sequences in a file of another system.

    Parameters
    ----------
    path : absolute path of a file for which `is_export` returns True
    name : name of the sequences; None selects the name of the file

    Raises
    ------
    DatasetError : If the file is damaged, has an unsupported version, or has no frames.
    """
    name = name or path.stem
    file_format = format_named(path.name, "capture")
    if file_format is None or file_format.name == "rtabmap":
        return rtabmap_sequences(path, name)
    sequence: FrameSequence = function_at(file_format.reader)(path, name)
    return (sequence,)


def folder_layout(folder: Path, files: list[str], folders: list[str]) -> Layout | None:
    """Return the layout of a folder that another system wrote; None for other folders.

    Parameters
    ----------
    folder : path of the folder
    files, folders : names of the files and the subfolders in the folder
    """
    if is_polycam(folder, folders):
        return Layout.POLYCAM
    if record3d.is_record3d(files, folders):
        return Layout.RECORD3D
    # an intrinsics.json takes precedence: users write it for this reader
    if TRANSFORMS in files and INTRINSICS_FILE not in files:
        return Layout.NERFSTUDIO
    return None


def folder_sequence(folder: Path, layout: Layout, name: str) -> FrameSequence:
    """Return the sequence of a folder; `layout` is the result of `folder_layout`.

    Raise DatasetError if the folder is damaged, or no frame has depth.
    """
    return _OF_FOLDER[layout](folder, name)
