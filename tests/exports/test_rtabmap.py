"""Tests of RTAB-Map databases of several schema versions, and of damaged ones."""

import io
import pickle
import sqlite3
import struct
import zlib
from contextlib import closing, suppress

import numpy as np
import pytest
from PIL import Image

from sceneprint.errors import DatasetError, SceneprintError, UnreadableCloud, UnreadableFrame
from sceneprint.formats.dataset import find_sequences
from sceneprint.formats.dataset.frame_reference import session_of
from sceneprint.formats.depth_file import encode_png
from sceneprint_client.frame_files import meta_of
from tests import bag_writer

#: A camera on a robot: 0.2 m ahead, 0.5 m up, looking forward; optical axes to the base.
LOCAL = np.array([[0.0, 0, 1, 0.2], [-1, 0, 0, 0.1], [0, -1, 0, 0.5], [0, 0, 0, 1]])
#: Columns of Node, Data and Admin by version; other versions get those of the last one.
NODE = "id INTEGER NOT NULL, map_id INTEGER NOT NULL, weight INTEGER, stamp FLOAT, pose BLOB"
DATA = "id INTEGER NOT NULL, image BLOB, depth BLOB, calibration BLOB"
SCHEMAS = {
    "0.10.6": (
        f"{NODE}, label TEXT, time_enter DATE",
        f"{DATA}, scan BLOB, scan_max_pts INTEGER, scan_max_range FLOAT, user_data BLOB",
        "version TEXT, time_enter DATE",
    ),
    "0.11.11": (
        f"{NODE}, ground_truth_pose BLOB, label TEXT, time_enter DATE",
        f"{DATA}, scan BLOB, scan_info BLOB, ground_cells BLOB, user_data BLOB, time_enter DATE",
        "version TEXT, time_enter DATE",
    ),
    "0.23.0": (
        f"{NODE}, ground_truth_pose BLOB, velocity BLOB, label TEXT, gps BLOB, env_sensors BLOB",
        f"{DATA.replace('calibration', 'depth_confidence BLOB, calibration')}, scan BLOB, "
        "scan_info BLOB, ground_cells BLOB, user_data BLOB, time_enter DATE",
        "version TEXT, preview_image BLOB, opt_cloud BLOB, opt_ids BLOB, opt_poses BLOB, "
        "opt_last_localization BLOB, opt_map BLOB, dictionary_index BLOB",
    ),
}

VERSIONS = ("0.10.6", "0.11.11", "0.16.1", "0.21.4", "0.23.0")


def transform(T):
    return T[:3].astype("<f4").tobytes()


def matrix(array, channels=1):
    code = {"int32": 4, "float32": 5}[array.dtype.name] + ((channels - 1) << 3)
    rows, columns = array.shape[0], array.shape[1] // channels
    return zlib.compress(array.tobytes()) + struct.pack("<3i", rows, columns, code)


def calibration(version, lens, *locals_):
    """As DBDriverSqlite3::saveQuery writes the cameras of a node."""
    size, number = (lens.width, lens.height), tuple(map(int, version.split(".")))
    blob = b""
    for local in locals_:
        if number >= (0, 18):
            K = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])
            P = np.column_stack((K, np.zeros(3))) if number >= (0, 23) else np.zeros(0)
            if P.size:  # of rectified images; K is of those before
                K = K * 1.1
            blob += struct.pack("<11i", *number, 0, *size, 9, 5, 0, P.size, 12)
            blob += K.tobytes() + np.zeros(5).tobytes() + P.tobytes() + transform(local)
        else:
            numbers = (lens.fx, lens.fy, lens.cx, lens.cy)
            blob += np.array(numbers, "<f4").tobytes()
            blob += b"" if number < (0, 11, 2) else np.array(size, "<f4").tobytes()
            blob += transform(local)
    return blob


