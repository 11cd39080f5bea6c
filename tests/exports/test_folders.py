"""Tests of Polycam, Record3D, nerfstudio and E57 files, written by their descriptions."""

import io
import json
import shutil
import zipfile

import numpy as np
import pytest

from sceneprint.errors import DatasetError, UnreadableArchive, UnreadableFrame
from sceneprint.formats.archive import open_archive
from sceneprint.formats.dataset import Layout, find_sequences
from sceneprint.formats.depth_file import decode_frame, encode_png
from sceneprint_client.frame_files import meta_of, sendable
from sceneprint_client.poses import quaternion_of

#: From optical axes to those of OpenGL and ARKit: y up, z backward.
FLIP = np.diag([1.0, -1, -1, 1])
#: From the room's world, z up, to ARKit's, y up: (x, y, z) is (x, z, -y) there.
Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
SCALE = 4  #: how much larger the colour images are


def png(depth, units=1000):
    return encode_png(np.rint(depth * units).astype(np.uint16))


def npy(depth):
    file = io.BytesIO()
    np.save(file, depth.astype(np.float32))
    return file.getvalue()


def of_colour(lens):
    """The camera of the colour image; its principal point is measured from the corner."""
    return {
        "fx": lens.fx * SCALE, "fy": lens.fy * SCALE,
        "cx": (lens.cx + 0.5) * SCALE, "cy": (lens.cy + 0.5) * SCALE,
    }  # fmt: skip


