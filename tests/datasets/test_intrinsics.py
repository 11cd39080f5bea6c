"""Tests of intrinsics.json: its location, its fields and its errors."""

import json

import pytest

from sceneprint.errors import DatasetError, InvalidIntrinsics
from sceneprint.formats.dataset import Camera, find_camera, read_camera, write_intrinsics
from sceneprint.types import Intrinsics

GOOD = {"width": 640, "height": 480, "fx": 525, "fy": 526.5, "cx": 319.5, "cy": 239}


def write(path, fields):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(fields))
    return path


def test_all_that_may_be_said(tmp_path):
    fields = GOOD | {
        "depth_scale": 5000, "distortion": [0.1, -0.2, 0, 1e-3, 4], "depth_along_ray": True,
        "up": [0, -1, 0.001],
    }  # fmt: skip
    camera = read_camera(write(tmp_path / "intrinsics.json", fields))
    assert camera.intrinsics.distortion == (0.1, -0.2, 0.0, 0.001, 4.0)
    assert (camera.depth_scale, camera.along_ray) == (5000.0, True)
    assert camera.up == (0.0, -1.0, 0.001)


@pytest.mark.parametrize("up", [[0, 0, 9.81], [0, -1], {"x": 0}, [0, "a", 1], 1, [0, 0, True]])
def test_an_up_that_is_no_direction(up, tmp_path):
    path = write(tmp_path / "intrinsics.json", GOOD | {"up": up})
    with pytest.raises(InvalidIntrinsics, match="up is") as caught:
        read_camera(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("k", [(), (0.1, -0.2, 0.3, 1 / 3)])
@pytest.mark.parametrize("along_ray", [True, False])
def test_written_is_read(k, along_ray, tmp_path):
    up = (0.6, -0.8, 0.0) if along_ray else None
    camera = Camera(Intrinsics(64, 48, 52.1, 1 / 3, 0.1, -7.0, k), 1234.5, along_ray, up)
    assert read_camera(write_intrinsics(tmp_path, camera)) == camera
    assert [file.name for file in tmp_path.iterdir()] == ["intrinsics.json"]


def test_the_nearest_wins_up_to_four_folders_above(tmp_path):
    deep = tmp_path / "a/b/c/d"
    deep.mkdir(parents=True)
    write(tmp_path / "intrinsics.json", GOOD | {"width": 1})
    assert find_camera(deep).intrinsics.width == 1
    write(tmp_path / "a/intrinsics.json", GOOD | {"width": 2})
    assert find_camera(deep).intrinsics.width == 2
    write(deep / "intrinsics.json", GOOD | {"width": 3})
    assert find_camera(deep).intrinsics.width == 3
    assert find_camera(deep / "..").intrinsics.width == 2


def test_none_is_found(tmp_path, monkeypatch):
    deep = tmp_path / "a/b/c/d/e"
    deep.mkdir(parents=True)
    write(tmp_path / "intrinsics.json", GOOD)  # five above
    with pytest.raises(DatasetError, match=r"no intrinsics\.json here") as caught:
        find_camera(deep)
    text = str(caught.value)
    example = text[text.index("{") : text.index("}") + 1]
    read_camera(write(tmp_path / "b" / "intrinsics.json", json.loads(example)))  # it can be used


BAD = {
    "no JSON": ("{'width': 640}", "not JSON"),
    "deep": ("[" * 60_000, "not JSON"),
    "missing": (GOOD | {"cy": None}, "cy is None, not a number"),
    "unknown": (GOOD | {"distorsion": []}, "distorsion' is not a field"),
    "bool": (GOOD | {"fx": True}, "fx is True, not a number"),
    "broken size": (GOOD | {"height": 480.5}, "height is 480.5, not a whole"),
    "huge size": (GOOD | {"width": 10**9}, "exceeds the limit"),
    "zero focal length": (GOOD | {"fx": 0}, "focal length fx"),
    "not a number": (json.dumps(GOOD).replace("319.5", "NaN"), "principal point"),
    "beyond Python": (json.dumps(GOOD).replace("640", "9" * 5000), "not JSON"),
    "zero scale": (GOOD | {"depth_scale": 0}, "depth scale 0.0"),
    "three coefficients": (GOOD | {"distortion": [1, 2, 3]}, "3 distortion coefficients"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_files(case, tmp_path):
    content, message = BAD[case]
    path = tmp_path / "intrinsics.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(InvalidIntrinsics, match=message) as caught:
        find_camera(tmp_path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_no_text_and_too_much(tmp_path):
    path = tmp_path / "intrinsics.json"
    path.write_bytes(b"\xff\xfe{")
    with pytest.raises(InvalidIntrinsics, match="not UTF-8 text"):
        read_camera(path)
    path.write_text(" " * 70_000)
    with pytest.raises(InvalidIntrinsics, match="more than 65536 bytes"):
        read_camera(path)
    path.write_text("\ufeff" + json.dumps(GOOD))  # as some editors save it
    assert read_camera(path).intrinsics.fy == 526.5