def write(path, version, nodes, **admin):
    node, data, of_admin = SCHEMAS.get(version, SCHEMAS["0.23.0"])
    with closing(sqlite3.connect(path)) as database, database:
        database.execute(f"CREATE TABLE Node ({node}, PRIMARY KEY (id))")
        database.execute(f"CREATE TABLE Data ({data}, PRIMARY KEY (id))")
        database.execute("CREATE TABLE Link (from_id INTEGER, to_id INTEGER, type INTEGER)")
        database.execute(f"CREATE TABLE Admin ({of_admin})")
        for number, columns in enumerate(nodes, start=1):
            columns = {"map_id": 0, "stamp": 1.7e9 + number, "weight": 0} | columns
            of_node = {key: columns.pop(key) for key in ("map_id", "stamp", "weight", "pose")}
            for table, values in (("Node", of_node), ("Data", columns)):
                marks = ", ".join("?" * (len(values) + 1))
                database.execute(
                    f"INSERT INTO {table} (id, {', '.join(values)}) VALUES ({marks})",
                    (number, *values.values()),
                )
        values = {"version": version} | admin
        database.execute(
            f"INSERT INTO Admin ({', '.join(values)}) VALUES ({', '.join('?' * len(values))})",
            tuple(values.values()),
        )
    return path


def optimised(poses):
    ids = np.array([list(poses)], np.int32)
    rows = np.concatenate([T[:3].reshape(-1) for T in poses.values()]).astype(np.float32)
    return {"opt_ids": matrix(ids), "opt_poses": matrix(rows[None])}


def png(depth):
    return encode_png(np.rint(depth * 1000).astype(np.uint16))


def float_png(depth):
    """Metres as the four bytes of a pixel; OpenCV writes blue, green, red, alpha as R, G, B, A."""
    raw = depth.astype("<f4").view(np.uint8).reshape(*depth.shape, 4)
    file = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(raw[:, :, [2, 1, 0, 3]])).save(file, "PNG")
    return file.getvalue()


def rvl(depth):
    return b"DEPTHRVL" + bag_writer.rvl(np.rint(depth * 1000).astype(int))


def nodes_of(room, version, packed=png):
    """Nodes whose poses are of the base, so that the camera is where the room's poses are."""
    return [
        {
            "pose": transform(T @ np.linalg.inv(LOCAL)),
            "depth": packed(room.depth(T)),
            "calibration": calibration(version, room.lens, LOCAL),
        }
        for T in room.poses()
    ]


def error_of(room, reference):
    frame = reference.read()
    return room.error_of_frame(frame, frame.pose)


@pytest.mark.parametrize("packed", [png, float_png, rvl])
@pytest.mark.parametrize("version", VERSIONS)
def test_points_of_all_versions_lie_on_the_walls(room, tmp_path, version, packed):
    path = write(tmp_path / "flat.db", version, nodes_of(room, version, packed))
    [sequence] = find_sequences(path)
    assert (sequence.name, sequence.parent_frame, session_of(sequence)) == ("flat",) * 3
    assert len(sequence.frames) == 3
    for reference, T in zip(sequence.frames, room.poses(), strict=True):
        assert error_of(room, reference) < 1e-3
        assert reference.pose == pytest.approx(T, abs=1e-6)
        meta = meta_of(reference)
        assert np.array(meta.T_base_sensor.matrix) == pytest.approx(LOCAL, abs=1e-6)
        assert meta.captured_at is not None
    assert sequence.note.startswith("3 frames used, odometry poses, because the database has no")
    moved = pickle.loads(pickle.dumps(sequence.frames[0]))
    assert moved.read_bytes() == sequence.frames[0].read_bytes()


def test_optimised_poses_replace_those_of_odometry(room, tmp_path):
    nodes = nodes_of(room, "0.21.4")
    right = {i: T @ np.linalg.inv(LOCAL) for i, T in enumerate(room.poses(), start=1)}
    for node in nodes:
        node["pose"] = transform(np.eye(4))
    nodes[1]["map_id"] = 1  # another session, joined by a loop closure
    del right[3]
    right[-7] = np.eye(4)  # a landmark
    [sequence] = find_sequences(write(tmp_path / "a.db", "0.21.4", nodes, **optimised(right)))
    assert [frame.name for frame in sequence.frames] == ["a/000001", "a/000002"]
    assert all(error_of(room, frame) < 1e-3 for frame in sequence.frames)
    assert "optimised poses; skipped: 1 nodes without an optimised pose" in sequence.note


