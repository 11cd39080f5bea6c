"""Rows of `make bench`: what they compare is the same work, and pages hold what was measured."""

from __future__ import annotations

import json
import math
import multiprocessing
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks import disk, dpp, readiness, registration, scan, search, service, summary
from benchmarks.__main__ import BEGIN, END, Rows, page
from benchmarks.encode import EncodeFigures, points_of
from benchmarks.machine import Machine
from benchmarks.pairs import FramePair, pairs_among, real_pairs, synthetic_pairs
from sceneprint.errors import MissingDependency
from sceneprint.formats.artifact import write_geometry
from sceneprint.formats.dataset import Camera, find_sequences, write_depth_png, write_intrinsics
from sceneprint.fusion import open3d
from sceneprint.geometry.retrieval.ranking import distances, diversify, pairwise_distances, rank
from sceneprint.lab.evaluation.pair_run import register
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


def test_views_of_a_walk_are_farther_apart_the_longer_it_is() -> None:
    walk = dpp.views(25, 4096)
    to_first = distances(walk[0], walk, "l2")
    assert to_first[0] == 0
    assert (np.diff(to_first[:3]) > 0).all()
    assert to_first[1] < 0.7 * to_first[12]


@pytest.mark.parametrize("size", [20, 60])
def test_both_selections_are_the_same(size: int) -> None:
    found = dpp.measure(size=size, k=6, length=2048, runs=1)
    assert found.agrees
    assert (found.ranking, found.selected) == (size, 6)
    assert min(found.pairwise, found.greedy, found.naive, found.share) > 0
    text = "\n".join(dpp.table(found))
    assert f"6 of a ranking of {size}" in text
    assert "differ" not in text
    assert "differ" in "\n".join(dpp.table(replace(found, agrees=False)))


def test_naive_selection_finds_the_largest_determinant() -> None:
    database = dpp.views(12, 512)
    ranking = rank(distances(database[6], database, "l2"), 12, 1.0)
    among = pairwise_distances(database[ranking.indices], "l2")
    found = dpp.naive_selection(ranking, among, 4)
    assert found == diversify(ranking.distances, among, 4).indices.tolist()
    assert found[0] == 0


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


@pytest.mark.thorough
def test_pairs_of_rooms_and_of_no_recordings(tmp_path: Path) -> None:
    assert real_pairs(tmp_path, 5) == []
    (pair,) = synthetic_pairs(1)
    assert pair.overlap >= 0.3


@pytest.mark.thorough
def test_pairs_of_recordings(data_root: Path) -> None:
    pairs = real_pairs(data_root, 4, step=100)
    assert len(pairs) == 4
    assert min(pair.overlap for pair in pairs) >= 0.3


@pytest.mark.parametrize(
    ("metres", "degrees", "right"),
    [(0.0, 0.0, True), (0.099, 9.9, True), (0.101, 0.0, False), (0.0, 10.1, False)],
)
def test_right_within_ten_centimetres_and_degrees(
    metres: float, degrees: float, right: bool
) -> None:
    truth, found = np.eye(4), np.eye(4)
    truth[:3, 3] = 1.0, 2.0, 3.0
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    found[:2, :2] = [[c, -s], [s, c]]
    found[:3, 3] = 1.0, 2.0 + metres, 3.0
    assert registration.is_right(found, truth) is right
    assert not registration.is_right(None, truth)


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


@pytest.mark.thorough
def test_open3d_finds_a_frame_in_itself(room_frames: tuple[DepthFrame, ...]) -> None:
    try:
        o3d = open3d("FPFH")
    except MissingDependency as error:
        pytest.skip(str(error))
    points = points_of(room_frames[0], 0.3, 9.0)
    found = register(points, points, o3d, [registration.METHOD])[registration.METHOD]
    np.testing.assert_allclose(found.refined, np.eye(4), atol=1e-3)
    assert list(found.stages) == ["voxel grid", "normals", "features", "RANSAC", "ICP"]


