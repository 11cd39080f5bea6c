"""Search for the sequences below a path, and atomic writers of their files.

path  --find_sequences-->  Sequence, ...
Camera, depth (H, W), T_parent_sensor (4, 4)  -->  intrinsics.json, *.png, *.txt
rows of `trajectory_row`  --trajectory_text-->  text for `read_trajectory`
"""

from __future__ import annotations

import io
import json
import math
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

import numpy as np

from sceneprint.atomic_files import write_whole
from sceneprint.errors import DatasetError, SceneprintError
from sceneprint.formats.dataset.frame_names import (
    OMITTED_IMAGES,
    is_beside_depth,
    is_depth,
    is_image,
)
from sceneprint.formats.dataset.frame_reference import (
    FrameReference,
    FrameSequence,
    Layout,
    Split,
    read_trajectory,
)
from sceneprint.formats.recording.bag import is_packed, is_recording
from sceneprint.types import Floats, Floats32
from sceneprint_client.files import data_lines, read_text
from sceneprint_client.formats import format_named, is_cloud, titles_of
from sceneprint_client.frame_files import (
    NO_POSE_FILE,
    SEVEN_SCENES,
    find_frame_file,
    find_pose_file,
    seven_scenes_number,
)
from sceneprint_client.poses import SensorTrajectory, interpolate, quaternion_of, rigid_transform
from sceneprint_client.sidecars import (
    CLOUDS_FILE,
    INTRINSICS_FILE,
    Camera,
    CloudSource,
    find_camera,
    find_cloud_source,
)
from sceneprint_client.transforms import FASTEST, TOLERANCE_S, doubtful

if TYPE_CHECKING:
    from sceneprint.formats.recording.selection import RecordingOptions

_DEPTH_LIST, _TRAJECTORY = "depth.txt", "groundtruth.txt"
_MAXIMUM_LIST_BYTES = 2**26
#: Names of files with the poses of several frames, in formats that are not read.
_OF_POSES = re.compile(
    r"\w*(poses|traj|trajectory|odometry|groundtruth)\.(txt|csv|tum|log|json|npy)"
)


