"""Tests of the baselines: descriptors, and the command."""

import json
from itertools import pairwise

import numpy as np
import pytest

from sceneprint.cli import main
from sceneprint.formats.dataset import find_sequences
from sceneprint.models import save_model
from sceneprint_lab.evaluation.baselines import (
    FpfhVlad,
    features,
    vlad,
)
from sceneprint_lab.evaluation.measures import points_of


def turned(points, sectors):
    """Turned about z by so many of sixty sectors."""
    angle = 2 * np.pi * sectors / 60
    c, s = np.cos(angle), np.sin(angle)
    return points @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T


def test_vlad_by_hand():
    words = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0]])
    local = np.array([[3.0, 0.0], [0.0, 4.0], [10.0, 2.0]], np.float32)
    # the first word is left (3, 4): 0.6, 0.8; the second (0, 2): 0, 1; the third nothing
    expected = np.array([0.6, 0.8, 0.0, 1.0, 0.0, 0.0]) / np.sqrt(2)
    np.testing.assert_allclose(vlad(local, words), expected, atol=1e-7)
    assert not vlad(words.astype(np.float32), words).any()


@pytest.mark.thorough
def test_fpfh_knows_a_cloud_that_was_turned(with_open3d):
    rng = np.random.default_rng(6)
    flat = rng.uniform(0, 2, (6000, 2))
    floor = np.column_stack([flat[:3000], np.zeros(3000)])
    wall = np.column_stack([flat[3000:, 0], np.full(3000, 2.0), flat[3000:, 1]])
    points = np.concatenate([floor, wall]) + np.array([-1.0, 1.0, -1.2])
    own = features(points)
    assert own.shape[1] == 33
    sums = (own.astype(float) ** 2).reshape(len(own), 3, 11).sum(axis=2)
    np.testing.assert_allclose(sums, 1.0, atol=1e-5)  # shares of each histogram
    np.testing.assert_array_equal(features(points), own)
    # words of something else: of a frame's own features they leave nothing but rounding
    stairs = np.concatenate([points + k * np.array([0.3, 0.2, 0.25]) for k in range(3)])
    learnt = [features(stairs[::2] * scale) for scale in (0.5, 0.8)]
    asked, again = FpfhVlad(), FpfhVlad()
    asked.learn(learnt, 2, seed=0)
    again.learn(learnt, 2, seed=0)
    descriptor = asked.finish(own)
    np.testing.assert_array_equal(again.finish(own), descriptor)
    floors = asked.finish(features(floor + np.array([-1.0, 1.0, -1.2])))
    near = asked.finish(features(turned(points, 10)))
    distances = asked.distances(descriptor, np.stack([near, floors]))
    assert distances[0] < 0.5 * distances[1]


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """Twelve views along a path through a synthetic room."""
    out = tmp_path_factory.mktemp("baselines") / "rooms"
    arguments = ["synth", out, "--rooms", 1, "--views", 12, "--seed", 9, "--path", "--jobs", 1]
    assert main([str(a) for a in arguments]) == 0
    return out / "room-000"


