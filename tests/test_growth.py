"""Growth of a map: what is made of signed frames keeps its neighbours, and lines are right."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks import curves, disk, extension, maps, recall
from benchmarks.curves import Line, Point, fit
from benchmarks.growth import BEGIN, END, write_page
from benchmarks.growth_page import GrowthFigures, lines_of, table
from benchmarks.trajectories import (
    ASIDE,
    MAP,
    QUERY,
    SEED,
    STEP,
    TWIN,
    Signed,
    laps,
    read_signed,
    role_in_recording,
    signed,
    write_signed,
)
from sceneprint.artifacts import write_geometry
from sceneprint.datasets import Camera, find_sequences, write_depth_png, write_intrinsics
from sceneprint.geometry.retrieval import cross_distances
from sceneprint.index import SHORTLIST, newest
from sceneprint.index.manifests import manifests, read_manifest
from sceneprint.pipeline import Signer, open_signer, prepare, sign
from sceneprint.synth import trajectory
from sceneprint.synth.synthesis import room_and_rng
from sceneprint.types import Bytes, Floats, Frame


def walk(n: int, seed: int, length: int = 1024, axes: int = 40) -> Bytes:
    """Frames along a random walk in a few directions, with noise of their own in all."""
    rng = np.random.default_rng(seed)
    steps = np.cumsum(rng.normal(0, 1, (n, axes)), axis=0) @ rng.normal(0, 1, (axes, length)) / 3
    made: Bytes = np.clip(np.rint(128 + steps + rng.normal(0, 1, steps.shape)), 0, 255).astype(
        np.uint8
    )
    return made


def squared(a: Bytes, b: Bytes) -> Floats:
    found: Floats = ((a.astype(float) - b) ** 2).sum(axis=1)
    return found


def test_lines_by_hand() -> None:
    found = fit([1, 2, 3], [3, 5, 7])
    assert (found.fixed, found.each) == pytest.approx((1, 2))
    assert found.at(10) == pytest.approx(21)
    # relative errors: of 2 and 1 the flat line is (1/2 + 1) / (1/4 + 1), and not 1.5
    assert fit([1, 2], [2, 1]) == Line(pytest.approx(1.2), 0.0)
    # no time is below zero: through the origin (1 + 1/2) / (1 + 1/4)
    assert fit([1, 2], [1, 4]) == Line(0.0, pytest.approx(1.2))
    # as far off the small one as off the large one, in parts of each
    low, middle, high = (fit([1, 10, 100], [1.2, 10, 100]).at(n) / n for n in (1, 10, 100))
    assert low == pytest.approx(1.2, rel=0.05)
    assert (middle, high) == pytest.approx((1, 1), rel=0.05)
    for bad in ([1.0], [0.0, 1.0]):
        with pytest.raises(ValueError, match="no line"):
            fit(range(1, len(bad) + 1), bad)


def test_a_mirrored_building_keeps_its_neighbours_and_is_another() -> None:
    known = np.concatenate([walk(100, seed) for seed in range(4)])
    mirror = extension.fit_mirror(known)
    made = np.concatenate(list(extension.places(known, mirror, 1000)))
    assert made.shape == (1000, 1024)
    np.testing.assert_array_equal(made[:400], known)
    within = cross_distances(known, known).astype(float)
    other = cross_distances(made[400:800], made[400:800]).astype(float)
    apart = within > 0
    assert np.median(np.abs(other[apart] / within[apart] - 1)) < 0.03
    order, mirrored = (np.argsort(d, axis=1)[:, 1:11] for d in (within, other))
    assert np.mean([np.isin(a, b).mean() for a, b in zip(order, mirrored, strict=True)]) > 0.9
    ratio, again = (np.median(np.sort(d)[:, 40] / np.sort(d)[:, 10]) for d in (within, other))
    assert again == pytest.approx(ratio, rel=0.03)
    # a frame is no nearer to its image than any neighbour
    image = np.diagonal(cross_distances(known, made[400:800]))
    assert np.median(image) > 2 * np.median(np.sort(within)[:, 10])
    assert not np.array_equal(made[400:600], made[800:])


def test_what_no_axis_holds_is_mirrored_byte_by_byte() -> None:
    known = walk(20, 7, 400)
    bare = extension.Mirror(np.full(400, 128, np.float32), np.empty((0, 400), np.float32))
    before, after = (x.astype(int) - 128 for x in (known, bare.building(known, 1)))
    flipped = (before == -after).all(axis=0)
    np.testing.assert_array_equal(flipped | (before == after).all(axis=0), True)
    assert 150 < flipped.sum() < 250
    assert not np.array_equal(bare.building(known, 2), bare.building(known, 1))


def test_frames_between_lie_as_far_off_as_real_ones() -> None:
    known = np.concatenate([walk(60, 1), walk(60, 2)])
    runs = np.repeat([0, 1], 60)
    made = np.concatenate(list(extension.visits(known, runs, 1300)))
    np.testing.assert_array_equal(made[:120], known)
    firsts = np.flatnonzero(runs[1:] == runs[:-1])
    first = firsts[np.arange(1180) % len(firsts)]
    whole = squared(known[first], known[first + 1])
    parts = squared(made[120:], known[first]) + squared(made[120:], known[first + 1])
    # squared distance grows evenly along a walk; on the straight line it would be two thirds
    assert (parts / whole).mean() == pytest.approx(1.0, abs=0.06)
    # and nothing lies between two walks
    assert squared(made[120:], known[first]).max() < 0.05 * squared(known[59:60], known[60:61])[0]
    np.testing.assert_array_equal(
        np.concatenate(list(extension.visits(known, runs, 70))), known[:70]
    )
    with pytest.raises(ValueError, match="follow each other"):
        list(extension.visits(known[:3], np.arange(3), 5))


def test_recall_by_a_naive_scan(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    case = recall.Case(
        "noise",
        rng.integers(0, 256, (1500, 512), np.uint8),
        rng.integers(0, 256, (20, 512), np.uint8),
    )
    rows, distances = recall.exact(case)
    naive = np.abs(case.queries[:, None].astype(int) - case.signatures).sum(axis=2)
    order = np.lexsort((np.broadcast_to(np.arange(1500), naive.shape), naive))
    np.testing.assert_array_equal(rows, order[:, :200])
    np.testing.assert_array_equal(distances, np.take_along_axis(naive, rows, axis=1))

    found = recall.measure([case, case], tmp_path, (20, 300, 1400))
    assert (found.frames, found.queries, found.signature_bytes) == (1500, 40, 512)
    nearest = np.sort(naive, axis=1)
    assert found.tenth == pytest.approx(np.median(nearest[:, 9] / nearest[:, 0]))
    assert found.hundredth == pytest.approx(np.median(nearest[:, 99] / nearest[:, 9]))
    means = [found.recall[s][0] for s in (20, 300, 1400)]
    assert 0 < means[0] < 0.2 < means[1] < 0.5  # noise has no code: much is missed
    assert means[2] > 0.99
    assert list(found.coverage) == [300, 1400]
    assert found.coverage[300] < found.coverage[1400]
    assert list(found.appended) == [20, 300, 1400]
    again = recall.published(tmp_path / "again", case.signatures, 1500)
    first, _ = recall.shares(case, rows, again, 300)
    assert found.recall[300] == pytest.approx(
        (first.mean(), np.concatenate([first, first]).std(ddof=1) / np.sqrt(40))
    )


@pytest.mark.thorough
def test_recall_of_a_real_map(data_root: Path, tmp_path: Path) -> None:
    """Every sixth frame of redkitchen, stretches of it held out."""
    frames = find_sequences(data_root / "7scenes/redkitchen")[0].frames[::6]
    read = ((role_in_recording(6 * i), 0, -1, f.read()) for i, f in enumerate(frames))
    kept = (each for each in read if each[0] != ASIDE)
    made = signed(kept, [open_signer("compact")])[0]
    case = maps.join("real", [made]).case
    assert (len(case.signatures), len(case.queries)) == (105, 30)
    assert recall.measure([case], tmp_path, (30,), appended=False).recall[30][0] >= 0.99


def test_laps_of_a_room() -> None:
    taken = list(laps(0, 2, 6))
    assert [role for role, *_ in taken] == [MAP] * 12 + [QUERY] * 2 + [TWIN] * 4
    assert [lap for _, lap, *_ in taken] == [0] * 6 + [1] * 6 + [2] * 2 + [3] * 4
    again = list(laps(0, 2, 6))
    for one, other in zip(taken, again, strict=True):
        np.testing.assert_array_equal(one[3].depth, other[3].depth)
    for _, _, origin, twin in taken[-4:]:
        original = taken[origin][3]
        np.testing.assert_array_equal(twin.pose, original.pose)
        assert np.mean(twin.depth != original.depth) > 0.005
        assert np.median(np.abs(twin.depth - original.depth)) < 0.05
    places = np.array([frame.pose[:3, 3] for _, _, _, frame in taken if frame.pose is not None])
    steps = np.linalg.norm(np.diff(places[:6], axis=0), axis=1)
    assert 0.01 < np.median(steps) < 0.6  # a robot's, not a sensor's at 30 a second
    room, rng = room_and_rng(SEED, 0)
    path = np.array(trajectory(room, 7 * STEP, rng))[:, :3, 3]
    off = np.linalg.norm(places[:, None] - path, axis=2).min(axis=1)
    assert off.min() > 0.005  # no lap follows the path itself,
    assert off.max() < 0.5  # and all go through the same place


def test_frames_that_cannot_be_signed_are_left_out(
    room_frames: tuple[Frame, ...], small_signer: Signer
) -> None:
    blank = replace(room_frames[0], depth=np.zeros_like(room_frames[0].depth))
    frames = [
        (MAP, 0, -1, blank), (MAP, 0, -1, room_frames[0]), (QUERY, 1, -1, room_frames[1]),
        (TWIN, 2, 1, room_frames[2]), (TWIN, 2, 0, room_frames[2]),
    ]  # fmt: skip
    [found] = signed(iter(frames), [small_signer])
    assert found.roles.tolist() == [MAP, QUERY, TWIN]
    assert found.runs.tolist() == [0, 1, 2]
    assert found.origins.tolist() == [-1, -1, 0]
    np.testing.assert_array_equal(found.signatures[1], sign(room_frames[1], small_signer).vector)


def test_roles_in_a_recording() -> None:
    roles = np.array([role_in_recording(i) for i in range(300)])
    asked, known = np.flatnonzero(roles == QUERY), np.flatnonzero(roles == MAP)
    assert (len(known), len(asked)) == (180, 60)
    assert np.abs(asked[:, None] - known).min() == 16  # half a second


def some(n: int, runs: int, seed: int) -> Signed:
    """Frames of which the last is a query."""
    roles = np.array([MAP] * (n - 1) + [QUERY])
    return Signed(walk(n, seed, 64), roles, np.arange(n) * runs // n, np.full(n, -1))


def test_maps_are_cut_and_joined(tmp_path: Path) -> None:
    places = [some(11, 2, 1), some(21, 2, 2), some(31, 1, 3)]
    joined = maps.join("joined", places, 25)
    np.testing.assert_array_equal(
        joined.case.signatures, np.concatenate([places[0].of(MAP), places[1].of(MAP)[:15]])
    )
    np.testing.assert_array_equal(
        joined.case.queries, np.concatenate([places[0].of(QUERY), places[1].of(QUERY)])
    )
    # runs of two places are never one
    assert np.bincount(joined.runs).tolist() == [6, 4, 11, 4]
    assert len(maps.join("all", places).case.signatures) == 60

    path = tmp_path / "grown.npy"
    made = maps.grown(joined, "places", 60, path)
    assert made.name == "joined, extended by places"
    assert made.signatures.shape == (60, 64)
    np.testing.assert_array_equal(made.signatures[:25], joined.case.signatures)
    written = path.stat().st_mtime_ns
    maps.grown(joined, "places", 60, path)
    assert path.stat().st_mtime_ns == written
    with pytest.raises(ValueError, match="Remove it"):
        maps.grown(joined, "places", 61, path)


def test_signed_frames_are_read_as_they_were_written(tmp_path: Path) -> None:
    made = replace(some(5, 2, 4), origins=np.array([-1, -1, -1, 2, -1]))
    write_signed(tmp_path / "model" / "room-000.npz", made)
    found = maps.read_library(tmp_path, "model")
    assert found.recorded is None
    assert len(found.rooms) == 1
    again = read_signed(tmp_path / "model" / "room-000.npz")
    for name in ("signatures", "roles", "runs", "origins"):
        np.testing.assert_array_equal(getattr(again, name), getattr(made, name))


def test_curves_of_a_small_map(tmp_path: Path) -> None:
    signatures = walk(300, 5, 256)
    [found] = curves.measure(signatures, signatures[:4], [300], tmp_path, runs=2, shortlist=200)
    assert found.frames == 300
    assert list(found.milliseconds) == list(curves.TIMES)
    assert min(found.milliseconds.values()) > 0
    assert found.disk > 256
    assert [path.name for path in tmp_path.iterdir()] == ["queries.npy"]


def test_a_map_is_appended_to_by_its_code_and_then_fitted_anew(tmp_path: Path) -> None:
    signatures = walk(300, 6, 64)
    first = curves._published(tmp_path, signatures, 0, 300, None)
    times = curves._appended(tmp_path, signatures, first)
    assert list(times) == ["append 1,000", "refit"]
    found = newest(tmp_path, "bench", 64)
    assert found is not None
    assert len(found) == 300 + 2 * recall.TAIL
    assert found.fitted_on == len(found)
    appended = read_manifest(manifests(tmp_path)[1][1])
    assert appended.code_id == first.code.id != found.code.id
    np.testing.assert_array_equal(found.segments[1].signatures[0], signatures[0])


def test_disk_of_a_frame(room_frames: tuple[Frame, ...], tmp_path: Path) -> None:
    folder = tmp_path / "frames"
    folder.mkdir()
    write_intrinsics(folder, Camera(room_frames[0].intrinsics, 1000.0, along_ray=False))
    for i, frame in enumerate(room_frames):
        write_depth_png(folder / f"{i}.png", frame.depth, 1000.0)
    frames = [f for s in find_sequences(folder) for f in s.frames]
    assert len(frames) == 6
    found = disk.measure(frames, "compact", tmp_path / "data")
    assert (found.frames, found.signature_bytes) == (5, 12_800)
    assert found.uploads == np.mean([frame.path.stat().st_size for frame in frames[1:]])
    assert 12_800 <= found.database < 50_000
    signer = open_signer("compact")
    sizes = [len(write_geometry(prepare(f.read(), signer)[1])) for f in frames[1:]]
    assert found.artifacts == np.mean(sizes)


def figures() -> GrowthFigures:
    of_map = recall.RecallFigures(
        "real", 1000, 12_800, 240, 1.5, 1.25, (1.2, 1.3), {200: (0.995, 0.002), 500: (1.0, 0.0)},
        {200: 0.9, 500: 0.99}, {200: 0.99, 500: 1.0},
    )  # fmt: skip
    points = [
        Point(n, dict.fromkeys(curves.TIMES, n / 1e3), {"held": n / 1e4, "mapped": n / 1e3}, 13e3)
        for n in (1_000, 10_000, 100_000)
    ]
    return GrowthFigures(
        [of_map], {12_800: points}, [disk.DiskFigures(60, 12_800, 14e3, 76e3, 174e3)],
        {12_800: 0.15},
    )  # fmt: skip


def test_a_page_holds_what_was_measured_and_what_is_on_paper(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(f"before\n{BEGIN}\nold\n{END}\nafter\n")
    write_page(figures(), page)
    text = page.read_text()
    assert text.startswith(f"before\n{BEGIN}\n")
    assert text.endswith(f"{END}\nafter\n")
    assert "old" not in text
    for wanted in (
        "| real | 1,000 | 12,800 | 240 | 1.50 | 1.25 (1.20-1.30) | 0.9950 ± 0.0020 | 1.0000 |",
        "| - grown by 1,000 frames at a time | | | | | | 0.9900 | 1.0000 |",
        "| real | 1,000 | 12,800 | 0.900 | 0.990 |",
        "| 10,000 | 10.0 | 10.0 | 10.0 | 10.0 | 10.0 | 1 | 10 | 13,000 |",
        "| *1,000,000* | *1,000* | *1,000* | *1,000* | *1,000* | *1,000* | *100* | | *13,000* |",
        "| 12,800 | 14,000 | 76,000 | 174,000 |",
        "differ by 0.15 (12,800 bytes)",
    ):
        assert wanted in text, wanted
    assert (tmp_path / "growth.png").read_bytes().startswith(b"\x89PNG")
    small = replace(figures(), curves={12_800: figures().curves[12_800][:2]})
    assert "| *1,000,000* |" in "\n".join(table(small))
    assert "| *10,000,000* |" not in "\n".join(table(small))  # a thousand times what was measured
    assert "### Disk" not in "\n".join(table(replace(figures(), disk=[])))


def test_a_map_that_is_compared_whole_has_no_say_in_the_line_of_searches() -> None:
    times = [dict.fromkeys(curves.TIMES, float(n)) for n in range(1, 5)]
    memory = {"held": 1.0, "mapped": 1.0}
    sizes = (SHORTLIST // 2, SHORTLIST, 2 * SHORTLIST, 4 * SHORTLIST)
    points = [
        Point(n, time | {"search": 99.0 if n <= SHORTLIST else 3.0 + n}, memory, 1.0)
        for n, time in zip(sizes, times, strict=True)
    ]
    found = lines_of(points)["search"]
    assert (found.fixed, found.each) == pytest.approx((3.0, 1.0))


def test_maps_that_fit_a_cache_have_no_say_where_larger_ones_were_measured() -> None:
    memory = {"held": 1.0, "mapped": 1.0}
    points = [
        Point(n, dict.fromkeys(curves.TIMES, value), memory, 1.0)
        for n, value in ((1_000, 1.0), (10_000, 110.0), (20_000, 210.0))
    ]
    for name in curves.TIMES:
        found = lines_of(points)[name]
        assert (found.fixed, found.each) == pytest.approx((10.0, 0.01))
    # with one large map alone: all, here through the origin
    ratios = np.array([1_000 / 1.0, 10_000 / 110.0])
    alone = lines_of(points[:2])["open"]
    assert (alone.fixed, alone.each) == pytest.approx((0.0, ratios.sum() / (ratios**2).sum()))