def polycam(folder, room, cameras="corrected_cameras"):
    """As github.com/PolyCam/polyform describes raw data."""
    keyframes = folder / "keyframes"
    for name in (cameras, "depth", "confidence"):
        (keyframes / name).mkdir(parents=True)
    (folder / "mesh_info.json").write_text("{}")
    for i, T in enumerate(room.poses()):
        stem, pose = f"{123_456_789 + 500_000 * i}", Y_UP @ T @ FLIP
        fields = of_colour(room.lens) | {
            f"t_{r}{c}": pose[r, c] for r in range(3) for c in range(4)
        }
        fields |= {"width": room.lens.width * SCALE, "height": room.lens.height * SCALE}
        (keyframes / cameras / f"{stem}.json").write_text(json.dumps(fields))
        (keyframes / "depth" / f"{stem}.png").write_bytes(png(room.depth(T)))
        (keyframes / "confidence" / f"{stem}.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    return folder


def nerfstudio(folder, room, suffix="png", *, per_frame=False, **more):
    """As docs.nerf.studio describes transforms.json; depth in millimetres unless stated."""
    (folder / "depth").mkdir(parents=True)
    units = 1 / float(more.get("depth_unit_scale_factor", 1e-3))
    camera = {
        {"fx": "fl_x", "fy": "fl_y"}.get(key, key): value
        for key, value in of_colour(room.lens).items()
    } | {"w": room.lens.width * SCALE, "h": room.lens.height * SCALE}
    applied = np.eye(4)
    applied[:3] = more.get("applied_transform", np.eye(4)[:3])
    frames = []
    for i, T in enumerate(room.poses()):
        depth, file = room.depth(T), f"depth/frame_{i:05d}.{suffix}"
        (folder / file).write_bytes(png(depth, units) if suffix == "png" else npy(depth * units))
        frame = {
            "file_path": f"images/frame_{i:05d}.jpg",
            "depth_file_path": f"./{file}",
            "transform_matrix": (applied @ T @ FLIP).tolist(),
        }
        frames.append(frame | (camera if per_frame else {}))
    fields = more | ({} if per_frame else camera) | {"frames": frames, "camera_model": "OPENCV"}
    (folder / "transforms.json").write_text(json.dumps(fields))
    return folder


def record3d(folder, room, **more):
    """As Record3D stores a capture, unpacked; K is written column by column."""
    lzfse = pytest.importorskip("lzfse", reason="lzfse is not installed")
    (folder / "rgbd").mkdir(parents=True)
    camera, poses = of_colour(room.lens), []
    for i, T in enumerate(room.poses()):
        pose = Y_UP @ T @ FLIP
        poses.append([*quaternion_of(pose[:3, :3]).tolist(), *pose[:3, 3].tolist()])
        depth = room.depth(T).astype("<f4")
        (folder / "rgbd" / f"{i}.depth").write_bytes(lzfse.compress(depth.tobytes()))
    fx, fy, cx, cy = camera.values()
    fields = {
        "w": room.lens.width * SCALE, "h": room.lens.height * SCALE,
        "dw": room.lens.width, "dh": room.lens.height,
        "K": [fx, 0, 0, 0, fy, 0, cx, cy, 1], "fps": 60, "poses": poses,
    } | more  # fmt: skip
    (folder / "metadata").write_text(json.dumps(fields))
    return folder


def packed(folder, archive, *, top=""):
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as file:
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                file.write(path, f"{top}{path.relative_to(folder).as_posix()}")
    return archive


def errors(room, sequence, T_room_world):
    return [
        room.error_of_frame(reference.read(), T_room_world @ reference.pose)
        for reference in sequence.frames
    ]


@pytest.mark.parametrize("cameras", ["cameras", "corrected_cameras"])
def test_polycam(room, tmp_path, cameras):
    folder = polycam(tmp_path / "flat", room, cameras)
    [sequence] = find_sequences(folder)
    assert (sequence.layout, sequence.name, sequence.parent_frame) == (
        Layout.POLYCAM, "flat", "flat",
    )  # fmt: skip
    assert max(errors(room, sequence, np.linalg.inv(Y_UP))) < 1e-3
    for reference, T in zip(sequence.frames, room.poses(), strict=True):
        assert reference.pose == pytest.approx(Y_UP @ T, abs=1e-9)
        up = meta_of(reference).up
        assert up.unit == pytest.approx(T[2, :3], abs=1e-9)  # the room's z, as the camera sees it


def test_polycam_prefers_optimised_poses_and_says_what_is_left_out(room, tmp_path):
    folder = polycam(tmp_path / "flat", room)
    shutil.copytree(folder / "keyframes/corrected_cameras", folder / "keyframes/cameras")
    depths = sorted((folder / "keyframes/depth").iterdir())
    depths[0].unlink()
    (folder / "keyframes/corrected_cameras" / f"{depths[1].stem}.json").write_text('{"fx": true}')
    [sequence] = find_sequences(folder)
    assert len(sequence.frames) == 1
    assert "1 cameras without a depth image" in sequence.note
    assert "1 frames that are damaged (fx is True, not a finite number" in sequence.note
    shutil.rmtree(folder / "keyframes/depth")
    with pytest.raises(DatasetError, match=r"has depth.*turn on developer mode"):
        find_sequences(folder)


@pytest.mark.parametrize(
    ("suffix", "more"),
    [
        ("png", {}), ("npy", {"per_frame": True}), ("png", {"depth_unit_scale_factor": 2e-4}),
        ("npy", {"depth_unit_scale_factor": 1.0}), ("npy", {"depth_unit_scale_factor": 0.01}),
    ],
)  # fmt: skip
def test_nerfstudio(room, tmp_path, suffix, more):
    [sequence] = find_sequences(nerfstudio(tmp_path / "a", room, suffix, **more))
    assert sequence.layout is Layout.NERFSTUDIO
    assert max(errors(room, sequence, np.eye(4))) < 1e-3
    assert sequence.frames[0].original == f"depth/frame_00000.{suffix}"


def test_the_applied_transform_of_nerfstudio_is_undone(room, tmp_path):
    applied = [[0, 1, 0, 0.5], [0, 0, 1, 0], [1, 0, 0, -2]]
    [sequence] = find_sequences(nerfstudio(tmp_path / "a", room, applied_transform=applied))
    assert max(errors(room, sequence, np.eye(4))) < 1e-3
    scaled = nerfstudio(tmp_path / "b", room, applied_scale=0.5)
    fields = json.loads((scaled / "transforms.json").read_text())
    for frame in fields["frames"]:
        for row in frame["transform_matrix"][:3]:
            row[3] *= 0.5
    (scaled / "transforms.json").write_text(json.dumps(fields))
    [sequence] = find_sequences(scaled)
    assert max(errors(room, sequence, np.eye(4))) < 1e-3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frames": 3}, "no list of frames"),
        (
            {"frames": [{"file_path": "images/1.jpg"}]},
            "1 frames without a depth_file_path.*--use-d",
        ),
        ({"camera_model": "OPENCV_FISHEYE"}, "undistort the images"),
        ({"w": 100}, "has the aspect ratio"),
        ({"fl_x": "wide"}, "fl_x is 'wide'"),
        ({"applied_transform": [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0]]}, "applied_transform is"),
        ({"applied_scale": 0}, "applied_scale is 0"),
    ],
)
def test_broken_transforms_are_refused(room, tmp_path, change, message):
    file = nerfstudio(tmp_path / "a", room) / "transforms.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | change))
    with pytest.raises(DatasetError, match=message):
        find_sequences(tmp_path)


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("/etc/passwd", "outside the folder"), ("../../b.png", "outside the folder"),
        ("depth/none.png", "is missing"), ("depth/a.exr", r"depth format \.exr"),
    ],
)  # fmt: skip
def test_depth_files_elsewhere_are_not_read(room, tmp_path, path, message):
    file = nerfstudio(tmp_path / "a", room) / "transforms.json"
    fields = json.loads(file.read_text())
    fields["frames"][0]["depth_file_path"] = path
    file.write_text(json.dumps(fields))
    [sequence] = find_sequences(tmp_path / "a")
    assert len(sequence.frames) == 2
    fields["frames"] = fields["frames"][:1]
    file.write_text(json.dumps(fields))
    with pytest.raises(DatasetError, match=message):
        find_sequences(tmp_path / "a")


