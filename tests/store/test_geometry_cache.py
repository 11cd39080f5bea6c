"""Tests of the cache of decoded artifacts: content, limits and eviction."""

from types import SimpleNamespace

import pytest

from sceneprint import store
from sceneprint.errors import DamagedBlob
from sceneprint.formats.artifact import write_geometry
from sceneprint.geometry.registration.overlap import sample_points
from sceneprint.pipeline import prepare
from sceneprint.store import GeometryCache
from sceneprint.store.blobs.folder import FolderBlobs


@pytest.fixture(scope="module")
def artifacts(small_signer, room_frames):
    return [write_geometry(prepare(frame, small_signer)[1]) for frame in room_frames[:4]]


@pytest.fixture
def blobs(tmp_path):
    return FolderBlobs(tmp_path / "blobs", make=True)


def test_what_is_read_again_is_the_same_object_with_what_was_worked_out_of_it(blobs, artifacts):
    cache, digest = GeometryCache(blobs, 1 << 30), blobs.put(artifacts[0])
    first = cache.read(digest)
    assert write_geometry(first) == artifacts[0]
    points = sample_points(first.surface, 4)
    assert cache.read(digest) is first
    assert sample_points(cache.read(digest).surface, 4) is points


def test_the_least_recently_used_goes_first_and_memory_stays_within_its_bound(blobs, artifacts):
    digests = [blobs.put(artifact) for artifact in artifacts]
    size = _size_of_one(blobs, digests[0])
    cache = GeometryCache(blobs, int(3.5 * size))
    read = [cache.read(digest) for digest in digests[:3]]
    assert 2.5 * size < cache.bytes_held <= 3.5 * size
    assert cache.read(digests[0]) is read[0]  # used: the second is the oldest now
    cache.read(digests[3])
    assert cache.bytes_held <= 3.5 * size
    assert cache.read(digests[0]) is read[0]
    assert cache.read(digests[2]) is read[2]
    assert cache.read(digests[1]) is not read[1]


def test_a_deleted_frame_leaves_nothing(blobs, artifacts):
    cache = GeometryCache(blobs, 1 << 30)
    digests = [blobs.put(artifact) for artifact in artifacts[:2]]
    kept = [cache.read(digest) for digest in digests][1]
    blobs.remove(digests[0])
    cache.forget([digests[0], "f" * 64])
    with pytest.raises(DamagedBlob):
        cache.read(digests[0])
    assert cache.read(digests[1]) is kept
    cache.forget(digests)
    assert cache.bytes_held == 0


def test_what_was_read_long_ago_goes_however_often_it_is_used(blobs, artifacts, monkeypatch):
    now = [100.0]
    # the clock of other threads stays: an event loop that reads another time may sleep for hours
    monkeypatch.setattr(store, "time", SimpleNamespace(monotonic=lambda: now[0]))
    cache, digests = GeometryCache(blobs, 1 << 30), [blobs.put(a) for a in artifacts[:2]]
    first = cache.read(digests[0])
    now[0] = 130.0
    second = cache.read(digests[1])
    cache.read(digests[0])
    cache.forget_older(31.0)
    assert cache.read(digests[0]) is first
    cache.forget_older(30.0)
    assert cache.read(digests[1]) is second
    assert cache.read(digests[0]) is not first


def _size_of_one(blobs, digest):
    cache = GeometryCache(blobs, 1 << 30)
    cache.read(digest)
    return cache.bytes_held
