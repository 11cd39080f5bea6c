"""What reads files of strangers, as targets of a fuzzer that is guided by coverage (atheris).

    python -m benchmarks.siege.decoders seeds  NAME FOLDER
    python -m benchmarks.siege.decoders fuzz   NAME FOLDER [options of libFuzzer]
    python -m benchmarks.siege.decoders replay NAME FOLDER

FOLDER/corpus holds inputs, FOLDER/findings what was found; the slow ones that libFuzzer leaves
there (timeout-, slow-unit-) are judged by `replay`. `fuzz` runs kernels as Python
(NUMBA_DISABLE_JIT=1), so that their branches guide too, and an index out of bounds is an error;
`replay` runs every input of the corpus and every finding with compiled kernels, and measures.
"""

from __future__ import annotations

import gc
import hashlib
import importlib
import io
import json
import struct
import sys
import tarfile
import tempfile
import time
import traceback
import tracemalloc
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

#: Seconds of the processor, and bytes beside those of 4 KiB for each of the input, that an input
#: may take.
MOST_S, MOST_BYTES, BYTES_EACH = 2.0, 64 << 20, 4096
Read = Callable[[bytes], object]


@dataclass(frozen=True)
class Target:
    """A decoder.

    Parameters
    ----------
    seeds : makes sound files, small ones
    reader : imports the decoder, and returns it
    most : bytes of an input
    """

    seeds: Callable[[], list[bytes]]
    reader: Callable[[], Read]
    most: int = 4096


# Sound files.


def _depth_seeds() -> list[bytes]:
    from sceneprint.formats.depth_file import encode_png

    samples = np.arange(12 * 16, dtype=np.uint16).reshape(12, 16) * 37
    png = encode_png(samples)
    return [png, struct.pack("<iff", 0, 0.0, 0.0) + png, _npy(samples), _npy(samples / 1000.0)]


