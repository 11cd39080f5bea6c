"""A sound file of every kind that is read: what mutations break.

Shot  --FILES[kind]-->  bytes
"""

from __future__ import annotations

import gzip
import io
import json
import struct
import tarfile
import tempfile
import zipfile
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from benchmarks.soak.load import Shot
from sceneprint.types import Floats32

Pack = Literal["", "gz", "bz2", "xz"]

#: Points of a cloud: few, so that bytes of headers are met often.
_POINTS = 200


def _points() -> Floats32:
    """(200, 3) metres, two walls and noise; the same ones each time."""
    rng = np.random.default_rng(0)
    found = rng.uniform(-3, 3, (_POINTS, 3))
    found[: _POINTS // 2, 0], found[_POINTS // 2 :, 1] = 3.0, -3.0
    return found.astype(np.float32)


# Depth images.


def _npy_of(array: NDArray[Any]) -> bytes:
    out = io.BytesIO()
    np.save(out, array)
    return out.getvalue()


def _npy(shot: Shot) -> bytes:
    k = shot.meta.intrinsics
    assert k is not None  # these are depth images
    return _npy_of(np.linspace(1, 3, k.width * k.height, dtype=np.float32).reshape(k.height, -1))


def _compressed_depth(shot: Shot) -> bytes:
    """The data of a CompressedImage of ROS: a header of 12 bytes before the PNG."""
    return struct.pack("<iff", 0, 0.0, 0.0) + shot.png


# Clouds.


def _ply(_shot: Shot, form: str) -> bytes:
    head = (
        f"ply\nformat {form} 1.0\nelement camera 1\nproperty list uchar short marks\n"
        f"element vertex {_POINTS}\nproperty uchar red\nproperty float x\nproperty double z\n"
        "property float y\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    ).encode()
    if form == "ascii":
        rows = "".join(f"7 {x:.9g} {z:.9g} {y:.9g}\n" for x, y, z in _points())
        return head + f"2 5 -6\n{rows}3 0 1 2\n".encode()
    order = "<" if "little" in form else ">"
    body = struct.pack(f"{order}Bhh", 2, 5, -6)
    body += b"".join(struct.pack(f"{order}Bfdf", 7, x, z, y) for x, y, z in _points())
    return head + body + struct.pack(f"{order}Biii", 3, 0, 1, 2)


def _pcd(_shot: Shot, form: str) -> bytes:
    head = (
        "VERSION 0.7\nFIELDS x y z ring\nSIZE 4 4 4 2\nTYPE F F F U\nCOUNT 1 1 1 1\n"
        f"WIDTH {_POINTS}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {_POINTS}\nDATA {form}\n"
    ).encode()
    if form == "ascii":
        return head + "".join(f"{x:.9g} {y:.9g} {z:.9g} 5\n" for x, y, z in _points()).encode()
    if form == "binary":
        return head + b"".join(struct.pack("<fffH", x, y, z, 5) for x, y, z in _points())
    fields = _points().T.tobytes() + np.full(_POINTS, 5, "<u2").tobytes()
    # bytes as they are, 32 at most at a time; the rings, which are equal, as a repetition
    plain, packed = fields[: -2 * _POINTS + 2], b""
    for i in range(0, len(plain), 32):
        packed += bytes([len(plain[i : i + 32]) - 1]) + plain[i : i + 32]
    left = 2 * _POINTS - 2
    while left:
        n = min(left, 264) if left - min(left, 264) not in (1, 2) else left - 3
        packed += bytes([7 << 5, n - 9, 1]) if n >= 9 else bytes([(n - 2) << 5, 1])
        left -= n
    return head + struct.pack("<II", len(packed), len(fields)) + packed


def _kitti(_shot: Shot) -> bytes:
    return np.column_stack([_points(), np.ones(_POINTS, np.float32)]).tobytes()


def _npy_cloud(_shot: Shot) -> bytes:
    return _npy_of(_points())


@cache
def _las_of(*, packed: bool) -> bytes:
    import laspy

    header = laspy.LasHeader(point_format=6 if packed else 1, version="1.4" if packed else "1.2")
    header.scales = [0.001] * 3
    record = laspy.LasData(header)
    record.x, record.y, record.z = _points().T
    out = io.BytesIO()
    record.write(out, do_compress=packed)
    return out.getvalue()


# Messages and bags of ROS.


def _message(types: Any, name: str, /, **fields: Any) -> Any:
    return types.types[name](**fields)


def _header(types: Any) -> Any:
    stamp = _message(types, "builtin_interfaces/msg/Time", sec=1_700_000_000, nanosec=0)
    seq = {"seq": 0} if "seq" in types.types["std_msgs/msg/Header"].__annotations__ else {}
    return _message(types, "std_msgs/msg/Header", stamp=stamp, frame_id="lidar", **seq)


def _cloud_message(types: Any) -> Any:
    fields = [
        _message(types, "sensor_msgs/msg/PointField", name=name, offset=4 * i, datatype=7, count=1)
        for i, name in enumerate("xyz")
    ]
    return _message(
        types, "sensor_msgs/msg/PointCloud2", header=_header(types), height=1, width=_POINTS,
        fields=fields, is_bigendian=False, point_step=12, row_step=12 * _POINTS,
        data=_points().view(np.uint8).ravel(), is_dense=True,
    )  # fmt: skip


def _image_message(types: Any) -> Any:
    samples = np.linspace(500, 3000, 48).astype("<u2").reshape(6, 8)
    return _message(
        types, "sensor_msgs/msg/Image", header=_header(types), height=6, width=8,
        encoding="16UC1", is_bigendian=0, step=16, data=samples.view(np.uint8).ravel(),
    )  # fmt: skip


def _camera_message(types: Any) -> Any:
    roi = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
    numbers = {
        "d": np.zeros(0), "k": np.array([7.0, 0, 3.5, 0, 7, 2.5, 0, 0, 1]),
        "r": np.eye(3).ravel(), "p": np.array([7.0, 0, 3.5, 0, 0, 7, 2.5, 0, 0, 0, 1, 0]),
    }  # fmt: skip
    if "K" in types.types["sensor_msgs/msg/CameraInfo"].__annotations__:  # ROS 1
        numbers = {name.upper(): values for name, values in numbers.items()}
    return _message(
        types, "sensor_msgs/msg/CameraInfo", header=_header(types), height=6, width=8,
        distortion_model="plumb_bob", binning_x=0, binning_y=0,
        roi=_message(types, "sensor_msgs/msg/RegionOfInterest", **roi), **numbers,
    )  # fmt: skip


@cache
def _pointcloud2() -> bytes:
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.ROS2_HUMBLE)
    data = types.serialize_cdr(_cloud_message(types), "sensor_msgs/msg/PointCloud2")
    return bytes(data)


@cache
def bag(kind: str) -> bytes:
    """A recording with four clouds, four depth images and their camera.

    Parameters
    ----------
    kind : mcap, db3 or bag, which is also the end of its file's name; `.zst` or `.bz2` after it
        where it is compressed
    """
    from rosbags import rosbag1
    from rosbags.typesys import Stores, get_typestore

    container, _, packed = kind.partition(".")
    ros1 = container == "bag"
    types = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    made = (
        ("/points", _cloud_message(types)), ("/depth/image_raw", _image_message(types)),
        ("/depth/camera_info", _camera_message(types)),
    )  # fmt: skip
    serialize = types.serialize_ros1 if ros1 else types.serialize_cdr
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / ("run.bag" if ros1 else f"run/run.{container}")
        writer: Any = rosbag1.Writer(path) if ros1 else _ros2_writer(path, packed)
        if ros1 and packed:
            writer.set_compression(writer.CompressionFormat.BZ2)
        with writer:
            for topic, message in made:
                name = message.__msgtype__
                connection = writer.add_connection(topic, name, typestore=types)
                for i in range(4):
                    at = (1_700_000_000 + i) * 10**9
                    writer.write(connection, at, serialize(message, name))
        return path.read_bytes()


def _ros2_writer(path: Path, packed: str) -> Any:
    from rosbags import rosbag2

    plugin = rosbag2.StoragePlugin
    kind = plugin.MCAP if path.suffix == ".mcap" else plugin.SQLITE3
    writer = rosbag2.Writer(path.parent, version=9, storage_plugin=kind)
    if packed:
        writer.set_compression(rosbag2.CompressionMode.STORAGE, rosbag2.CompressionFormat.ZSTD)
    return writer


# Archives.


def _zip(shot: Shot) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in _members(shot):
            # a time of its own would make other bytes every two seconds
            archive.writestr(zipfile.ZipInfo(name), data, zipfile.ZIP_DEFLATED)
    return out.getvalue()


def _tar(shot: Shot, pack: Pack) -> bytes:
    out = io.BytesIO()
    mode: Any = f"w:{pack}" if pack != "gz" else "w"
    with tarfile.open(fileobj=out, mode=mode) as archive:
        for name, data in _members(shot):
            member = tarfile.TarInfo(name)
            member.size = len(data)
            archive.addfile(member, io.BytesIO(data))
    # tarfile would write the present time into the header of gzip
    return gzip.compress(out.getvalue(), mtime=0) if pack == "gz" else out.getvalue()


def _members(shot: Shot) -> list[tuple[str, bytes]]:
    k = shot.meta.intrinsics
    camera = {name: getattr(k, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    return [
        ("room/seq-01/intrinsics.json", json.dumps(camera).encode()),
        ("room/seq-01/frame-000000.depth.png", shot.png),
        ("room/seq-01/frame-000001.depth.png", shot.png[:-30]),
        ("room/seq-02/000000.pcd", _pcd(shot, "binary_compressed")),
    ]


#: By kind: what makes a file of it.
IMAGES: dict[str, Callable[[Shot], bytes]] = {
    "png": lambda shot: shot.png, "npy": _npy, "compressedDepth": _compressed_depth,
}  # fmt: skip
CLOUDS: dict[str, Callable[[Shot], bytes]] = {
    "ply": partial(_ply, form="binary_little_endian"),
    "ply big": partial(_ply, form="binary_big_endian"),
    "ply text": partial(_ply, form="ascii"),
    "pcd": partial(_pcd, form="binary"),
    "pcd text": partial(_pcd, form="ascii"),
    "pcd packed": partial(_pcd, form="binary_compressed"),
    "kitti": _kitti, "npy cloud": _npy_cloud,
    "las": lambda _: _las_of(packed=False), "laz": lambda _: _las_of(packed=True),
    "PointCloud2": lambda _: _pointcloud2(),
}  # fmt: skip
ARCHIVES: dict[str, Callable[[Shot], bytes]] = {
    "zip": _zip, "tar": partial(_tar, pack=""), "tar.gz": partial(_tar, pack="gz"),
    "tar.bz2": partial(_tar, pack="bz2"), "tar.xz": partial(_tar, pack="xz"),
}  # fmt: skip
BAGS: dict[str, Callable[[Shot], bytes]] = {
    one: lambda _, one=one: bag(one)  # type: ignore[misc]
    for one in ("mcap", "mcap.zst", "db3", "bag", "bag.bz2")
}
FILES = IMAGES | CLOUDS | ARCHIVES | BAGS
