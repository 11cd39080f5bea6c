"""From a path to the sequences below it.

path  --find_sequences-->  Sequence, ...
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from sceneprint.datasets.clouds import FILE_NAME as CLOUDS_FILE
from sceneprint.datasets.clouds import is_cloud
from sceneprint.datasets.files import data_lines, read_text
from sceneprint.datasets.intrinsics import find_camera
from sceneprint.datasets.layouts import layout_of, list_folder, references
from sceneprint.datasets.records import Layout, Sequence, Split
from sceneprint.datasets.sizes import HEAD
from sceneprint.errors import DatasetError, SceneprintError
from sceneprint.scans import format_of

_DEPTH = 4  #: folders below the one given that are looked into
_MAXIMUM_FOLDERS = 10_000  #: that are looked into; more is no data set but a disk
_MAXIMUM_SPLIT_BYTES = 65_536
_SEQUENCE_FOLDER = re.compile(r"seq-?(\d+)", re.IGNORECASE | re.ASCII)
_SPLIT_LINE = re.compile(r"(?:sequence|seq)[\s_-]*(\d{1,9})", re.IGNORECASE | re.ASCII)
_SPLIT_FILES: tuple[tuple[str, Split], ...] = (
    ("TrainSplit.txt", "train"),
    ("TestSplit.txt", "test"),
)
_COLOUR_FOLDERS = ("rgb", "color", "colour")


def find_sequences(path: Path | str) -> tuple[Sequence, ...]:
    """Return the sequences at a path or up to 4 folders below it; no frame is read.

    Understood are a 7-Scenes sequence or scene (with TrainSplit.txt, TestSplit.txt), a TUM
    RGB-D folder, a folder of depth images (PNG or NPY; `*.color.png` and `*rgb*` are left
    out), a folder of point clouds (PLY, PCD, KITTI .bin, LAS, LAZ; NPY beside a clouds.json),
    one depth image or cloud, and folders of these. A sequence is named by its place below
    the path, or by its own folder where that is the path.

    Parameters
    ----------
    path : a folder or a file

    Returns
    -------
    sequences : at least one, in natural order of their names

    Raises
    ------
    DatasetError : nothing is there, there is no intrinsics.json for depth, a list names what is
        not there, or two scenes have one name.
    InvalidIntrinsics : an intrinsics.json describes no camera.
    InvalidPose : a groundtruth.txt holds a line that is no pose.
    """
    # a name such as .. is none; a symlink's own name is what the user knows it by
    path = Path(path)
    root = path.resolve() if ".." in path.parts else path.absolute()
    if root.is_file():
        return (_single(root),)
    if not root.is_dir():
        raise DatasetError(f"{path}: There is no such file or folder. Check the path.")
    found = tuple(_sequence(*one, _name(one[0], root)) for one in _walk(root))
    if not found:
        raise DatasetError(
            f"{path}: There is no depth image or cloud here or up to {_DEPTH} folders below. Name "
            "a 7-Scenes scene or sequence (frame-000000.depth.png), a TUM RGB-D folder "
            "(depth.txt), a folder of 16-bit PNG or float NPY depth images, one of PLY, PCD, "
            "KITTI .bin, LAS or LAZ clouds, or one such file."
        )
    _check_parent_frames(found)
    return found


def find_each(root: Path) -> tuple[tuple[Sequence, ...], tuple[tuple[str, SceneprintError], ...]]:
    """As `find_sequences`, where a sequence that is damaged must not cost the others.

    Parameters
    ----------
    root : a folder, absolute

    Returns
    -------
    sequences : that are sound; there may be none
    refused : name of each other one, and why

    Raises
    ------
    DatasetError : there are too many folders, or two scenes have one name.
    """
    found, refused = [], []
    for one in _walk(root):
        name = _name(one[0], root)
        try:
            found.append(_sequence(*one, name))
        except SceneprintError as error:
            refused.append((name, error))
    sequences = tuple(found)
    _check_parent_frames(sequences)
    return sequences, tuple(refused)


def _walk(root: Path) -> Iterator[tuple[Path, list[str], Layout]]:
    """Yield the folders that are sequences, depth first in natural order."""
    seen: set[Path] = set()  # resolved: a symlink back up is not entered twice
    waiting = [(root, 0)]
    while waiting:
        folder, depth = waiting.pop()
        try:
            resolved = folder.resolve()
        except (OSError, RuntimeError):  # a symlink to itself
            continue
        if resolved in seen:
            continue
        seen.add(resolved)
        if len(seen) > _MAXIMUM_FOLDERS:
            raise DatasetError(
                f"{root}: There are more than {_MAXIMUM_FOLDERS} folders here. "
                "Name the folder of the data set."
            )
        files, folders = list_folder(folder)
        layout = layout_of(files)
        # a scene may hold a picture or a mesh of itself beside its sequences
        scene = any(_SEQUENCE_FOLDER.fullmatch(name) for name in folders) or (
            layout is Layout.CLOUDS
            and ("depth" in folders or _is_above_images(folder, files, folders, depth))
        )
        if layout is not None and not (layout in (Layout.PLAIN, Layout.CLOUDS) and scene):
            yield folder, files, layout
        elif depth < _DEPTH:
            waiting += [
                (folder / name, depth + 1) for name in reversed(folders) if not is_of_colour(name)
            ]


def _is_above_images(folder: Path, files: list[str], folders: list[str], depth: int) -> bool:
    """Whether points lie above folders of depth images whose camera is known, and nothing says
    that they are frames: they are a mesh of what is below, and must not hide it.
    """
    if CLOUDS_FILE in files:
        return False
    waiting = [(folder / name, depth + 1) for name in folders]
    looked = 0
    while waiting and looked < _MAXIMUM_FOLDERS:
        below, deep = waiting.pop()
        looked += 1
        if deep > _DEPTH or is_of_colour(below.name):
            continue
        try:
            own, deeper = list_folder(below)
            if layout_of(own) not in (None, Layout.CLOUDS):
                find_camera(below)
                return True
        except DatasetError:  # colour images alone have no camera; others say why in their turn
            continue
        except SceneprintError:  # a camera that is none: whoever reads the images says why
            return True
        waiting += [(below / name, deep + 1) for name in deeper]
    return False


def is_of_colour(folder: str) -> bool:
    """Whether a folder of that name is left out; rgbd_dataset_freiburg1_xyz is none of them."""
    name = folder.lower().replace("rgbd", "")
    return any(colour in name for colour in _COLOUR_FOLDERS)


def _sequence(folder: Path, files: list[str], layout: Layout, name: str) -> Sequence:
    frames = references(folder, files, layout, name)
    if layout is Layout.SEVEN_SCENES and _SEQUENCE_FOLDER.fullmatch(folder.name):
        scene = folder.parent
        return Sequence(name, folder, layout, scene.name, _split(folder), frames)
    return Sequence(name, folder, layout, name, None, frames)


def _single(file: Path) -> Sequence:
    """Return a sequence of one frame, its pose beside it unless it is a depth image of any name."""
    folder, points = file.parent, is_cloud(file.name) or _is_npy_of_points(file)
    stem = file.stem if points else file.name.removesuffix(".depth.png")
    pose = f"{stem}.pose.txt"
    layout = Layout.CLOUDS if points else layout_of([file.name])
    if layout in (Layout.SEVEN_SCENES, Layout.CLOUDS):
        # beside clouds.json a .npy is of points; what it says is read from the disk, if it is there
        known = [pose] if (folder / pose).is_file() else []
        files = [file.name, *known, *([CLOUDS_FILE] if points else [])]
        return _sequence(folder, files, layout, folder.name)
    # what is named outright is taken, whatever its name; its content decides
    frames = references(folder, ["x.png"], Layout.PLAIN, folder.name)
    frame = replace(frames[0], name=f"{folder.name}/{file.stem}", path=file)
    return Sequence(folder.name, folder, Layout.PLAIN, folder.name, None, (frame,))


def _is_npy_of_points(file: Path) -> bool:
    """Whether clouds.json is beside it; or no camera, and its content is N x 3 or N x 4."""
    if file.suffix.lower() != ".npy":
        return False
    if (file.parent / CLOUDS_FILE).is_file():
        return True
    try:
        find_camera(file.parent)
    except DatasetError:
        pass
    else:
        return False
    try:
        with file.open("rb") as opened:
            return format_of(opened.read(HEAD)) == "npy"
    except OSError:  # whoever reads the frame says why
        return False


def _split(folder: Path) -> Split | None:
    """Return what the scene's split files use this sequence for."""
    match = _SEQUENCE_FOLDER.fullmatch(folder.name)
    number = int(match[1]) if match else -1
    uses: list[Split] = []
    for file, use in _SPLIT_FILES:
        path = folder.parent / file
        if path.is_file() and number in _split_numbers(path):
            uses.append(use)
    if len(uses) > 1:
        raise DatasetError(
            f"{folder.parent}: Sequence {number} is for training and for testing. "
            "Take it out of TrainSplit.txt or TestSplit.txt."
        )
    return uses[0] if uses else None


