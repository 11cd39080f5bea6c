"""Builders of ROS messages, and of bags in every container, with a camera mounted on a base."""

import io
import struct
from contextlib import contextmanager
from typing import Any

import numpy as np
from PIL import Image
from rosbags.interfaces import Nodetype
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from sceneprint_client.poses import quaternion_of, rotation_of

#: Offset of all stamps, seconds: a date, so that frames get `captured_at`.
START = 1_700_000_000
CONTAINERS = ("mcap", "sqlite3", "ros1")
K = (70.0, 71.0, 39.5, 29.5)
WIDTH, HEIGHT = 80, 60


def transform(x, y, z, *quaternion):
    T = np.eye(4)
    q = np.array(quaternion or (0, 0, 0, 1), float)
    T[:3, :3], T[:3, 3] = rotation_of(q / np.linalg.norm(q)), (x, y, z)
    return T


#: Packages and definitions of the messages of Livox.
LIVOX = ("livox_ros_driver", "livox_ros_driver2")
LIVOX_POINT = (
    "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line"
)
LIVOX_SCAN = (
    "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n"
    "CustomPoint[] points"
)
#: Pose of a camera that looks ahead and slightly down, in front of the base and above it.
T_BASE_CAMERA = transform(0.21, -0.05, 0.93, -0.53, 0.49, -0.47, 0.51)


def zero(types, name):
    plain_values = {"string": "", "bool": False, "float64": 0.0, "float32": 0.0}
    values = {}
    for key, (kind, declaration) in types.fielddefs[name][1]:
        if kind == Nodetype.NAME:
            values[key] = zero(types, declaration)
        elif kind == Nodetype.BASE:
            values[key] = plain_values.get(declaration[0], 0)
        elif kind == Nodetype.ARRAY:
            values[key] = np.zeros(declaration[1])
        else:
            values[key] = []
    return types.types[name](**values)


def rvl(samples):
    """Return RVL as its paper writes it: number by number, nibble by nibble."""
    nibbles, at, last = [], 0, 0

    def put(number):
        while True:
            more = number > 7
            nibbles.append(number & 7 | 8 * more)
            number >>= 3
            if not more:
                return

    values = [int(v) for v in samples.ravel()]
    while at < len(values):
        for is_run in (lambda v: v == 0, lambda v: v != 0):
            end = at
            while end < len(values) and is_run(values[end]):
                end += 1
            put(end - at)
            for value in values[at:end] if values[at:end] and values[at] else ():
                delta = value - last
                put(2 * delta if delta >= 0 else -2 * delta - 1)
                last = value
            at = end
    nibbles += [0] * (-len(nibbles) % 8)
    height, width = samples.shape
    words = [
        sum(nibble << (28 - 4 * place) for place, nibble in enumerate(nibbles[i : i + 8]))
        for i in range(0, len(nibbles), 8)
    ]
    return struct.pack(f"<II{len(words)}I", width, height, *words)