def test_sessions_that_nothing_joins_have_frames_of_their_own(room, tmp_path):
    nodes = nodes_of(room, "0.23.0")
    nodes[2]["map_id"] = 4
    sequences = find_sequences(write(tmp_path / "a.db", "0.23.0", nodes))
    assert [sequence.parent_frame for sequence in sequences] == ["a/map-0", "a/map-4"]
    assert [session_of(sequence) for sequence in sequences] == ["a/map-0", "a/map-4"]
    assert [len(sequence.frames) for sequence in sequences] == [2, 1]


@pytest.mark.parametrize("version", ["0.11.11", "0.21.4"])
@pytest.mark.parametrize("packed", [png, float_png])
def test_images_of_several_cameras_are_split(room, tmp_path, version, packed):
    other = LOCAL @ np.array([[0.0, 0, 1, 0.1], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])
    nodes = []
    for T in room.poses():
        base = T @ np.linalg.inv(LOCAL)
        images = [room.depth(T), room.depth(base @ other)]
        nodes.append(
            {
                "pose": transform(base),
                "depth": packed(np.concatenate(images, axis=1)),
                "calibration": calibration(version, room.lens, LOCAL, other),
            }
        )
    sequences = find_sequences(write(tmp_path / "a.db", version, nodes))
    assert [sequence.name for sequence in sequences] == ["a/camera-0", "a/camera-1"]
    assert {sequence.parent_frame for sequence in sequences} == {"a"}
    for sequence in sequences:
        assert all(error_of(room, frame) < 1e-3 for frame in sequence.frames)


def test_depth_may_be_smaller_than_the_image_of_the_calibration(room, tmp_path):
    large = type(room.lens)(420.0, 412.0, 154.0, 124.0, 320, 240)
    nodes = nodes_of(room, "0.21.4")
    for node in nodes:
        node["calibration"] = calibration("0.21.4", large, LOCAL)
    [sequence] = find_sequences(write(tmp_path / "a.db", "0.21.4", nodes))
    assert all(error_of(room, frame) < 1e-3 for frame in sequence.frames)


@pytest.mark.parametrize("version", ["0.11.11", "0.16.1", "0.21.4"])
def test_laser_scans_are_taken_where_there_is_no_depth(room, tmp_path, version):
    mounting = np.array([[0.0, -1, 0, 0.3], [1, 0, 0, 0], [0, 0, 1, 0.9], [0, 0, 0, 1]])
    channels, form = (4, 6) if version != "0.11.11" else (3, 0)
    head = {"0.11.11": (0, 30), "0.16.1": (0, 30, form), "0.21.4": (form, 0.5, 30, 0, 0, 0, 0)}
    nodes = []
    for T in room.poses():
        rows = np.ones((2000, channels), np.float32)
        rows[:, :3] = room.points(T)
        nodes.append(
            {
                "pose": transform(T @ np.linalg.inv(mounting)),
                "scan": matrix(rows.reshape(1, -1), channels),
                "scan_info": np.array(head[version], "<f4").tobytes() + transform(mounting),
            }
        )
    [sequence] = find_sequences(write(tmp_path / "a.db", version, nodes))
    for reference, T in zip(sequence.frames, room.poses(), strict=True):
        cloud = reference.read()
        assert cloud.has_viewpoint
        assert cloud.pose == pytest.approx(T, abs=1e-6)
        world = cloud.points.astype(float) @ cloud.pose[:3, :3].T + cloud.pose[:3, 3]
        assert room.error(world) < 1e-3


