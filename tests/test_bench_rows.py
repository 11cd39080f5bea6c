"""Rows of `make bench`: what they compare is the same work, and pages hold what was measured."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks import disk, readiness, registration, scan, search, service
from benchmarks.machine import peak_megabytes_of_signing
from benchmarks.pairs import FramePair, pairs_among
from sceneprint.formats.artifact import write_geometry
from sceneprint.formats.dataset import Camera, find_sequences, write_depth_png, write_intrinsics
from sceneprint.models import Model
from sceneprint.pipeline import open_signer, prepare
from sceneprint.types import DepthFrame, Floats, Intrinsics

CAMERA = Intrinsics(80, 60, 70.0, 70.0, 39.5, 29.5)


def wall(shift: float = 0.0) -> DepthFrame:
    """A wall 2 m away, seen by a camera `shift` metres to the right, and turned upside down."""
    pose: Floats = np.diag([-1.0, -1.0, 1.0, 1.0])
    pose[0, 3] = shift
    return DepthFrame(np.full((60, 80), 2.0, np.float32), CAMERA, f"{shift:g} m", pose)


def pair_of(frames: tuple[DepthFrame, ...]) -> FramePair:
    """A frame with itself."""
    return FramePair(frames[0], frames[0], 1.0, np.eye(4))


def test_scan_compares_a_read_and_four_scans() -> None:
    found = scan.measure(signatures=5, length=64, runs=3)
    assert list(found.milliseconds) == list(found.shares)
    assert len(found.milliseconds) == 4
    assert found.read > 0
    assert all(value > 0 for value in (*found.milliseconds.values(), *found.shares.values()))
    assert list(found.spread) == list(found.shares)
    for name, (low, high) in found.spread.items():
        assert low <= found.shares[name] <= high
    text = "\n".join(scan.table(found))
    assert "5 signatures of 64 bytes" in text
    assert all(f"| {name} | " in text for name in found.milliseconds)


def test_pairs_by_hand() -> None:
    half = 40 / 70 * 2  # half of the width that is seen
    pairs = pairs_among([wall(), wall(half), wall(2 * half), wall(2.5 * half)])
    names = [(pair.query.name, pair.match.name) for pair in pairs]
    assert names == [
        (wall(half).name, wall().name),
        (wall(2 * half).name, wall(half).name),
        (wall(2.5 * half).name, wall(2 * half).name),
    ]
    assert pairs[0].overlap == 0.5
    # both cameras stand on their heads: what is to the right in the room is to their left
    np.testing.assert_allclose(pairs[0].T_match_query[:3, 3], [-half, 0, 0], atol=1e-12)
    np.testing.assert_allclose(pairs[0].T_match_query[:3, :3], np.eye(3), atol=1e-12)
    assert pairs_among([wall(), wall(), wall()], apart=2)[0].match.name == "0 m"
    assert len(pairs_among([wall(), wall(), wall()], apart=2)) == 1


def test_without_open3d_the_row_says_so(
    small_model: Model, room_frames: tuple[DepthFrame, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    figures = registration.measure([pair_of(room_frames)], small_model, warm_up=0)
    assert (figures.open3d, figures.open3d_right, figures.share) == (None, None, None)
    assert list(figures.stages) == ["geometry of both frames", "validation"]
    assert figures.ours == pytest.approx(sum(figures.stages.values()))
    text = "\n".join(registration.table(figures))
    assert "Open3D | not measured: FPFH needs Open3D, which cannot be imported" in text


@pytest.fixture
def few_clients(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two processes query and not four."""
    monkeypatch.setattr(service, "CLIENTS", 2)
    monkeypatch.setattr(service, "CROWD", 2)


@pytest.mark.thorough
@pytest.mark.usefixtures("few_clients")
def test_service_and_library_do_the_same_work(building: Path) -> None:
    """`measure` compares every answer with the library's."""
    with service.frames_of(building, 8) as frames:
        found = service.measure(frames, 2, seconds=1.0, map_frames=0)
    assert (found.frames, found.queries) == (6, 2)
    assert list(found.stages) == [
        "decode", "sign, with geometry", "retrieve", "diversify", "validate", "locate"
    ]  # fmt: skip
    assert 0 < found.cpu[0] <= found.cpu[1] <= found.cpu[2]
    assert list(found.throughput) == [1, 2]
    assert all(0 < one.p50 <= one.p99 for one in found.throughput.values())
    assert all(0 <= one.least <= 1 for one in found.throughput.values())
    assert found.ratio > 0
    assert 0 < found.idle[0] <= found.idle[1]
    assert 0 < found.loaded[0] <= found.loaded[1]


