"""Reading of Polycam's raw data: LiDAR depth images, and cameras with ARKit poses.

folder  --polycam_sequence-->  FrameSequence

The format is described at github.com/PolyCam/polyform. `keyframes/corrected_cameras/TIME.json` (or
`keyframes/cameras/` without optimised poses) has fx, fy, cx, cy, width and height of the colour
image, and the rows t_00 to t_23 of the transform from camera to world. `keyframes/depth/TIME.png`
has 16-bit millimetres at a lower resolution. TIME is in microseconds. The axes of the camera are
those of ARKit (x right, y up, z backward), and the y axis of the world points up.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from sceneprint.errors import DatasetError, SceneprintError
from sceneprint.formats.dataset.frame_reference import FrameReference, FrameSequence, Layout
from sceneprint.formats.exports.opengl import (
    Lens,
    depth_camera,
    depth_size,
    number,
    optical,
    pixels,
    sequence_of,
    transform,
)
from sceneprint_client.files import read_object

KEYFRAMES, CAMERAS = "keyframes", ("corrected_cameras", "cameras")
_MAXIMUM_CAMERA_BYTES = 65_536
_MOST_FRAMES = 100_000
_REMEDY = (
    "In Polycam, turn on developer mode, capture in LiDAR or Room mode, and export raw data. Photo "
    "captures have no depth."
)


def is_polycam(folder: Path, folders: list[str]) -> bool:
    """Return whether a folder with the subfolders `folders` is a Polycam export."""
    if folder.name == KEYFRAMES:
        return any(name in folders for name in CAMERAS)
    return KEYFRAMES in folders and any((folder / KEYFRAMES / name).is_dir() for name in CAMERAS)


def polycam_sequence(folder: Path, name: str) -> FrameSequence:
    """Return the frames of a Polycam export, as a sequence.

    Parameters
    ----------
    folder : folder `keyframes` or its parent

    Returns
    -------
    sequence : sequence whose `note` lists the omitted frames

    Raises
    ------
    DatasetError : If no frame has depth and a camera, or the folder cannot be read.
    """
    from sceneprint.formats.dataset.sequences import list_folder

    if folder.name == KEYFRAMES:
        name = folder.parent.name if name == KEYFRAMES else name.removesuffix(f"/{KEYFRAMES}")
        folder = folder.parent
    keyframes = folder / KEYFRAMES
    place = next(
        keyframes / folder_name for folder_name in CAMERAS if (keyframes / folder_name).is_dir()
    )
    files, left_out, frames = list_folder(place)[0], Counter[str](), list[FrameReference]()
    for file in files[:_MOST_FRAMES]:
        stem, dot, suffix = file.rpartition(".")
        if not dot or suffix.lower() != "json":
            continue
        depth = keyframes / "depth" / f"{stem}.png"
        if not depth.is_file():
            left_out["cameras without a depth image"] += 1
            continue
        try:
            frames.append(_make_frame(folder, place / file, depth, name, len(frames)))
        except SceneprintError as error:
            left_out[f"frames that are damaged ({_reason(error, place)})"] += 1
    return sequence_of(folder, Layout.POLYCAM, name, frames, left_out, _REMEDY)


def _reason(error: SceneprintError, place: Path) -> str:
    return str(error).replace(f"{place}/", "")


def _make_frame(folder: Path, file: Path, depth: Path, name: str, place: int) -> FrameReference:
    """Return a frame; raise DatasetError, InvalidIntrinsics or UnreadableFrame if it is invalid."""
    fields = read_object(file, _MAXIMUM_CAMERA_BYTES, DatasetError, '{"fx": 1, "t_00": 1, ...}')
    fx, fy, cx, cy = (number(fields.get(key), key) for key in ("fx", "fy", "cx", "cy"))
    width, height = (pixels(fields.get(key), key) for key in ("width", "height"))
    lens = Lens(fx, fy, cx, cy, width, height)
    rows = [[fields.get(f"t_{row}{column}") for column in range(4)] for row in range(3)]
    T_world_camera = optical(transform(rows, "The pose t_00 to t_23"))
    x, y, z = (float(value) for value in T_world_camera[1, :3])  # up in the axes of the camera
    return FrameReference(
        f"{name}/{file.stem}",
        depth,
        depth_camera(lens, depth_size(depth), 1000.0, up=(x, y, z)),
        int(file.stem) * 1e-6 if file.stem.isascii() and file.stem[:18].isdigit() else None,
        T_world_camera,
        original=depth.relative_to(folder).as_posix(),
        sequence=place,
    )