class BagWriter:
    """Writer of ROS 1 or ROS 2 messages with rosbags."""

    def __init__(self, writer, *, ros1):
        self.ros1, self.writer = ros1, writer
        self.types = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        if ros1:  # rosbags supports it only for ROS 2
            of_tf = "geometry_msgs/TransformStamped[] transforms"
            self.types.register(get_types_from_msg(of_tf, "tf2_msgs/msg/TFMessage"))
        for package in LIVOX:
            self.types.register(get_types_from_msg(LIVOX_POINT, f"{package}/msg/CustomPoint"))
            self.types.register(get_types_from_msg(LIVOX_SCAN, f"{package}/msg/CustomMsg"))
        self.connections: dict[str, Any] = {}
        self.late = 0.0  #: seconds from the stamp of a message to its recording

    def make(self, name, /, **fields):
        """Return a message with zeros in all other fields."""
        if self.ros1 and name == "sensor_msgs/msg/CameraInfo":
            fields = {k.upper() if k in "dkrp" else k: v for k, v in fields.items()}
        message = zero(self.types, name)
        for key, value in fields.items():
            assert hasattr(message, key), key
            setattr(message, key, value)
        return message

    def header(self, t, frame):
        seconds, ns = divmod(round(t * 1e9), 10**9)
        stamp = self.make("builtin_interfaces/msg/Time", sec=START + seconds, nanosec=ns)
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def vector(self, values, name="geometry_msgs/msg/Vector3"):
        return self.make(name, **dict(zip("xyzw", map(float, values), strict=False)))

    def quaternion(self, T, length=1.0):
        return self.vector(quaternion_of(T[:3, :3]) * length, "geometry_msgs/msg/Quaternion")

    def write(self, topic, name, t, message):
        self.raw(topic, name, t, self.serialized(name, message))

    def serialized(self, name, message):
        if self.ros1:
            return bytes(self.types.serialize_ros1(message, name))
        return bytes(self.types.serialize_cdr(message, name))

    def raw(self, topic, name, t, data):
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, name, typestore=self.types)
        self.writer.write(
            self.connections[topic], START * 10**9 + round((t + self.late) * 1e9), data
        )

    # Messages that robots record.

    def transforms(self, t, edges, topic="/tf", *, length=1.0):
        """Write transforms with quaternions of a given length."""
        transforms = []
        for (parent, child), T in edges.items():
            one = self.make(
                "geometry_msgs/msg/TransformStamped",
                header=self.header(t, parent), child_frame_id=child,
            )  # fmt: skip
            one.transform.translation = self.vector(T[:3, 3])
            one.transform.rotation = self.quaternion(T, length)
            transforms.append(one)
        message = self.make("tf2_msgs/msg/TFMessage", transforms=transforms)
        self.write(topic, "tf2_msgs/msg/TFMessage", t, message)

    def odometry(self, t, T, topic="/odom", child="base_link"):
        name, header = "nav_msgs/msg/Odometry", self.header(t, "odom")
        message = self.make(name, header=header, child_frame_id=child)
        message.pose.pose.position = self.vector(T[:3, 3], "geometry_msgs/msg/Point")
        message.pose.pose.orientation = self.quaternion(T)
        self.write(topic, name, t, message)

    def imu(self, t, acceleration, turn=(0, 0, 0), frame="imu"):
        message = self.make(
            "sensor_msgs/msg/Imu",
            header=self.header(t, frame), orientation=self.quaternion(np.eye(4)),
            angular_velocity=self.vector(turn), linear_acceleration=self.vector(acceleration),
        )  # fmt: skip
        self.write("/imu", "sensor_msgs/msg/Imu", t, message)

    def camera_info(
        self, t, topic="/camera/depth/camera_info", *, frame="camera", k=K, size=(WIDTH, HEIGHT),
        d=(), model="plumb_bob", p=None, binning=0, **roi,
    ):  # fmt: skip
        def matrix(fx, fy, cx, cy):
            return [fx, 0, cx, 0, fy, cy, 0, 0, 1]

        projection = np.zeros((3, 4))
        projection[:, :3] = np.reshape(matrix(*(p or k)), (3, 3))
        message = self.make(
            "sensor_msgs/msg/CameraInfo",
            header=self.header(t, frame),
            height=size[1], width=size[0], distortion_model=model,
            d=np.array(d, np.float64), k=np.array(matrix(*k), np.float64),
            r=np.eye(3).ravel(), p=projection.ravel(),
            binning_x=binning, roi=self.make("sensor_msgs/msg/RegionOfInterest", **roi),
        )  # fmt: skip
        self.write(topic, "sensor_msgs/msg/CameraInfo", t, message)

    def image(
        self, t, samples, encoding="16UC1", topic="/camera/depth/image_raw", *, frame="camera",
        padding=0, big=False,
    ):  # fmt: skip
        """Write an image, optionally with padded rows or big-endian samples."""
        kind = np.dtype({"32FC1": "f4", "rgb8": "u1"}.get(encoding, "u2"))
        data = np.asarray(samples).astype(kind.newbyteorder(">" if big else "<"))
        rows = data.view(np.uint8).reshape(len(data), -1)
        rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=0xAB)
        message = self.make(
            "sensor_msgs/msg/Image",
            header=self.header(t, frame), height=data.shape[0], width=data.shape[1],
            encoding=encoding, is_bigendian=int(big), step=rows.shape[1],
            data=rows.reshape(-1),
        )  # fmt: skip
        self.write(topic, "sensor_msgs/msg/Image", t, message)

    def compressed(
        self, t, samples, encoding="16UC1", topic="/camera/depth/image_raw/compressedDepth", *,
        a=0.0, b=0.0, form=None, frame="camera",
    ):  # fmt: skip
        """Write depth of compressed_depth_image_transport: a header of 12 bytes and a PNG, or
        only the PNG in other forms.
        """
        file = io.BytesIO()
        Image.fromarray(np.asarray(samples, np.uint16)).save(file, "PNG")
        form = f"{encoding}; compressedDepth" if form is None else form
        head = struct.pack("<iff", 0, a, b) if "compressedDepth" in form else b""
        data = head + file.getvalue()
        self.write_compressed(topic, t, form, data, frame)

    def write_compressed(self, topic, t, form, data, frame="camera"):
        message = self.make(
            "sensor_msgs/msg/CompressedImage",
            header=self.header(t, frame), format=form, data=np.frombuffer(data, np.uint8),
        )  # fmt: skip
        self.write(topic, "sensor_msgs/msg/CompressedImage", t, message)

    def points(
        self, t, rows, topic="/points", *, frame="lidar", height=1, padding=0, big=False, **more
    ):
        """Write the points of a structured array with the layout of its fields."""
        numbers = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
        fields = [
            self.make(
                "sensor_msgs/msg/PointField", name=name, offset=int(offset), count=1,
                datatype=numbers[kind.str[1:]],
            )
            for name, (kind, offset) in (rows.dtype.fields or {}).items()
        ]  # fmt: skip
        data = rows.view(np.uint8).reshape(height, -1)
        data = np.pad(data, ((0, 0), (0, padding)), constant_values=0xCD)
        layout = {
            "height": height, "width": len(rows) // height, "point_step": rows.dtype.itemsize,
            "row_step": data.shape[1],
        } | more  # fmt: skip
        message = self.make(
            "sensor_msgs/msg/PointCloud2",
            header=self.header(t, frame), fields=fields, is_bigendian=big,
            data=data.reshape(-1), is_dense=False, **layout,
        )  # fmt: skip
        self.write(topic, "sensor_msgs/msg/PointCloud2", t, message)

    def livox_message(self, t, points, seconds, tags=0, *, package=LIVOX[1], frame="livox_frame"):
        """Return a CustomMsg of points (N, 3) with their times after the stamp."""
        rows = zip(points, seconds, np.broadcast_to(tags, len(points)), strict=True)
        return self.make(
            f"{package}/msg/CustomMsg",
            header=self.header(t, frame), timebase=(START + round(t)) * 10**9,
            point_num=len(points), lidar_id=1, rsvd=np.zeros(3, np.uint8),
            points=[
                self.types.types[f"{package}/msg/CustomPoint"](
                    offset_time=round(s * 1e9), x=float(x), y=float(y), z=float(z), reflectivity=7,
                    tag=int(tag), line=2,
                )
                for (x, y, z), s, tag in rows
            ],
        )  # fmt: skip

    def livox(
        self, t, points, seconds, tags=0, topic="/livox/lidar", *, package=LIVOX[1],
        frame="livox_frame",
    ):  # fmt: skip
        message = self.livox_message(t, points, seconds, tags, package=package, frame=frame)
        self.write(topic, f"{package}/msg/CustomMsg", t, message)