@pytest.mark.parametrize("as_file", [False, True])
def test_record3d(room, tmp_path, as_file):
    path = record3d(tmp_path / "flat", room, frameTimestamps=[1.7e9, 1.7e9 + 1, 1.7e9 + 2])
    if as_file:
        path = packed(path, tmp_path / "flat.r3d")
    [sequence] = find_sequences(path)
    assert (sequence.layout, sequence.name) == (Layout.RECORD3D, "flat")
    assert max(errors(room, sequence, np.linalg.inv(Y_UP))) < 1e-5  # depth is float32
    assert meta_of(sequence.frames[0]).captured_at is not None


def test_record3d_with_a_camera_for_each_frame(room, tmp_path):
    coefficients = [list(of_colour(room.lens).values())] * 3
    folder = record3d(tmp_path / "a", room, perFrameIntrinsicCoeffs=coefficients, K=None)
    [sequence] = find_sequences(folder)
    assert max(errors(room, sequence, np.linalg.inv(Y_UP))) < 1e-5


def test_broken_captures_of_record3d_are_refused(room, tmp_path):
    for change, message in (
        ({"poses": None}, "there is no list of poses.*export the capture as .r3d"),
        ({"poses": [[0, 0, 0, 0, 1, 2, 3]] * 3}, "does not have unit length"),
        ({"K": [1, 2]}, "K and perFrameIntrinsicCoeffs are missing"),
        ({"dw": 10**9}, "1000000000 x 60 pixels are too large|not a size"),
    ):
        folder = record3d(tmp_path / "a", room, **change)
        with pytest.raises(DatasetError, match=message):
            find_sequences(folder)
        shutil.rmtree(folder)
    folder = record3d(tmp_path / "a", room)
    depth = folder / "rgbd/1.depth"
    depth.write_bytes(depth.read_bytes()[:-40])
    (folder / "rgbd/2.depth").write_bytes(bytes(77))
    [sequence] = find_sequences(folder)
    for place in (1, 2):
        with pytest.raises(UnreadableFrame, match=r"(Copy|Export) the capture again"):
            sequence.frames[place].read()
    file = packed(folder, tmp_path / "cut.r3d")
    file.write_bytes(file.read_bytes()[:-30])
    with pytest.raises(DatasetError, match=r"cannot be read.*\.r3d"):
        find_sequences(file)