def _npy(array: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.save(out, array.astype(np.float32) if array.dtype.kind == "f" else array)
    return out.getvalue()


def _points() -> np.ndarray:
    return np.random.default_rng(1).normal(0, 3, (24, 3)).astype(np.float32)


def _ply_seeds() -> list[bytes]:
    points = _points()
    fields = "property float x\nproperty float y\nproperty float z\n"

    def head(form: str, more: str = "") -> bytes:
        return f"ply\nformat {form} 1.0\nelement vertex 24\n{fields}{more}end_header\n".encode()

    rows = "".join(f"{x} {y} {z}\n" for x, y, z in points).encode()
    faces = "element face 2\nproperty list uchar int vertex_indices\n"
    lists = struct.pack("<B3iB3i", 3, 0, 1, 2, 3, 1, 2, 3)
    return [
        head("ascii") + rows,
        head("ascii", faces) + rows + b"3 0 1 2\n3 1 2 3\n",
        head("binary_little_endian") + points.tobytes(),
        head("binary_big_endian") + points.astype(">f4").tobytes(),
        head("binary_little_endian", faces) + points.tobytes() + lists,
    ]


def _pcd_seeds() -> list[bytes]:
    points = _points()
    head = (
        b"# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 24\n"
        b"HEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 24\nDATA "
    )
    columns = points.T.tobytes()
    # LZF of literals alone: runs of 32 bytes, each after its length less one
    runs = [columns[i : i + 32] for i in range(0, len(columns), 32)]
    packed = b"".join(bytes([len(run) - 1]) + run for run in runs)
    rows = "".join(f"{x} {y} {z}\n" for x, y, z in points).encode()
    sizes = struct.pack("<II", len(packed), len(columns))
    return [
        head + b"ascii\n" + rows,
        head + b"binary\n" + points.tobytes(),
        head + b"binary_compressed\n" + sizes + packed,
    ]


def _las_seeds() -> list[bytes]:
    laspy: Any = importlib.import_module("laspy")
    found = []
    for version, form, compressed in (("1.2", 0, False), ("1.2", 1, True), ("1.4", 6, True)):
        header = laspy.LasHeader(point_format=form, version=version)
        header.scales = np.full(3, 0.001)
        cloud = laspy.LasData(header)
        cloud.x, cloud.y, cloud.z = _points().T.astype(np.float64)
        out = io.BytesIO()
        backend = {"laz_backend": laspy.LazBackend.Lazrs} if compressed else {}
        cloud.write(out, do_compress=compressed, **backend)
        found.append(out.getvalue())
    return found


def _scan_seeds() -> list[bytes]:
    points = _points()
    with_intensity = np.hstack([points, np.ones((24, 1), np.float32)])
    messages = [data for kind, data in _messages() if kind.endswith("PointCloud2")]
    return [_npy(points), _npy(with_intensity), with_intensity.tobytes(), *messages]


def _members() -> list[tuple[str, bytes]]:
    camera = {"width": 16, "height": 12, "fx": 14.0, "fy": 14.0, "cx": 7.5, "cy": 5.5}
    png = _depth_seeds()[0]
    return [
        ("room/seq-01/intrinsics.json", json.dumps(camera).encode()),
        ("room/seq-01/frame-000000.depth.png", png),
        ("room/seq-01/frame-000000.pose.txt", b"1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"),
        ("room/TrainSplit.txt", b"sequence1\n"),
        (f"{'x' * 60}/{'y' * 60}.txt", b"a long name"),
        ("tum/depth.txt", b"1.0 depth/1.png\n"),
        ("tum/depth/1.png", png),
        ("tum/groundtruth.txt", b"1.0 0 0 0 0 0 0 1\n"),
        ("tum/intrinsics.json", json.dumps(camera).encode()),
    ]


def _archive_seeds() -> list[bytes]:
    found = []
    for packing in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
        out = io.BytesIO()
        with zipfile.ZipFile(out, "w", packing) as archive:
            for name, data in _members():
                archive.writestr(zipfile.ZipInfo(name), data, packing)
        found.append(out.getvalue())
    for form in (tarfile.USTAR_FORMAT, tarfile.GNU_FORMAT, tarfile.PAX_FORMAT):
        out = io.BytesIO()
        with tarfile.open(fileobj=out, mode="w", format=form) as archive:
            for name, data in _members():
                member = tarfile.TarInfo(name)
                member.size = len(data)
                archive.addfile(member, io.BytesIO(data))
        found.append(out.getvalue())
    return found


def _messages(*, ros1: bool = False) -> list[tuple[str, bytes]]:
    """Types and bytes of a camera, images and points."""
    types = _types(ros1=ros1)
    made = types.types
    stamp = made["builtin_interfaces/msg/Time"](sec=1, nanosec=2)
    header = made["std_msgs/msg/Header"](*[0] * ros1, stamp, "camera")
    png, raw = _depth_seeds()[1], np.arange(192, dtype=np.uint16)
    region = made["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, do_rectify=False)
    square = np.array([14.0, 0, 7.5, 0, 14.0, 5.5, 0, 0, 1])
    field, points = made["sensor_msgs/msg/PointField"], _points()
    fields = [field(name=n, offset=4 * i, datatype=7, count=1) for i, n in enumerate("xyz")]
    found = {
        "sensor_msgs/msg/CameraInfo": [header, 12, 16, "plumb_bob", np.zeros(5), square,
                                       np.eye(3).ravel(), np.eye(3, 4).ravel(), 0, 0, region],
        "sensor_msgs/msg/Image": [header, 12, 16, "16UC1", 0, 32, raw.view(np.uint8)],
        "sensor_msgs/msg/CompressedImage": [header, "16UC1; compressedDepth",
                                            np.frombuffer(png, np.uint8)],
        "sensor_msgs/msg/PointCloud2": [header, 1, 24, fields, False, 12, 288,
                                        points.view(np.uint8).ravel(), True],
    }  # fmt: skip
    serialize = types.serialize_ros1 if ros1 else types.serialize_cdr
    return [(kind, bytes(serialize(made[kind](*values), kind))) for kind, values in found.items()]


def _types(*, ros1: bool = False) -> Any:
    typesys: Any = importlib.import_module("rosbags.typesys")
    stores = typesys.Stores
    return typesys.get_typestore(stores.ROS1_NOETIC if ros1 else stores.ROS2_HUMBLE)


def _message_seeds() -> list[bytes]:
    return [bytes([i]) + data for i, (_, data) in enumerate(_messages())]


def _bag_seeds() -> list[bytes]:
    """Bags, each after a byte that tells its container."""
    rosbag2: Any = importlib.import_module("rosbags.rosbag2")
    rosbag1: Any = importlib.import_module("rosbags.rosbag1")
    found = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for i, (plugin, suffix) in enumerate((("MCAP", "mcap"), ("SQLITE3", "db3"))):
            path = folder / suffix
            plugin = rosbag2.StoragePlugin[plugin]
            with rosbag2.Writer(path, version=9, storage_plugin=plugin) as writer:
                _write_messages(writer, _types(), _messages())
            found.append(bytes([i]) + next(path.glob(f"*.{suffix}")).read_bytes())
        for packed in (False, True):
            path = folder / f"{packed}.bag"
            writer = rosbag1.Writer(path)
            if packed:
                writer.set_compression(writer.CompressionFormat.BZ2)
            with writer:
                _write_messages(writer, _types(ros1=True), _messages(ros1=True))
            found.append(bytes([2]) + path.read_bytes())
    return found


def _write_messages(writer: Any, types: Any, messages: list[tuple[str, bytes]]) -> None:
    for i, (kind, data) in enumerate(messages):
        topic = "/camera/camera_info" if kind.endswith("CameraInfo") else f"/camera/t{i}"
        connection = writer.add_connection(topic, kind, typestore=types)
        for n in range(2):
            writer.write(connection, 10**9 * (n + 1), data)


def _artifact_seeds() -> list[bytes]:
    """An image, a sphere, points, and a scan with spread points, of 8 x 6 and one patch each."""
    from sceneprint.formats import artifact as layouts

    row = np.zeros(1, layouts._PATCH)
    row["normal"], row["area"], row["size"] = (0, 0, 1), 1, 9
    end, model, size = row.tobytes() + bytes(16), bytes(32), (8, 6, 1, 16)
    samples = (np.arange(8 * 6 * 5) % 200 + 20).astype("<u2").tobytes()
    turn, step = (0.1, 0.2, 0.3), 2.0**-10
    lens = layouts._DEPTH.pack(*size, 7.0, 7.0, 3.5, 2.5, 1e-5, model)
    sphere = layouts._CLOUD.pack(*size, layouts._SPHERE, 1, *turn, step, model)
    points = layouts._CLOUD.pack(48, 1, 1, 16, layouts._POINTS, 0, *turn, step, model)
    spread = layouts._SPREAD.pack(10, *turn, step)
    bodies = {
        layouts.SCHEMA_VERSION: [lens + samples[: 48 * 6]],
        layouts.CLOUD_SCHEMA: [sphere + samples[: 48 * 6], points + samples],
        layouts.SCAN_SCHEMA: [sphere + spread + samples[: 48 * 4 + 10 * 8]],
    }
    return [
        layouts._HEAD.pack(layouts.MAGIC, schema, zlib.crc32(body + end)) + body + end
        for schema, each in bodies.items()
        for body in each
    ]


def _preset() -> bytes:
    return (Path(__file__).parents[2] / "sceneprint/presets/paper.safetensors").read_bytes()


def _model_seeds() -> list[bytes]:
    """After 0 the beginning of a file; after 1 our header, and the arrays are those of a preset."""
    data = _preset()
    end = 8 + int.from_bytes(data[:8], "little")
    header = json.loads(data[8:end])["__metadata__"]["sceneprint"]
    return [b"\0" + data[: end + 4096], b"\1" + header.encode()]


def _sidecar_seeds() -> list[bytes]:
    camera = {"width": 16, "height": 12, "fx": 14.0, "fy": 14.0, "cx": 7.5, "cy": 5.5}
    source = {"viewpoint": [0, 0, 1], "units_per_metre": 1000, "up": [0, 0, 1]}
    meta = {
        "intrinsics": camera, "pose": {"translation": {"x": 1, "y": 2, "z": 3}}, "tags": ["a"],
        "captured_at": "2026-01-01T00:00:00Z",
    }  # fmt: skip
    texts = [
        json.dumps(camera | {"depth_scale": 1000, "up": [0, -1, 0]}), json.dumps(source),
        "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "# t x y z\n1.0 0 0 0 0 0 0 1\n", json.dumps(meta),
    ]  # fmt: skip
    return [bytes([i]) + text.encode() for i, text in enumerate(texts)]


# Readers.


def _depth_reader() -> Read:
    from sceneprint.formats.depth_file import decode_frame, size_of
    from sceneprint.types import Intrinsics

    def read(data: bytes) -> object:
        width, height = size_of(data[:4096]) or (16, 12)
        width, height = max(width, 1), max(height, 1)
        lens = Intrinsics(width, height, float(width), float(width), width / 2, height / 2)
        return decode_frame(data, lens)

    return read


def _cloud_reader() -> Read:
    from sceneprint.formats.points import decode_scan, format_of

    return lambda data: decode_scan(data, file_format=None if format_of(data) else "kitti")


def _archive_reader() -> Read:
    from sceneprint.engine.ingest.archive_import import steps_of
    from sceneprint.formats.archive import open_archive

    folder = Path(tempfile.mkdtemp(prefix="sceneprint-fuzz-", dir=_memory_folder()))

    def read(data: bytes) -> object:
        with open_archive(io.BytesIO(data), folder) as archive:
            for step in list(steps_of(archive, 1))[:20]:
                if step.reference is not None:
                    archive.data_of(step.reference)
        return None

    return read


def _message_reader() -> Read:
    from sceneprint.formats.recording.bag import _stated
    from sceneprint.formats.recording.topics import cloud_file, depth_file

    types, kinds = _types(), [kind for kind, _ in _messages()]

    def read(data: bytes) -> object:
        kind = kinds[data[0] % len(kinds)] if data else kinds[0]
        with _stated(Path("message")):
            message = types.deserialize_cdr(data[1:], kind)
        if kind.endswith("PointCloud2"):
            return cloud_file(message)
        if kind.endswith("CameraInfo"):
            return None
        return depth_file(message, compressed=kind.endswith("CompressedImage"))

    return read


def _bag_reader() -> Read:
    from sceneprint.formats.recording.selection import RecordingOptions, bag_outline

    folder = Path(tempfile.mkdtemp(prefix="sceneprint-fuzz-", dir=_memory_folder()))

    def read(data: bytes) -> object:
        suffix = ("mcap", "db3", "bag")[data[0] % 3] if data else "mcap"
        path = folder / f"run.{suffix}"
        path.write_bytes(data[1:])
        try:
            return bag_outline(path, RecordingOptions())
        finally:
            for left in folder.iterdir():
                left.unlink()

    return read


def _artifact_reader() -> Read:
    from sceneprint.formats.artifact import _HEAD, MAGIC, read_geometry

    def read(data: bytes) -> object:
        if len(data) >= _HEAD.size and data[: len(MAGIC)] == MAGIC:  # with its own checksum
            body = data[_HEAD.size :]
            data = _HEAD.pack(MAGIC, _HEAD.unpack_from(data)[1], zlib.crc32(body)) + body
        return read_geometry(data)

    return read


def _model_reader() -> Read:
    from safetensors.numpy import load, save

    from sceneprint.models.model_file import parse_model

    arrays = load(_preset())

    def read(data: bytes) -> object:
        if data[:1] < b"\1":
            return parse_model(data[1:], "model")
        header = data[1:].decode("utf-8", "replace")
        return parse_model(save(arrays, {"sceneprint": header}), "model")

    return read


def _sidecar_reader() -> Read:
    from pydantic import ValidationError

    from sceneprint.formats.dataset.frame_reference import read_trajectory
    from sceneprint_client.api import FrameMeta
    from sceneprint_client.sidecars import find_cloud_source, read_camera, read_pose

    folder = Path(tempfile.mkdtemp(prefix="sceneprint-fuzz-", dir=_memory_folder()))
    place = folder / "cloud.json"

    def meta(_: Path) -> object:
        try:
            return FrameMeta.model_validate_json(place.read_bytes())
        except ValidationError:  # that is its word for it
            return None

    readers: tuple[Callable[[Path], object], ...] = (
        read_camera, lambda path: find_cloud_source(path.parent), read_pose, read_trajectory, meta,
    )  # fmt: skip

    def read(data: bytes) -> object:
        place.write_bytes(data[1:])
        return readers[data[0] % len(readers) if data else 0](place)

    return read


def _memory_folder() -> Path | None:
    """Where files are written fast."""
    folder = Path("/dev/shm")
    return folder if folder.is_dir() else None


TARGETS = {
    "depth": Target(_depth_seeds, _depth_reader),
    "ply": Target(_ply_seeds, _cloud_reader),
    "pcd": Target(_pcd_seeds, _cloud_reader),
    "las": Target(_las_seeds, _cloud_reader),
    "scan": Target(_scan_seeds, _cloud_reader),
    "archive": Target(_archive_seeds, _archive_reader, 16384),
    "message": Target(_message_seeds, _message_reader),
    "bag": Target(_bag_seeds, _bag_reader, 65536),
    "artifact": Target(_artifact_seeds, _artifact_reader),
    "model": Target(_model_seeds, _model_reader, 32768),
    "sidecar": Target(_sidecar_seeds, _sidecar_reader, 2048),
}


# What is done with them.


def write_seeds(name: str, folder: Path) -> None:
    """Write the sound files of a target into FOLDER/corpus."""
    for place in ("corpus", "findings"):
        (folder / place).mkdir(parents=True, exist_ok=True)
    for data in TARGETS[name].seeds():
        (folder / "corpus" / hashlib.sha256(data).hexdigest()[:16]).write_bytes(data)


def _note(folder: Path, kind: str, data: bytes, why: str) -> None:
    """Keep an input that something was found with: one of each place in the code."""
    mark = hashlib.sha256(f"{kind} {why.splitlines()[0]}".encode()).hexdigest()[:12]
    place = folder / "findings" / f"{kind}-{mark}"
    if not place.exists():
        place.write_bytes(data)
        place.with_suffix(".txt").write_text(why)


def _unstated(read: Read, data: bytes) -> str | None:
    """What an input raises that is no error of ours: its type and place, then its traceback."""
    from sceneprint.errors import SceneprintError

    try:
        read(data)
    except SceneprintError:
        return None
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{type(error).__name__} in {Path(place.filename).name}:{place.lineno}"
        return f"{where}\n{traceback.format_exc()}"
    return None


def fuzz(name: str, folder: Path, options: list[str]) -> None:
    """Run atheris on a target; does not return."""
    atheris: Any = importlib.import_module("atheris")
    with atheris.instrument_imports(include=["sceneprint", "sceneprint_client", "rosbags"]):
        read = TARGETS[name].reader()
    warnings.simplefilter("ignore")

    def one_input(data: bytes) -> None:
        why = _unstated(read, data)
        if why is not None:
            _note(folder, "unstated", data, why)

    given = [f"-max_len={TARGETS[name].most}", f"-artifact_prefix={folder}/findings/"]
    atheris.Setup([name, str(folder / "corpus"), *given, *options], one_input)
    atheris.Fuzz()


@contextmanager
def _measured(told: dict[str, float]) -> Iterator[None]:
    gc.collect()
    tracemalloc.reset_peak()
    before, start = tracemalloc.get_traced_memory()[0], time.process_time()
    try:
        yield
    finally:
        told["s"] = time.process_time() - start
        told["bytes"] = tracemalloc.get_traced_memory()[1] - before


def replay(name: str, folder: Path) -> None:
    """Run every input with compiled kernels; note what is not stated, slow, or takes memory."""
    read = TARGETS[name].reader()
    warnings.simplefilter("ignore")
    for data in TARGETS[name].seeds():  # what is imported and compiled once
        _unstated(read, data)
    tracemalloc.start()
    worst = {"s": 0.0, "bytes": 0.0}
    places = sorted((folder / "corpus").iterdir()) + sorted((folder / "findings").iterdir())
    inputs = [one for one in places if one.suffix != ".txt"]
    for place in inputs:
        data, told = place.read_bytes(), dict[str, float]()
        with _measured(told):
            why = _unstated(read, data)
        if why is not None:
            _note(folder, "compiled", data, why)
        if told["s"] > MOST_S:
            _note(folder, "late", data, f"{told['s']:.1f} s for {len(data)} bytes")
        if told["bytes"] > MOST_BYTES + BYTES_EACH * len(data):
            _note(folder, "memory", data, f"{told['bytes']:.0f} bytes for {len(data)}")
        worst = {key: max(worst[key], told[key]) for key in worst}
    print(json.dumps({"inputs": len(inputs)} | worst))


def main() -> int:
    """Do one thing with one target, as the lines above say."""
    what, name, folder, *options = sys.argv[1:]
    if what == "seeds":
        write_seeds(name, Path(folder))
    elif what == "fuzz":
        fuzz(name, Path(folder), options)
    else:
        replay(name, Path(folder))
    return 0


if __name__ == "__main__":
    sys.exit(main())