def test_page_and_json_hold_every_row() -> None:
    encode = EncodeFigures(
        3, {"pairs": 2.0}, 2.0, {"patches and descriptors": 9.0}, 170_000, {}, None, None, None,
        "no open3d",
    )  # fmt: skip
    rows = Rows(
        {"paper": (encode, 100.0)},
        [
            scan.ScanFigures(
                n,
                125_000,
                2.0,
                {"L1, one query": 4.0},
                {"L1, one query": 0.5},
                {"L1, one query": (0.4, 0.75)},
            )
            for n in (500, 4096)
        ],
        dpp.DppFigures(125, 10, 125_000, 20.0, 0.5, 10.0, 0.05, agrees=True),
        registration.RegistrationFigures(
            20, 0.5, {"validation": 20.0}, 20.0, 1.0, {"RANSAC": 200.0}, 200.0, 0.9, 0.1, 0.1, ""
        ),
        [
            search.SearchFigures(
                1000, 384, 16, 0.996, 5000.0, 900.0, 20.0, 1.5, 3.0, 0.5, 7.0, 384.0
            )
        ],
        service.ServiceFigures(
            10_000,
            20,
            {"decode": 5.0},
            200.0,
            (201.0, 210.0, 230.0),
            (80.0, 90.0, 99.5),
            1.05,
            (1.0, 2.0),
            (9.0, 30.0),
            7.5,
            {
                1: service.Throughput(5.0, 200.0, 260.0, 1.0),
                8: service.Throughput(9.0, 850.0, 1500.0, 0.93),
            },
        ),
        disk=[disk.DiskFigures(60, 384, 1500.0, 76e3, 174e3)],
    )
    section = page(Machine("a processor", 2, 8.0, "3.11", {"numpy": "2"}), rows, 0.1)
    assert section.startswith(BEGIN)
    assert section.endswith(END)
    for wanted in (
        "### A query over HTTP, 10,000 frames in the map",
        "| **over HTTP** | **210.0 (201.0 to 230.0)** |",
        "| **processor time of the service** | **90.0 (80.0 to 99.5)** |",
        "| 8 | 9.0 | 850 | 1500 | 0.93 |",
        "8 clients are answered **1.80** times as often as one.",
        "| **HTTP / library** | **1.05** |",
        "| /healthz while 4 clients query and a worker signs: p50, p99 | 9.0, 30.0 |",
        "| 1,000 | 384 | by sketches | 1.50 | 3.00 | 0.50 | 0.9960 | 5.0 | 0.9 | 0.02 | 7, 384 |",
        "| 384 | 1,500 | 76,000 | 174,000 |",
        "### Signing, `paper`",
        "### Exact scan of 500 signatures of 125,000 bytes (62.5 MB)",
        "### Exact scan of 4096 signatures of 125,000 bytes (512.0 MB)",
        "| L1, one query | 4.00 | 0.50 | 0.40 to 0.75 |",
        "| **greedy selection / by determinants** | **0.050** |",
        "| Open3D RANSAC | 200.0 |",
        "| **ours / Open3D** | **0.100** |",
        "truth: 1.00 of the pairs; Open3D's within it: 0.90.",
    ):
        assert wanted in section
    for one in (rows.dpp, rows.registration):
        assert json.loads(json.dumps(asdict(one))) == asdict(one)
    for one in rows.scan:
        assert json.loads(json.dumps(asdict(one)))["spread"]
    assert json.loads(json.dumps(asdict(rows.search[0]))) == asdict(rows.search[0])


def test_the_history_has_one_row_of_each_version() -> None:
    encode = EncodeFigures(3, {}, 2.0, {}, 170_000, {}, 50.0, 0.5, 0.75, "")
    served = service.ServiceFigures(
        10_000, 20, {}, 120.0, (1.0, 130.4, 200.0), (1.0, 90.0, 100.0), 1.0, (1.0, 2.0), (1.0, 2.0),
        7.0, {1: service.Throughput(5.0, 1.0, 2.0, 1.0), 8: service.Throughput(9.5, 1.0, 2.0, 1.0)},
    )  # fmt: skip
    first = summary.version_of("0.1.0", "2026-01-01", encode, served)
    row = "| 0.1.0 | 2026-01-01 | 0.50 | 0.75 | 2.40 | 130 | 90 | 1.90 |"
    assert first.row() == row
    text = f"a\n{summary.BEGIN}\n{summary.END}\nz\n"
    text = summary.with_version(text, first)
    bare = replace(encode, fpfh=None, ratio=None, ratio_with_artifact=None)
    text = summary.with_version(text, summary.version_of("0.2.0", "2026-02-01", bare, served))
    text = summary.with_version(text, replace(first, measured="2026-03-01"))
    assert text.splitlines() == [
        "a", summary.BEGIN, *summary.HEAD,
        "| 0.2.0 | 2026-02-01 |  |  |  | 130 | 90 | 1.90 |", row.replace("01-01", "03-01"),
        summary.END, "z",
    ]  # fmt: skip
    with pytest.raises(ValueError, match="the page has no section"):
        summary.with_version("a", first)


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
def test_a_building_of_its_own_is_gone_afterwards(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def write(folder: Path, rooms: int) -> Iterator[None]:
        folder.mkdir()
        write_intrinsics(folder, Camera(CAMERA, 1000.0, along_ray=False))
        for i in range(rooms):
            write_depth_png(folder / f"{i}.png", wall().depth, 1000.0)
            yield

    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(service, "write_building", write)
    with service.frames_of(None, most=3) as frames:
        assert [frame.path.name for frame in frames] == ["0.png", "2.png", "4.png"]
        assert frames[0].path.is_relative_to(tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.thorough
@pytest.mark.usefixtures("few_clients")
def test_a_load_that_dies_ends_the_measurement() -> None:
    with pytest.raises(RuntimeError, match=r"of 3 processes of the load died: \[1"):
        service._loaded("no address", [], seconds=1.0)
    assert multiprocessing.active_children() == []


def test_a_load_that_does_not_end_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(service, "END_S", 0.1)
    context = multiprocessing.get_context("spawn")
    stop = context.Event()
    stuck, never_started = (context.Process(target=time.sleep, args=(99,)) for _ in range(2))
    stuck.start()
    service._end([stuck, never_started], stop)
    assert (stop.is_set(), stuck.exitcode) == (True, -signal.SIGTERM)


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


def test_signatures_of_a_place_are_near_each_other() -> None:
    rows = search.signatures(np.arange(200), 448)
    assert rows.dtype == np.uint8
    np.testing.assert_array_equal(search.signatures(np.array([57]), 448)[0], rows[57])
    among = pairwise_distances(rows, "l2").astype(float)
    same = np.arange(200)[:, None] // search.PLACE == np.arange(200) // search.PLACE
    np.fill_diagonal(among, np.nan)
    assert np.nanmax(among[same]) < np.nanmin(among[~same])


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