@pytest.mark.thorough
@pytest.mark.parametrize("flat_bytes", [search.FLAT, search.SKETCHES])
def test_a_search_is_compared_with_the_scan_of_all(flat_bytes: int) -> None:
    found = search.measure(frames=1000, length=64, flat_bytes=flat_bytes, runs=2)
    assert (found.frames, found.signature_bytes) == (980, 64)  # one of each place is asked for
    assert min(found.publish, found.append, found.open, found.exact, found.search) > 0
    assert found.ratio > 0
    assert (found.probes > 0) == (flat_bytes == search.SKETCHES)
    assert found.recall >= 0.995


@pytest.mark.thorough
@pytest.mark.parametrize("flat_bytes", [search.FLAT, search.SKETCHES])
def test_a_map_that_grew_is_compared_with_one_published_at_once(flat_bytes: int) -> None:
    found = search.measure_growth(frames=1300, length=64, flat_bytes=flat_bytes, runs=3)
    assert (found.frames, found.segments) == (127 * (1300 * 49 // 50 // 127), 4)
    assert 4 < found.written < 12  # sketches are written too
    assert 0 < found.share < 0.2
    assert found.append_ratio == found.append / found.whole > 0
    assert min(found.largest, found.search, found.one, found.search_ratio) > 0
    assert found.recall == found.recall_one == 1
    (row,) = [line for line in search.growth_table([found]) if line.startswith("| 1,")]
    assert row.startswith(f"| {found.frames:,} | 64 | 4 | {found.written:.1f} |")


@pytest.mark.thorough
def test_disk_of_a_frame(room_frames: tuple[DepthFrame, ...], tmp_path: Path) -> None:
    folder = tmp_path / "frames"
    folder.mkdir()
    write_intrinsics(folder, Camera(room_frames[0].intrinsics, 1000.0, along_ray=False))
    for i, frame in enumerate(room_frames):
        write_depth_png(folder / f"{i}.png", frame.depth, 1000.0)
    frames = [f for s in find_sequences(folder) for f in s.frames]
    assert len(frames) == 6
    found = disk.measure(frames, "depth", tmp_path / "data")
    assert (found.frames, found.signature_bytes) == (5, 448)
    assert found.uploads == np.mean([frame.path.stat().st_size for frame in frames[1:]])
    assert 0 <= found.database < 50_000  # five frames fill a page or none
    assert found.database * 5 % 4096 == 0
    signer = open_signer("depth")
    sizes = [len(write_geometry(prepare(f.read(), signer)[1])) for f in frames[1:]]
    assert found.artifacts == np.mean(sizes)


@pytest.mark.thorough
def test_a_start_is_measured_with_and_without_the_index(building: Path) -> None:
    with service.frames_of(building, 25) as frames:
        found = readiness.measure(frames[0], list(frames[1:]), 60, "depth")
    assert (found.frames, found.signature_bytes) == (60, 448)
    assert 0 < found.ready < found.first
    assert 20 < found.memory < 2000
    assert found.bare > 0
    assert set(found.signed) == {1, 2}
    assert min(found.signed.values()) > 0
    assert f"**{found.signed[2] / found.signed[1]:.2f}** times" in readiness.table(found)[-2]


@pytest.mark.parametrize("preset", ["paper", "depth"])
def test_signing_stays_under_its_memory(
    preset: str, room_frames: tuple[DepthFrame, ...], tmp_path: Path
) -> None:
    """The budget is 700 MB; a process that has done its imports alone needs over 50."""
    write_intrinsics(tmp_path, Camera(room_frames[0].intrinsics))
    write_depth_png(tmp_path / "frame.png", room_frames[0].depth, 1000.0)
    assert 50 < peak_megabytes_of_signing(tmp_path, preset) < 700