def list_folder(folder: Path) -> tuple[list[str], list[str]]:
    """Return the names of the visible files and of the visible subfolders of a folder.

    Both lists are in natural order: frame 9 precedes frame 10.

    Raise DatasetError if the folder cannot be read.
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
            f"{folder}: The folder cannot be read ({cause.strerror}). Check its permissions."
        ) from cause
    return sorted(files, key=natural), sorted(folders, key=natural)


def natural(name: str) -> tuple[list[tuple[int, str]], str]:
    """Return a sort key for natural order: digits are compared as numbers, ties as text."""
    parts = re.split(r"(\d+)", name, flags=re.ASCII)
    # compare runs of digits by length, then as text, because a number may be arbitrarily long
    key = [
        (len(part.lstrip("0")), part.lstrip("0")) if i % 2 else (0, part)
        for i, part in enumerate(parts)
    ]
    return key, name


def layout_of(files: list[str]) -> Layout | None:
    """Return the layout of a folder with these files; None if no file has depth or points.

    If a folder has depth images and point clouds, a clouds.json selects the clouds; otherwise, the
    images are selected.
    """
    if any(SEVEN_SCENES.fullmatch(file) for file in files):
        return Layout.SEVEN_SCENES
    if _DEPTH_LIST in files:
        return Layout.TUM
    if CLOUDS_FILE in files and any(map(_may_be_cloud, files)):
        return Layout.CLOUDS
    if any(map(is_depth, files)):
        return Layout.PLAIN
    return Layout.CLOUDS if any(map(is_cloud, files)) else None


def references(
    folder: Path, files: list[str], layout: Layout, name: str, camera: Camera | None = None
) -> tuple[tuple[FrameReference, ...], str]:
    """Return the frames of a folder, and the reason why some have no pose ("" if all have poses).

    Parameters
    ----------
    folder : folder of the frames; for depth images, it or a parent has an `intrinsics.json`
    files : names of the files in the order of `list_folder`
    name : name of the sequence, a prefix of the frames' names
    camera : camera of a 7-Scenes sequence without an intrinsics.json

    Raises
    ------
    DatasetError : If intrinsics.json is missing, depth.txt or clouds.json is invalid, or two frames
        would have the same name.
    InvalidIntrinsics : If intrinsics.json does not describe a camera.
    InvalidPose : If a line of groundtruth.txt is not a pose.
    """
    unposed = NO_POSE_FILE
    if layout is Layout.TUM:
        frames, unposed = _tum(folder, files, name)
    elif layout is Layout.CLOUDS:
        # a clouds.json says that the .npy files beside it are points
        selected = filter(_may_be_cloud if CLOUDS_FILE in files else is_cloud, files)
        frames = _posed_files(folder, selected, name, cloud=find_cloud_source(folder))
    else:
        is_scene = layout is Layout.SEVEN_SCENES
        try:
            camera = find_camera(folder)
        except DatasetError:
            if camera is None or not is_scene:
                raise
        selected = filter(SEVEN_SCENES.fullmatch if is_scene else is_depth, files)
        frames = _posed_files(folder, selected, name, camera)
    first: dict[str, Path] = {}
    for frame in frames:
        if frame.name in first:
            raise DatasetError(
                f"{frame.path}: The frame would have the same name as {first[frame.name].name}, "
                f"{frame.name}. Rename or remove one of them."
            )
        first[frame.name] = frame.path
    if all(frame.pose_source is not None for frame in frames):
        unposed = ""
    return tuple(_numbered(folder, frame, i) for i, frame in enumerate(frames)), unposed


def _numbered(folder: Path, frame: FrameReference, place: int) -> FrameReference:
    """Return a frame with its path in the folder and the number in its file name, or `place`."""
    number = seven_scenes_number(frame.path.name)
    return replace(
        frame,
        original=frame.path.relative_to(folder).as_posix(),
        sequence=place if number is None else number,
    )


def _posed_files(
    folder: Path, files: Iterable[str], name: str, camera: Camera | None = None,
    cloud: CloudSource | None = None,
) -> tuple[FrameReference, ...]:  # fmt: skip
    frames = []
    for file in files:
        stem = file.removesuffix(".depth.png") if SEVEN_SCENES.fullmatch(file) else Path(file).stem
        pose = find_pose_file(folder, stem)
        frames.append(
            FrameReference(f"{name}/{stem}", folder / file, camera, pose_source=pose, cloud=cloud)
        )
    return tuple(frames)


def _tum(folder: Path, files: list[str], name: str) -> tuple[tuple[FrameReference, ...], str]:
    """Return the frames of a TUM RGB-D folder, and the reason why some have no pose."""
    camera = find_camera(folder)
    listed = sorted(_depth_list(folder / _DEPTH_LIST))
    stamps = [stamp for stamp, _ in listed]
    poses: list[Floats | None] = [None] * len(stamps)
    unposed = f"the folder has no {_TRAJECTORY}"
    if _TRAJECTORY in files:
        trajectory = read_trajectory(folder / _TRAJECTORY)
        poses = interpolate(trajectory, stamps, tolerance=TOLERANCE_S)
        alone = [stamp for stamp, pose in zip(stamps, poses, strict=True) if pose is None]
        unposed = (
            f"{_TRAJECTORY} has no pose within {1000 * TOLERANCE_S:.0f} ms of their time stamps "
            f"(nearest: {_least_distance(trajectory, alone):.3g} s away)"
        )
        doubts = doubtful(trajectory, stamps)
        if any(doubts):
            poses = [None if doubt else T for doubt, T in zip(doubts, poses, strict=True)]
            unposed += f", or its poses contradict each other ({FASTEST:g} m/s)"
    return tuple(
        FrameReference(f"{name}/{Path(file).stem}", folder / file, camera, stamp, pose)
        for (stamp, file), pose in zip(listed, poses, strict=True)
    ), unposed


def _least_distance(trajectory: SensorTrajectory, stamps: list[float]) -> float:
    """Return the minimum time between a stamp and a pose, seconds."""
    after = np.searchsorted(trajectory.stamps, stamps)
    around = np.clip([after - 1, after], 0, len(trajectory.stamps) - 1)
    return float(np.abs(trajectory.stamps[around] - stamps).min(initial=math.inf))


def _depth_list(path: Path) -> list[tuple[float, str]]:
    """Return the time stamp, seconds, and the file of each line of depth.txt."""
    listed = []
    for number, line in data_lines(read_text(path, _MAXIMUM_LIST_BYTES, DatasetError)):
        place, words = f"{path}, line {number}", line.split(maxsplit=1)
        try:
            stamp, file = float(words[0]), words[1]
        except (ValueError, IndexError) as cause:
            raise DatasetError(
                f"{place}: The line is not a time stamp and a file. Write both, separated by a "
                "space."
            ) from cause
        if not math.isfinite(stamp):
            raise DatasetError(f"{place}: The time stamp is not finite. Write it in seconds.")
        # an untrusted list must not select arbitrary files of this machine
        if PurePosixPath(file).is_absolute() or ".." in re.split(r"[/\\]", file):
            raise DatasetError(
                f"{place}: The file is outside the folder. List files below {path.parent}."
            )
        if not (path.parent / file).is_file():
            raise DatasetError(
                f"{place}: The file {file} does not exist. Unpack it, or remove the line."
            )
        listed.append((stamp, file))
    if not listed:
        raise DatasetError(f"{path}: The list is empty. Add the depth images to it.")
    return listed


def _is_folder(entry: os.DirEntry[str]) -> bool:
    try:
        return entry.is_dir()
    except OSError:  # a cycle of symbolic links
        return False


def _may_be_cloud(file: str) -> bool:
    return format_named(file, "cloud") is not None


_DEPTH = 4  #: maximum depth of the search below the user's path, folders
_MAXIMUM_FOLDERS = 10_000  #: maximum number of searched folders; larger trees are not data sets
_MAXIMUM_SPLIT_BYTES = 65_536
_MOST_NAMES = 5  #: maximum number of names in a note
_SEQUENCE_FOLDER = re.compile(r"seq-?(\d+)", re.IGNORECASE | re.ASCII)
_SPLIT_LINE = re.compile(r"(?:sequence|seq)[\s_-]*(\d{1,9})", re.IGNORECASE | re.ASCII)
_SPLIT_FILES: tuple[tuple[str, Split], ...] = (
    ("TrainSplit.txt", "train"),
    ("TestSplit.txt", "test"),
)


def find_sequences(
    path: Path | str, recording: RecordingOptions | None = None, camera: Camera | None = None
) -> tuple[FrameSequence, ...]:
    """Return the sequences at a path or up to 4 folders below it, without reading frames.

    Supported are:

    * a 7-Scenes sequence or scene (with TrainSplit.txt, TestSplit.txt) of depth images or clouds,
    * a TUM RGB-D folder,
    * a folder of depth images or point clouds (NPY files of points need a clouds.json),
    * a single depth image or cloud,
    * ROS recordings: one sequence each, or several if the time stamps jump back,
    * files and folders of RTAB-Map, E57, Polycam, Record3D and nerfstudio,
    * folders of these.

    Files and folders whose names indicate colour, infrared, confidence or labels are omitted, and
    listed in a note. The name of a sequence is its path relative to `path`, or the name of `path`.

    Parameters
    ----------
    path : a folder or a file
    recording : options for recordings; by default, topics and frames are selected automatically
    camera : camera of 7-Scenes sequences without an intrinsics.json, such as the official download

    Returns
    -------
    sequences : at least one sequence, in natural order of the names

    Raises
    ------
    DatasetError : If there are no frames, an intrinsics.json or a listed file is missing, two
        scenes or recordings have the same name, or recordings are mixed with other frames.
    InvalidIntrinsics : If an intrinsics.json does not describe a camera.
    InvalidPose : If a line of a groundtruth.txt is not a pose.
    MissingDependency : If the path is a recording and rosbags is not installed.
    """
    # `..` must be resolved to get a name; a symbolic link keeps its own name
    path = Path(path)
    root = path.resolve() if ".." in path.parts else path.absolute()
    from sceneprint.formats import exports
    from sceneprint.formats.recording import selection as ros  # only recordings need this import

    if is_recording(root) and root.exists():
        return ros.recording_sequences(root, recording or ros.RecordingOptions())
    if root.is_file():
        return exports.file_sequences(root) if exports.is_export(root) else (_single_frame(root),)
    if not root.is_dir():
        raise DatasetError(f"{path}: The file or folder does not exist. Check the path.")
    left_out: list[Path] = []
    walked = list(_walk(root, left_out))
    if any(layout is Layout.RECORDING for _, _, layout in walked):
        return _recordings(root, walked, recording or ros.RecordingOptions())
    sequences = tuple(
        sequence for location in walked for sequence in _sequences_in(*location, root, camera)
    )
    note = _describe_omissions(left_out, root)
    if not sequences:
        raise DatasetError(
            f"{path}: There is no depth image or cloud here or up to {_DEPTH} folders below"
            f"{note and f' ({note})'}. Specify "
            "a 7-Scenes scene or sequence (frame-000000.depth.png), a TUM RGB-D folder "
            f"(depth.txt), a folder of depth images ({titles_of('depth')}) or clouds "
            f"({titles_of('cloud')}), one such file, ROS recordings "
            f"({titles_of('recording')}), a file of {titles_of('capture', last='or')}, or an "
            "export of Polycam, Record3D or nerfstudio."
        )
    _check_parent_frames(sequences)
    return _with_note(sequences, note)


def _with_note(sequences: Sequence[FrameSequence], note: str) -> tuple[FrameSequence, ...]:
    """Return the sequences, with `note` appended to the note of the first one."""
    first = [
        replace(sequence, note="; ".join(filter(None, (sequence.note, note))))
        for sequence in sequences[:1]
    ]
    return (*first, *sequences[1:])


def _describe_omissions(left_out: list[Path], root: Path) -> str:
    """Return a note on the files and folders that were omitted because of their names."""
    if not left_out:
        return ""
    names = [path.relative_to(root.parent).as_posix() for path in left_out]
    more = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
    return f"skipped: {', '.join(names[:_MOST_NAMES])}{more} ({OMITTED_IMAGES})"


def find_recordings(path: Path) -> list[Path]:
    """Return the ROS recordings at a path or up to 4 folders below it, in natural order."""
    if is_recording(path):
        return [path]
    return _bags(_walk(path)) if path.is_dir() else []


def _bags(walked: Iterable[tuple[Path, list[str], Layout]]) -> list[Path]:
    return [folder / name for folder, names, layout in walked
            if layout is Layout.RECORDING for name in names]  # fmt: skip


def _recordings(
    root: Path, walked: list[tuple[Path, list[str], Layout]], options: RecordingOptions
) -> tuple[FrameSequence, ...]:
    """Return the sequences of several recordings, named by their paths relative to `root`.

    Raise DatasetError if there are other frames too, or two recordings have the same name; for
    further errors, see `recording_sequences`.
    """
    from sceneprint.formats.recording.selection import recording_name, recording_sequences

    bags = _bags(walked)
    other = next((result for result in walked if result[2] is not Layout.RECORDING), None)
    if other is not None:
        raise DatasetError(
            f"{root}: The folder has both ROS recordings, such as {bags[0].relative_to(root)}, and "
            f"other frames, in {_name(other[0], root)} ({other[2].value}). Specify one of them, or "
            "move the recordings to a separate folder."
        )
    first: dict[str, Path] = {}
    for bag in bags:
        name = (bag.parent / recording_name(bag)).relative_to(root).as_posix()
        if name in first:
            raise DatasetError(
                f"{bag}: The recording would have the same name as {first[name].name}, {name}. "
                "Rename or remove one of them."
            )
        first[name] = bag
    return tuple(
        sequence
        for name, bag in first.items()
        for sequence in recording_sequences(bag, options, name)
    )


def find_each(
    root: Path,
) -> tuple[tuple[FrameSequence, ...], tuple[tuple[str, SceneprintError], ...]]:
    """Return the readable sequences below a folder, and the errors of unreadable sequences.

    ROS recordings are skipped; see `find_sequences` for the other layouts.

    Parameters
    ----------
    root : absolute path of a folder

    Returns
    -------
    sequences : readable sequences; may be empty
    refused : name and error of each unreadable sequence

    Raises
    ------
    DatasetError : If there are too many folders, or two scenes have the same name.
    """
    sequences: list[FrameSequence] = []
    refused = []
    left_out: list[Path] = []
    for result in _walk(root, left_out):
        if result[2] is Layout.RECORDING:
            continue
        name = _name(result[0], root)
        try:
            sequences += _sequences_in(*result, root)
        except SceneprintError as error:
            refused.append((name, error))
    with_note = _with_note(sequences, _describe_omissions(left_out, root))
    _check_parent_frames(with_note)
    return with_note, tuple(refused)


def _walk(
    root: Path, left_out: list[Path] | None = None
) -> Iterator[tuple[Path, list[str], Layout]]:
    """Yield the path, file names and layout of each sequence, depth first in natural order.

    For ROS recordings, the path is that of their folder, and the names are those of the recordings.
    For a single file of another system, the list of names is empty. Images and folders that are
    omitted because of their names are added to `left_out`.
    """
    beside = [] if left_out is None else left_out
    from sceneprint.formats import exports

    visited: set[Path] = set()  # resolved paths, to end cycles of symbolic links
    waiting = [(root, 0)]
    while waiting:
        folder, depth = waiting.pop()
        try:
            resolved = folder.resolve()
        except (OSError, RuntimeError):  # a cycle of symbolic links
            continue
        if resolved in visited:
            continue
        visited.add(resolved)
        if len(visited) > _MAXIMUM_FOLDERS:
            raise DatasetError(
                f"{root}: There are more than {_MAXIMUM_FOLDERS} folders here. "
                "Specify the folder of the data set."
            )
        files, folders = list_folder(folder)
        bags = [name for name in files if format_named(name, "recording")]
        bags += [x for x in files if is_packed(Path(x)) and x.rpartition(".")[0] not in files]
        bags += [name for name in folders if is_recording(folder / name)]
        if bags:
            bags.sort(key=natural)
            yield folder, bags, Layout.RECORDING
            folders = [name for name in folders if name not in bags]
        layout = exports.folder_layout(folder, files, folders)
        if layout is not None:
            yield folder, files, layout
            continue
        layout = layout_of(files)
        # a scene's folder may have an image or a mesh of the scene beside its sequences
        scene = any(_SEQUENCE_FOLDER.fullmatch(name) for name in folders) or (
            layout is Layout.CLOUDS
            and ("depth" in folders or _is_above_images(folder, files, folders, depth))
        )
        if layout in (Layout.PLAIN, None):
            beside += [folder / file for file in files if is_image(file) and is_beside_depth(file)]
        if layout is not None and not (layout in (Layout.PLAIN, Layout.CLOUDS) and scene):
            yield folder, files, layout
        elif depth < _DEPTH:
            beside += [folder / name for name in folders if is_beside_depth(name)]
            exported = [folder / file for file in files if exports.is_export(folder / file)]
            yield from ((path, [], Layout.E57) for path in exported)
            entered = [name for name in reversed(folders) if not is_beside_depth(name)]
            waiting += [(folder / name, depth + 1) for name in entered]


def _is_above_images(folder: Path, files: list[str], folders: list[str], depth: int) -> bool:
    """Return whether a folder of points has subfolders of depth images with a known camera.

    Without a clouds.json, such points are a mesh of the scene, not frames.
    """
    if CLOUDS_FILE in files:
        return False
    waiting = [(folder / name, depth + 1) for name in folders]
    looked = 0
    while waiting and looked < _MAXIMUM_FOLDERS:
        below, deep = waiting.pop()
        looked += 1
        if deep > _DEPTH or is_beside_depth(below.name):
            continue
        try:
            files_below, deeper = list_folder(below)
            if layout_of(files_below) not in (None, Layout.CLOUDS):
                find_camera(below)
                return True
        except DatasetError:  # without a camera, the images may be colour images
            continue
        except SceneprintError:  # an invalid camera; the reader of the images reports it
            return True
        waiting += [(below / name, deep + 1) for name in deeper]
    return False


def _sequences_in(
    path: Path, files: list[str], layout: Layout, root: Path, camera: Camera | None = None
) -> tuple[FrameSequence, ...]:
    """Return the sequences in a folder or file that `_walk` found below `root`."""
    from sceneprint.formats import exports

    if not layout.is_export:
        name = _name(path, root)
        frames, unposed = references(path, files, layout, name, camera)
        sequence = _make_sequence(path, layout, name, frames, unposed)
        poses = _unread_poses(path, files)
        if poses and all(frame.pose_source is None for frame in frames):
            why = unposed if _TRAJECTORY in files else f"{unposed}; {poses} is not read"
            sequence = replace(sequence, unposed=why, lost=len(frames))
        unread = _unread_folders(path) if layout in (Layout.PLAIN, Layout.CLOUDS) else {}
        if unread:
            names = ", ".join(list(unread)[:_MOST_NAMES])
            note = f"not read: {names} (below a folder with frames; specify it separately)"
            sequence = replace(sequence, note=note, lost=sequence.lost + sum(unread.values()))
        return (sequence,)
    if path.is_file():
        return exports.file_sequences(path, _name(path.with_suffix(""), root))
    return (exports.folder_sequence(path, layout, _name(path, root)),)


def _unread_poses(folder: Path, files: list[str]) -> str:
    """Return the name of a file beside frames, or above, that may contain their poses, or ""."""
    if _TRAJECTORY in files:  # it fits no frame
        return _TRAJECTORY
    above: list[str] = []
    with suppress(DatasetError):  # the folder is not readable
        above = list_folder(folder.parent)[0]
    return next((file for file in (*files, *above) if _OF_POSES.fullmatch(file.lower())), "")


def _unread_folders(folder: Path) -> dict[str, int]:
    """Return the names of subfolders that have frames too, and the number of frames in each."""
    counts = {}
    for name in list_folder(folder)[1]:
        if is_beside_depth(name):
            continue
        with suppress(DatasetError):  # the folder is not readable
            files = list_folder(folder / name)[0]
            counts[f"{folder.name}/{name}"] = sum(is_depth(x) or is_cloud(x) for x in files)
    return {name: count for name, count in counts.items() if count}


def _make_sequence(
    folder: Path, layout: Layout, name: str, frames: tuple[FrameReference, ...], unposed: str
) -> FrameSequence:
    seven, clouds = layout is Layout.SEVEN_SCENES, layout is Layout.CLOUDS
    split = _split(folder) if seven or clouds else None
    # clouds belong to a scene only if one of its split files lists them
    in_scene = split or (seven and _SEQUENCE_FOLDER.fullmatch(folder.name))
    parent_frame = folder.parent.name if in_scene else name
    return FrameSequence(name, folder, layout, parent_frame, split, frames, unposed=unposed)


def _single_frame(file: Path) -> FrameSequence:
    folder, frame = file.parent, FrameReference(**vars(find_frame_file(file)))
    unposed = NO_POSE_FILE if frame.pose_source is None else ""
    if frame.camera is not None and SEVEN_SCENES.fullmatch(file.name):
        return _make_sequence(folder, Layout.SEVEN_SCENES, folder.name, (frame,), unposed)
    layout = Layout.PLAIN if frame.cloud is None else Layout.CLOUDS
    return FrameSequence(folder.name, folder, layout, folder.name, None, (frame,), unposed=unposed)


def _split(folder: Path) -> Split | None:
    """Return the use that the scene's split files state for a sequence; None if neither lists it.

    Raise DatasetError if both list it.
    """
    match = _SEQUENCE_FOLDER.fullmatch(folder.name)
    number = int(match[1]) if match else -1
    uses: list[Split] = []
    for file, use in _SPLIT_FILES:
        path = folder.parent / file
        if path.is_file() and number in _split_numbers(path):
            uses.append(use)
    if len(uses) > 1:
        raise DatasetError(
            f"{folder.parent}: Sequence {number} is listed for both training and testing. "
            "Remove it from TrainSplit.txt or TestSplit.txt."
        )
    return uses[0] if uses else None


def _split_numbers(path: Path) -> set[int]:
    """Return the sequence numbers in a split file; raise DatasetError if a sequence is missing.

    An evaluation on an incomplete split would be misleading.
    """
    _, folders = list_folder(path.parent)
    present = {int(m[1]) for name in folders if (m := _SEQUENCE_FOLDER.fullmatch(name))}
    numbers = set()
    for number, line in data_lines(read_text(path, _MAXIMUM_SPLIT_BYTES, DatasetError)):
        match = _SPLIT_LINE.fullmatch(line)
        if match is None:
            raise DatasetError(
                f"{path}, line {number}: The line is not a sequence. Write lines such as sequence1."
            )
        if int(match[1]) not in present:
            raise DatasetError(
                f"{path}, line {number}: The folder seq-{int(match[1]):02d} does not exist. "
                "Unpack it, or remove the line."
            )
        numbers.add(int(match[1]))
    return numbers


def _name(folder: Path, root: Path) -> str:
    return folder.name if folder == root else folder.relative_to(root).as_posix()


def _check_parent_frames(sequences: tuple[FrameSequence, ...]) -> None:
    """Raise DatasetError if two scenes have the same name: their poses would seem comparable."""
    scenes: dict[str, Path] = {}
    for sequence in sequences:
        place = sequence.place
        if scenes.setdefault(sequence.parent_frame, place) != place:
            raise DatasetError(
                f"{place}: Another scene, {scenes[sequence.parent_frame]}, has the same name "
                f"{sequence.parent_frame}. Rename one of them, or specify one at a time."
            )


_LARGEST = 65_534  #: maximum depth, stored units; 65535 means missing


def write_intrinsics(folder: Path, camera: Camera) -> Path:
    """Write `intrinsics.json` into a folder; return its path."""
    lens = camera.intrinsics
    fields: dict[str, object] = {
        "width": lens.width, "height": lens.height, "fx": lens.fx, "fy": lens.fy, "cx": lens.cx,
        "cy": lens.cy, "depth_scale": camera.depth_scale,
    }  # fmt: skip
    if lens.distortion:
        fields["distortion"] = list(lens.distortion)
    if camera.along_ray:
        fields["depth_along_ray"] = True
    if camera.up is not None:
        fields["up"] = list(camera.up)
    path = folder / INTRINSICS_FILE
    write_whole(path, (json.dumps(fields, indent=2) + "\n").encode())
    return path


def write_depth_png(path: Path, depth: Floats32, depth_scale: float) -> None:
    """Write a depth image as a 16-bit greyscale PNG.

    Parameters
    ----------
    depth : (H, W) metres; samples that are not finite, not positive, or beyond 65534 stored units
        are written as 0 (missing)
    depth_scale : stored units per metre

    Raises
    ------
    ValueError : If the depth is empty or not two-dimensional, or the scale is not positive.
    """
    from PIL import Image

    if depth.ndim != 2 or depth.size == 0:
        raise ValueError(f"depth has shape {depth.shape}, not (H, W)")
    if not (math.isfinite(depth_scale) and depth_scale > 0):
        raise ValueError(f"depth_scale is {depth_scale}, not a positive number")
    with np.errstate(all="ignore"):
        units = np.rint(depth.astype(np.float64) * depth_scale)
        units[~((units > 0) & (units <= _LARGEST))] = 0.0
    buffer = io.BytesIO()
    Image.fromarray(units.astype(np.uint16)).save(buffer, format="PNG")
    write_whole(path, buffer.getvalue())


def write_pose(path: Path, T_parent_sensor: Floats) -> None:
    """Write a pose (4, 4) as text, row by row, without loss of precision.

    Raise InvalidPose if the pose is not a rigid transform.
    """
    rows = rigid_transform(T_parent_sensor)
    text = "".join(" ".join(f"{value:.17g}" for value in row) + "\n" for row in rows)
    write_whole(path, text.encode())


def trajectory_row(stamp: float, T_parent_sensor: Floats) -> list[float]:
    """Return a pose (4, 4) as a row of a TUM file: t tx ty tz qx qy qz qw, seconds and metres."""
    T = T_parent_sensor
    return [stamp, *T[:3, 3].tolist(), *quaternion_of(T[:3, :3]).tolist()]


def trajectory_text(rows: Iterable[Sequence[float]], comments: Iterable[str] = ()) -> str:
    """Format a TUM trajectory as text, without loss of precision.

    Parameters
    ----------
    rows : rows of `trajectory_row`
    comments : header lines, such as the names of the poses' frames; escaped to printable ASCII
    """
    lines = [f"# {comment.encode('unicode_escape').decode('ascii')}" for comment in comments]
    lines += [" ".join(repr(float(number)) for number in row) for row in rows]
    return "\n".join([*lines, ""])
