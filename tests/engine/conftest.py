"""Fixtures of the engine tests: two paths through two rooms, and maps of them."""

from __future__ import annotations

import io
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sceneprint.engine.jobs.tasks import LongJob
from sceneprint.engine.search import local_index
from sceneprint.formats.artifact import read_geometry, write_geometry
from sceneprint.formats.dataset import decode_frame, write_depth_png
from sceneprint.geometry.signature.fisher_vector import Whitening
from sceneprint.pipeline import open_signer, prepare
from sceneprint.settings import Settings
from sceneprint.store.blobs.folder import MARK
from sceneprint.store.maps import MapUsage, counted_usage, find_map
from sceneprint.types import DepthFrame, Floats
from sceneprint_client.api import CameraIntrinsics, FrameMeta, GivenPose, JobState, NewMap
from sceneprint_client.api.frames import ImportOptions
from tests.whole_engine import Engine


@dataclass(frozen=True)
class Upload:
    """A frame as a robot sends it, with its true pose."""

    data: bytes
    meta: FrameMeta
    frame: DepthFrame
    pose: Floats
    room: str


def packed_again(data, level=0):
    """Return the same pixels as another PNG."""
    out = io.BytesIO()
    Image.open(io.BytesIO(data)).save(out, "PNG", compress_level=level)
    assert out.getvalue() != data
    return out.getvalue()


def flip(path, position):
    data = bytearray(path.read_bytes())
    data[position] ^= 1 << position % 8
    path.write_bytes(data)


def used(engine):
    """Return what `hall` is counted to hold, which a count over its rows confirms."""
    with engine.store.database.read() as connection:
        row = find_map(connection, "hall")
        assert counted_usage(connection, row.number) == MapUsage(row.used_frames, row.used_bytes)
    return MapUsage(row.used_frames, row.used_bytes)


def bytes_on_disk(engine):
    """Return the size of all files below the folder of blobs, unfinished ones too."""
    paths = engine.settings.blob_dir.rglob("*")
    # the mark says whose the blobs are
    return sum(path.stat().st_size for path in paths if path.is_file() and path.name != MARK)


def begin_import(engine, data, options=None, map_name="hall"):
    """Send a file to be imported; returns the job."""
    options = options or ImportOptions()
    with engine.imports.receive(map_name, options) as receiver:
        receiver.write(data)
        file = receiver.end()
    return engine.imports.begin(map_name, file, options)[0]


def claim_long(engine):
    """Claim a long job; frames that wait to be signed are left waiting."""
    while not isinstance(work := engine.claim("test"), LongJob):
        assert work is not None
    return work


@pytest.fixture(scope="session")
def make_upload(tmp_path_factory):
    path = tmp_path_factory.mktemp("upload") / "depth.png"

    def make(frame, room, **more):
        write_depth_png(path, frame.depth, 1000.0)
        data, k, pose = path.read_bytes(), frame.intrinsics, frame.pose
        camera = CameraIntrinsics(
            width=k.width, height=k.height, fx=k.fx, fy=k.fy, cx=k.cx, cy=k.cy
        )
        placed = GivenPose(parent_frame=room, matrix=pose.tolist())
        meta = FrameMeta.model_validate({"intrinsics": camera, "pose": placed} | more)
        return Upload(data, meta, decode_frame(data, k), pose, room)

    return make


@pytest.fixture(scope="session")
def uploads(make_upload, room_views):
    """Six views along a path in each of two rooms."""
    rooms = [room_views(21, i, 6, along_path=True) for i in range(2)]
    return tuple(make_upload(frame, room.name) for room in rooms for frame in room.frames)


@pytest.fixture(scope="session")
def signer():
    return open_signer("depth")


@pytest.fixture(scope="session")
def whitened_model(small_model):
    """The small model with whitened signatures of 64 bytes, which are compared by L2."""
    axes = np.random.default_rng(1).integers(-127, 128, (64, small_model.signature_bytes))
    ones = np.ones(64)
    return replace(
        small_model,
        whitening=Whitening(
            small_model.levels, axes.astype(np.int8), ones / 1000, 0 * ones, 500_000.0
        ),
    )


@pytest.fixture(scope="session")
def prepared(uploads, signer):
    """The library's signatures of the uploads, with decoded artifacts."""
    pairs = [prepare(each.frame, signer) for each in uploads]
    return [(signature, read_geometry(write_geometry(seen))) for signature, seen in pairs]


@pytest.fixture
def make_engine(tmp_path):
    """A function that opens engines on a data folder; all are closed after the test."""
    opened = []

    def make(folder=tmp_path / "data", **more):
        opened.append(Engine(Settings.model_validate({"data_dir": folder} | more)))
        return opened[-1]

    yield make
    for engine in reversed(opened):
        engine.close()


@pytest.fixture(scope="session")
def signed_folder(once, uploads):
    """A read-only data folder of all processes, whose map `hall` has all signed uploads."""

    def make(folder):
        with Engine(Settings(data_dir=folder)) as engine:
            engine.create_map(NewMap(name="hall", model="depth"))
            for each in uploads:
                engine.add(each)
            assert engine.work_off() == [JobState.SUCCEEDED] * len(uploads)

    return once("signed", make)


@pytest.fixture
def _always_look(monkeypatch):
    monkeypatch.setattr(local_index, "_LOOK_S", 0.0)


@pytest.fixture
def data(signed_folder, tmp_path):
    return Path(shutil.copytree(signed_folder, tmp_path / "data"))


@pytest.fixture
def full(data, make_engine):
    del data
    return make_engine()


@pytest.fixture
def empty(make_engine):
    engine = make_engine()
    engine.create_map(NewMap(name="hall", model="depth"))
    return engine