def _split_numbers(path: Path) -> set[int]:
    """Return the sequences that a split file lists, each of which must be there."""
    _, folders = list_folder(path.parent)
    present = {int(m[1]) for name in folders if (m := _SEQUENCE_FOLDER.fullmatch(name))}
    numbers = set()
    for number, line in data_lines(read_text(path, _MAXIMUM_SPLIT_BYTES, DatasetError)):
        match = _SPLIT_LINE.fullmatch(line)
        if match is None:
            raise DatasetError(
                f"{path}, line {number}: This names no sequence. Write lines such as sequence1."
            )
        if int(match[1]) not in present:
            # evaluating on part of a split in silence would be worse
            raise DatasetError(
                f"{path}, line {number}: There is no folder seq-{int(match[1]):02d}. "
                "Unpack it, or take the line out."
            )
        numbers.add(int(match[1]))
    return numbers


def _name(folder: Path, root: Path) -> str:
    return folder.name if folder == root else folder.relative_to(root).as_posix()


def _check_parent_frames(sequences: tuple[Sequence, ...]) -> None:
    """Two scenes of one name would pass for one place, and their poses for comparable."""
    scenes: dict[str, Path] = {}
    for sequence in sequences:
        own = sequence.parent_frame == sequence.name
        place = sequence.folder if own else sequence.folder.parent
        if scenes.setdefault(sequence.parent_frame, place) != place:
            raise DatasetError(
                f"{place}: Another scene is called {sequence.parent_frame} too, "
                f"{scenes[sequence.parent_frame]}. Rename one, or read them one at a time."
            )