@contextmanager
def open_writer(folder, container, name, compression):
    from rosbags.rosbag2 import CompressionFormat, CompressionMode

    if container == "ros1":
        ros1 = Ros1Writer(folder / f"{name}.bag")
        if compression:
            ros1.set_compression(ros1.CompressionFormat[compression.upper()])
        with ros1 as writer:
            yield BagWriter(writer, ros1=True)
        return
    plugin = StoragePlugin.MCAP if container == "mcap" else StoragePlugin.SQLITE3
    ros2 = Ros2Writer(folder / name, version=9, storage_plugin=plugin)
    if compression:
        ros2.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
    with ros2 as writer:
        yield BagWriter(writer, ros1=False)


def path_of(folder, container, name):
    """Return the path of a bag: the file of an MCAP, or the folder of a rosbag2 database."""
    if container == "ros1":
        return folder / f"{name}.bag"
    return folder / name / f"{name}.mcap" if container == "mcap" else folder / name


def write(folder, fill, container="mcap", name="run", compression=""):
    folder.mkdir(parents=True, exist_ok=True)
    with open_writer(folder, container, name, compression) as writer:
        fill(writer)
    return path_of(folder, container, name)


class MessageWriter(BagWriter):
    def __init__(self, *, ros1=False):
        super().__init__(None, ros1=ros1)
        self.written: list[tuple[str, str, Any]] = []  #: topic, type, message

    def raw(self, topic, name, t, data):
        read = self.types.deserialize_ros1 if self.ros1 else self.types.deserialize_cdr
        self.written.append((topic, name, read(data, name)))

    def last(self):
        return self.written[-1][2]