@pytest.fixture(scope="module")
def model_file(small_model, tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "small.safetensors"
    save_model(small_model, path)
    return path


def evaluated(folder, *arguments):
    path = folder / "figures.json"
    assert main(["evaluate", *map(str, arguments), "--jobs", "1", "--json", str(path)]) == 0
    return json.loads(path.read_text(), parse_constant=pytest.fail)


@pytest.mark.thorough
def test_baselines_are_rows_of_the_same_table(room, model_file, tmp_path, capsys):
    asked = (room, "--db", "0:12:2", "--queries", "1:12:4", "--model", model_file)
    found = evaluated(tmp_path, *asked, "--baselines", "rings", "thumbnail_l1")
    assert list(found["baselines"]) == ["thumbnail_l1", "rings"]
    row = found["baselines"]["thumbnail_l1"]
    # neighbours on a path look alike: the thumbnail finds one, and it is registered as ours is
    assert row["recall"] == {"queries": 3, "at_1": 1.0, "at_5": 1.0, "at_10": 1.0}
    assert row["within_10cm_10deg"] == 1.0
    assert set(found["R"]) - {"right_scene"} <= set(row)
    assert row["ratio"] > 0
    assert (
        "does not support frames such as room-000/seq-01/frame-000001"
        in (found["baselines"]["rings"]["reason"])
    )
    out = capsys.readouterr().out
    assert "3 queries with a frame that is their place (overlap by half), recall" in out
    assert "not used: it does not support frames" in out
    again = evaluated(tmp_path, *asked, "--baselines", "thumbnail_l1")
    for key in ("milliseconds", "ratio"):
        again["baselines"]["thumbnail_l1"].pop(key)
        row.pop(key)
    assert again["baselines"]["thumbnail_l1"] == row


@pytest.mark.thorough
def test_frames_that_come_back(room, model_file, tmp_path):
    """Every frame asks those before it by more than 20 cm of travel."""
    poses = [np.loadtxt(room / "seq-01" / f"frame-{i:06d}.pose.txt") for i in range(12)]
    steps = [np.linalg.norm(b[:3, 3] - a[:3, 3]) for a, b in pairwise(poses)]
    along = np.concatenate([[0.0], np.cumsum(steps)])
    gap = float(along[11] / 3)
    found = evaluated(
        tmp_path, room, "--gap-m", gap, "--within", 0.5, "--model", model_file, "--candidates", 3
    )
    assert found["counts"] == {"queries": 12, "database": 12, "left_out": 0}
    names = {one["name"]: one["ranking"] for one in found["per_query"]}
    for i in range(12):
        own = names[f"room-000/seq-01/frame-{i:06d}"]
        before = [f"room-000/seq-01/frame-{j:06d}" for j in range(12) if along[i] - along[j] > gap]
        assert set(own) <= set(before)
        assert len(own) == min(3, len(before))
    apart = [
        [np.linalg.norm(poses[i][:3, 3] - poses[j][:3, 3]) for j in range(12)
         if along[i] - along[j] > gap]
        for i in range(12)
    ]  # fmt: skip
    able = [a for a in apart if a and min(a) <= 0.5]
    assert found["recall"]["R"]["queries"] == len(able)
    assert found["recall"]["within_m"] == 0.5
    share = float(np.mean([np.mean(np.array(a) <= 0.5) for a in able])) if able else None
    assert found["recall"]["random"]["at_1"] == pytest.approx(share)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--baselines", "sift"], "no such baseline"),
        (["--gap-m", "-1"], "--gap-m"),
        (["--within", "inf"], "--within"),
    ],
)
def test_wrong_options(room, arguments, message, capsys):
    try:
        code = main(["evaluate", str(room), "--db", "0:4", "--queries", "5:6", *arguments])
    except SystemExit as stopped:
        code = int(stopped.code or 0)
    assert code == 2
    assert message in capsys.readouterr().err


@pytest.mark.thorough
def test_clouds_are_evaluated_as_depth_images_are(room, model_file, tmp_path):
    """Views of the room as files of points: ranked, validated, and beside the ring descriptor."""
    folder = tmp_path / "scans"
    folder.mkdir()
    (sequence,) = find_sequences(room)
    for i, reference in enumerate(sequence.frames[:6]):
        frame = reference.read_depth()
        points = points_of(frame, 3, 9.0).astype("<f4")
        header = (
            f"VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {len(points)}\n"
            f"HEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(points)}\nDATA binary\n"
        )
        (folder / f"scan-{i:03d}.pcd").write_bytes(header.encode() + points.tobytes())
        assert frame.pose is not None
        np.savetxt(folder / f"scan-{i:03d}.pose.txt", frame.pose)
    found = evaluated(
        tmp_path, folder, "--db", "0:6:2", "--queries", "1:6:4", "--within", 1, "--candidates", 2,
        "--model", model_file, "--baselines", "rings", "thumbnail_l1",
    )  # fmt: skip
    assert found["counts"] == {"queries": 2, "database": 3, "left_out": 0}
    assert found["VDR"]["within_10cm_10deg"] == 1.0
    assert found["baselines"]["rings"]["recall"]["queries"] == 2
    assert "does not support" in found["baselines"]["thumbnail_l1"]["reason"]