def test_what_is_damaged_costs_only_its_node(room, tmp_path):
    nodes = nodes_of(room, "0.21.4")
    nodes += nodes_of(room, "0.21.4")
    nodes[1]["calibration"] = nodes[1]["calibration"][:-5]
    nodes[2]["pose"] = b"short"
    nodes[3]["pose"] = bytes(48)
    nodes[4]["calibration"] = None
    nodes[5]["depth"] = nodes[5]["depth"][:200]
    [sequence] = find_sequences(write(tmp_path / "a.db", "0.21.4", nodes))
    assert [frame.sequence for frame in sequence.frames] == [1, 6]
    for output in (
        "1 damaged nodes (a calibration has",
        "1 nodes without a pose",
        "without a calib",
    ):
        assert output in sequence.note
    assert error_of(room, sequence.frames[0]) < 1e-3
    with pytest.raises(UnreadableFrame, match="is truncated"):
        sequence.frames[1].read()


def test_old_incomplete_and_foreign_databases_are_refused(room, tmp_path):
    old = write(tmp_path / "old.db", "0.8.11", nodes_of(room, "0.23.0"))
    with pytest.raises(DatasetError, match=r"RTAB-Map 0\.8\.11.*rtabmap-reprocess old\.db"):
        find_sequences(old)
    newer = write(tmp_path / "newer.db", "0.31.0", nodes_of(room, "0.23.0"))
    assert len(find_sequences(newer)[0].frames) == 3  # the tables are what counts
    with closing(sqlite3.connect(newer)) as database, database:
        database.execute("ALTER TABLE Data RENAME COLUMN calibration TO intrinsics")
    with pytest.raises(DatasetError, match=r"newer than 0.23.*lacks calibration.*--as-map"):
        find_sequences(newer)
    foreign = tmp_path / "foreign.db"
    with closing(sqlite3.connect(foreign)) as database, database:
        database.execute("CREATE TABLE history (url TEXT)")
    with pytest.raises(DatasetError, match="no tables Node and Link"):
        find_sequences(foreign)


def test_a_database_in_use_is_refused(room, tmp_path):
    path = write(tmp_path / "a.db", "0.21.4", nodes_of(room, "0.21.4"))
    (tmp_path / "a.db-journal").write_bytes(b"half")
    with pytest.raises(DatasetError, match=r"unfinished journal a\.db-journal.*Close RTAB-Map"):
        find_sequences(path)


def test_views_in_the_place_of_tables_are_not_run(room, tmp_path):
    path = write(tmp_path / "a.db", "0.21.4", nodes_of(room, "0.21.4"))
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("ALTER TABLE Node RENAME TO Real")
        database.execute(
            "CREATE VIEW Node AS WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n) "
            "SELECT id, 0 AS map_id, 0 AS stamp, NULL AS pose FROM n"
        )
    with pytest.raises(DatasetError, match="no tables Node and Link"):
        find_sequences(path)


def test_random_damage_is_refused_by_an_error_of_ours(room, tmp_path):
    rng = np.random.default_rng(11)
    for version, packed in (("0.11.11", png), ("0.21.4", rvl), ("0.23.0", float_png)):
        path = write(tmp_path / f"{version}.db", version, nodes_of(room, version, packed))
        good = path.read_bytes()
        for _ in range(60):
            broken = bytearray(good)
            for at in rng.integers(0, len(good), rng.integers(1, 20)):
                broken[at] = rng.integers(0, 256)
            path.write_bytes(broken if rng.random() < 0.9 else broken[: rng.integers(1, len(good))])
            with suppress(SceneprintError):
                for reference in find_sequences(path)[0].frames:
                    with suppress(SceneprintError):
                        reference.read()


def test_matrices_that_announce_too_much_are_refused(room, tmp_path):
    bomb = zlib.compress(bytes(1000)) + struct.pack("<3i", 2**15, 2**15, 5 + (2 << 3))
    [sequence] = find_sequences(
        write(tmp_path / "a.db", "0.10.6", [{"pose": transform(np.eye(4)), "scan": bomb}])
    )
    with pytest.raises(UnreadableCloud, match="a matrix declares 12884901888 bytes"):
        sequence.frames[0].read()