@pytest.mark.parametrize("top", ["", "capture/"])
@pytest.mark.parametrize(
    ("write", "T_room_world"), [(polycam, np.linalg.inv(Y_UP)), (nerfstudio, np.eye(4))]
)
def test_zips_of_folders(room, tmp_path, write, T_room_world, top):
    file = packed(write(tmp_path / "a", room), tmp_path / "a.zip", top=top)
    with file.open("rb") as opened, open_archive(opened, tmp_path, "sent") as archive:
        assert archive.refused == []
        [sequence] = archive.sequences
        assert sequence.name == ("capture" if top else "sent")
        assert len(sequence.frames) == 3
        for reference in sequence.frames:
            frame = decode_frame(
                archive.data_of(reference),
                reference.camera.intrinsics,
                depth_scale=reference.camera.depth_scale,
            )
            assert room.error_of_frame(frame, T_room_world @ reference.pose) < 1e-3


def test_a_capture_of_record3d_is_not_inflated_by_a_service(room, tmp_path):
    file = packed(record3d(tmp_path / "a", room), tmp_path / "a.r3d")
    with (
        file.open("rb") as opened,
        pytest.raises(UnreadableArchive, match=r"sceneprint upload MAP FILE\.r3d"),
        open_archive(opened, tmp_path),
    ):
        pass


def e57(path, room, **more):
    pye57 = pytest.importorskip("pye57", reason="pye57 is not installed")
    with pye57.E57(str(path), "w") as file:
        for i, T in enumerate(room.poses()):
            points = room.points(T)
            x, y, z, w = quaternion_of(T[:3, :3])
            file.write_scan_raw(
                {f"cartesian{axis}": points[:, k].copy() for k, axis in enumerate("XYZ")},
                name=f"Setup {i}",
                **({"rotation": np.array([w, x, y, z]), "translation": T[:3, 3]} | more),
            )
    return path


def test_scans_of_an_e57_file_are_frames(room, tmp_path):
    path = e57(tmp_path / "hall.e57", room)
    [sequence] = find_sequences(path)
    assert (sequence.layout, sequence.name, sequence.note) == (
        Layout.E57, "hall", "3 of 3 scans used",
    )  # fmt: skip
    for reference, T in zip(sequence.frames, room.poses(), strict=True):
        cloud = reference.read()
        assert cloud.has_viewpoint
        assert cloud.pose == pytest.approx(T, abs=1e-12)
        world = cloud.points.astype(float) @ T[:3, :3].T + T[:3, 3]
        assert room.error(world) < 1e-3
    assert [frame.original for frame in sequence.frames] == ["Setup 0", "Setup 1", "Setup 2"]
    [same] = find_sequences(tmp_path)
    assert same.name == "hall"
    with pytest.raises(DatasetError, match="may hold several frames"):
        sendable(path, None, with_pose=False)


def test_a_merged_e57_is_refused_with_the_remedy(room, tmp_path):
    still = {"rotation": np.array([1.0, 0, 0, 0]), "translation": np.zeros(3)}
    path = e57(tmp_path / "merged.e57", room, **still)
    with pytest.raises(DatasetError, match=r"3 clouds without a viewpoint.*--as-map"):
        find_sequences(path)
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(DatasetError, match=r"merged\.e57: The header.*Copy the file again"):
        find_sequences(path)
