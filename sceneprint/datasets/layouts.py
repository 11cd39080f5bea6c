"""From a folder of known layout to the references of its frames; no frame is read.

folder  --layout_of-->  Layout  --references-->  FrameReference, ...
"""

from __future__ import annotations

import math
import os
import re
from pathlib import Path, PurePosixPath

from sceneprint.datasets.clouds import FILE_NAME, find_cloud_source, is_cloud
from sceneprint.datasets.files import data_lines, read_text
from sceneprint.datasets.intrinsics import find_camera
from sceneprint.datasets.poses import interpolate, read_trajectory
from sceneprint.datasets.records import FrameReference, Layout
from sceneprint.errors import DatasetError

_SEVEN_SCENES = re.compile(r"frame-\d+\.depth\.png", re.ASCII)
_DEPTH_LIST, _TRAJECTORY = "depth.txt", "groundtruth.txt"
_MAXIMUM_LIST_BYTES = 2**26


def list_folder(folder: Path) -> tuple[list[str], list[str]]:
    """Return the names of the files and of the folders in it, hidden ones left out.

    Both are in natural order: frame 9 before frame 10.

    Raises
    ------
    DatasetError : it may not be read.
    """
    files: list[str] = []
    folders: list[str] = []
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                if not entry.name.startswith("."):
                    (folders if _is_folder(entry) else files).append(entry.name)
    except OSError as cause:
        raise DatasetError(
            f"{folder}: The folder cannot be read ({cause.strerror}). Check your rights."
        ) from cause
    return sorted(files, key=natural), sorted(folders, key=natural)


def natural(name: str) -> tuple[list[tuple[int, str]], str]:
    """Sort key that takes digits as numbers; the name itself decides between 1 and 01."""
    parts = re.split(r"(\d+)", name, flags=re.ASCII)
    # digits count by their length and then as text: no number is too long for that
    key = [
        (len(part.lstrip("0")), part.lstrip("0")) if i % 2 else (0, part)
        for i, part in enumerate(parts)
    ]
    return key, name


def layout_of(files: list[str]) -> Layout | None:
    """Return the layout that these file names show, or None if they hold neither depth nor points.

    Of depth images and points in one folder it is the images, unless clouds.json is there too.
    """
    if any(_SEVEN_SCENES.fullmatch(file) for file in files):
        return Layout.SEVEN_SCENES
    if _DEPTH_LIST in files:
        return Layout.TUM
    if FILE_NAME in files and any(map(_may_be_cloud, files)):
        return Layout.CLOUDS
    if any(map(_is_depth, files)):
        return Layout.PLAIN
    return Layout.CLOUDS if any(map(is_cloud, files)) else None


def references(
    folder: Path, files: list[str], layout: Layout, name: str
) -> tuple[FrameReference, ...]:
    """Return the frames of a folder.

    Parameters
    ----------
    folder : with `intrinsics.json` in it or above it, if it holds depth images
    files : names of the files to take, in order, as `list_folder` gives them
    layout : of the folder
    name : of the sequence; frames are named after it

    Raises
    ------
    DatasetError : there is no intrinsics.json, depth.txt is damaged, or two frames would
        have one name; or clouds.json says what it cannot.
    InvalidIntrinsics : intrinsics.json describes no camera.
    InvalidPose : groundtruth.txt holds a line that is no pose.
    """
    if layout is Layout.SEVEN_SCENES:
        frames = _seven_scenes(folder, files, name)
    elif layout is Layout.TUM:
        frames = _tum(folder, files, name)
    elif layout is Layout.CLOUDS:
        frames = _clouds(folder, files, name)
    else:
        frames = _plain(folder, files, name)
    first: dict[str, Path] = {}
    for frame in frames:
        if frame.name in first:
            raise DatasetError(
                f"{frame.path}: The frame would have the same name, {frame.name}, as "
                f"{first[frame.name].name}. Rename or remove one of them."
            )
        first[frame.name] = frame.path
    return frames


def _seven_scenes(folder: Path, files: list[str], name: str) -> tuple[FrameReference, ...]:
    camera, present, frames = find_camera(folder), set(files), []
    for file in files:
        if _SEVEN_SCENES.fullmatch(file):
            stem = file.removesuffix(".depth.png")
            pose = folder / f"{stem}.pose.txt" if f"{stem}.pose.txt" in present else None
            frames.append(FrameReference(f"{name}/{stem}", folder / file, camera, pose_source=pose))
    return tuple(frames)


def _plain(folder: Path, files: list[str], name: str) -> tuple[FrameReference, ...]:
    camera = find_camera(folder)
    return tuple(
        FrameReference(f"{name}/{Path(file).stem}", folder / file, camera)
        for file in files
        if _is_depth(file)
    )


def _clouds(folder: Path, files: list[str], name: str) -> tuple[FrameReference, ...]:
    source, present = find_cloud_source(folder), set(files)
    # beside clouds.json a .npy is of points
    wanted = _may_be_cloud if FILE_NAME in present else is_cloud
    frames = []
    for file in filter(wanted, files):
        stem = Path(file).stem
        pose = folder / f"{stem}.pose.txt" if f"{stem}.pose.txt" in present else None
        frames.append(
            FrameReference(f"{name}/{stem}", folder / file, None, pose_source=pose, cloud=source)
        )
    return tuple(frames)


def _tum(folder: Path, files: list[str], name: str) -> tuple[FrameReference, ...]:
    camera = find_camera(folder)
    listed = sorted(_depth_list(folder / _DEPTH_LIST))
    stamps = [stamp for stamp, _ in listed]
    if _TRAJECTORY in files:
        poses = interpolate(read_trajectory(folder / _TRAJECTORY), stamps)
    else:
        poses = [None] * len(stamps)
    return tuple(
        FrameReference(f"{name}/{Path(file).stem}", folder / file, camera, stamp, pose)
        for (stamp, file), pose in zip(listed, poses, strict=True)
    )


def _depth_list(path: Path) -> list[tuple[float, str]]:
    """Return time stamp and file of each line of depth.txt."""
    listed = []
    for number, line in data_lines(read_text(path, _MAXIMUM_LIST_BYTES, DatasetError)):
        place, words = f"{path}, line {number}", line.split(maxsplit=1)
        try:
            stamp, file = float(words[0]), words[1]
        except (ValueError, IndexError) as cause:
            raise DatasetError(
                f"{place}: The line is no time stamp and file. Write them, a space between."
            ) from cause
        if not math.isfinite(stamp):
            raise DatasetError(f"{place}: The time stamp is not finite. Write it in seconds.")
        # a list from elsewhere must not make us read any file of this machine
        if PurePosixPath(file).is_absolute() or ".." in re.split(r"[/\\]", file):
            raise DatasetError(
                f"{place}: The file lies outside the folder. List files below {path.parent}."
            )
        if not (path.parent / file).is_file():
            raise DatasetError(
                f"{place}: There is no file {file}. Unpack it, or take the line out."
            )
        listed.append((stamp, file))
    if not listed:
        raise DatasetError(f"{path}: The list is empty. List the depth images in it.")
    return listed


def _is_folder(entry: os.DirEntry[str]) -> bool:
    try:
        return entry.is_dir()
    except OSError:  # a symlink to itself
        return False


def _may_be_cloud(file: str) -> bool:
    return is_cloud(file) or file.lower().endswith(".npy")


def _is_depth(file: str) -> bool:
    lowered = file.lower()
    return (
        lowered.endswith((".png", ".npy"))
        and not lowered.endswith(".color.png")
        and "rgb" not in lowered
    )
