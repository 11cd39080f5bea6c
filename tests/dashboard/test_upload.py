"""Tests of uploads on the page against the API."""

import base64
import io
import json

import numpy as np
import pytest
from PIL import Image

from benchmarks.rooms import circled
from sceneprint.decoders.child_process import array_samples, text_samples
from sceneprint.formats.depth_file import encode_npy
from tests.dashboard.conftest import expect

LENS = {"width": 64, "height": 48, "fx": 60.0, "fy": 60.0, "cx": 32.0, "cy": 24.0}


def wall(seed, columns=64, rows=48):
    """A depth image of a wall 2 m away."""
    depth = 2000 + np.random.default_rng(seed).integers(0, 3, (rows, columns))
    buffer = io.BytesIO()
    Image.fromarray(depth.astype(np.uint16)).save(buffer, "PNG")
    return buffer.getvalue()


def room(seed):
    """Points (N, 3) of a corner of a room about the origin, metres."""
    rng = np.random.default_rng(seed)
    plane = rng.uniform(-1.5, 1.5, (3, 1500, 2))
    sides = [np.insert(plane[k], k, (2.0, 2.0, -1.0)[k], axis=1) for k in range(3)]
    return np.concatenate(sides).astype(np.float32)


def named(name, data):
    return {"name": name, "mimeType": "application/octet-stream", "buffer": data}


def row(page, name):
    return page.locator(f".row[data-name='{name}']")


def _states(station, path):
    return {item["state"] for item in station.client.get(path).json()["items"]}


def _count(station, path):
    return len(station.client.get(path).json()["items"])


def open_upload(page, station, name, settle):
    """The upload page of a new map; its file input."""
    station.make_map(name)
    page.goto(f"{station.home}#/maps/{name}/upload")
    settle(page)
    return page.locator("input[name=files]")


def test_the_page_recognises_the_formats_of_the_table(run):
    def kind_of(name, data):
        expression = "m.kindOf(new File([Uint8Array.from(atob(given[1]), (one) => "
        expression += "one.charCodeAt(0))], given[0]))"
        return run("frames/kinds", expression, name, base64.b64encode(data).decode())

    size = {"width": 64, "height": 48}
    pfm = b"Pf\n64 48\n-1\n" + bytes(4 * 64 * 48)
    images = [("png", wall(0)), ("npy", encode_npy(np.ones((48, 64), np.uint16))), ("pfm", pfm)]
    for name, data in images:
        assert kind_of("a", data) == {"kind": "depth", "format": name, **size}
    for data, name in (*array_samples(), *text_samples()):
        file = "a.bin" if name == "kitti" else "a"
        assert kind_of(file, data) == {"kind": "cloud", "format": name}
    assert kind_of("a", b"ASTM-E57") == {"kind": "map", "format": "e57"}
    assert kind_of("a.obj", b"v 0 0 0") == {"kind": "map", "format": "obj"}
    assert kind_of("a", b"PK\3\4")["kind"] == kind_of("a.tar.gz", b"")["kind"] == "archive"
    assert kind_of("a.png", b"")["kind"] == "depth"
    assert kind_of("a.exe", b"MZ") == {"kind": "other"}


@pytest.mark.thorough
def test_files_of_many_kinds_are_sent_with_what_lies_beside_them(page, station, settle, axe, until):
    page.allowed.append("422")
    chooser = open_upload(page, station, "dropped", settle)
    pose = np.eye(4)
    pose[:3, 3] = (1.0, 2.0, 0.5)
    scan = np.column_stack([room(1), np.ones(4500)]).astype(np.float32)
    array = io.BytesIO()
    np.save(array, room(2))
    broken = b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n"
    chooser.set_input_files(
        [
            named("frame-000000.depth.png", wall(0)),
            named("frame-000001.depth.png", wall(1)),
            named("frame-000001.pose.txt", "\n".join(" ".join(map(str, r)) for r in pose).encode()),
            named("intrinsics.json", json.dumps({**LENS, "depth_scale": 500}).encode()),
            named("000000.bin", scan.tobytes()),
            named("cloud.npy", array.getvalue()),
            named("broken.ply", broken),
            named("notes.txt", b"of no kind"),
            named("twice.png", wall(0)),
            named("empty.png", b""),
        ]
    )
    expect(page.get_by_text("1 file was skipped, not a frame: notes.txt")).to_be_visible()
    expect(page.get_by_label("fx")).to_have_value("60")
    start = page.get_by_role("button", name="Upload 7 files")
    start.click()  # a pose leads to a frame that has a name
    expect(page.get_by_role("alert")).to_contain_text("frame-000001.depth.png has a pose")
    expect(page.get_by_label("Session")).to_be_focused()
    page.get_by_label("Robot").fill("r7")
    page.get_by_label("Session").fill("monday")
    page.get_by_label("Tags").fill("door, north")
    assert axe(page) == []
    start.click()
    path = "/v1/maps/dropped/frames"
    settled = {"indexed", "rejected"}
    # the first cloud of a worker may wait for its kernels to be compiled
    until(lambda: _states(station, path) <= settled and _count(station, path) == 4, 180)
    for name in ("frame-000000.depth.png", "frame-000001.depth.png", "twice.png"):
        expect(row(page, name).locator(".badge")).to_have_text("indexed")
    expect(row(page, "empty.png").locator(".row-more")).to_have_text("The file is empty.")
    refusal = station.client.post(
        path, data={"meta": "{}"}, files={"frame": ("broken.ply", broken)}
    ).json()
    expect(row(page, "broken.ply").locator(".badge")).to_have_text("refused")
    expect(row(page, "broken.ply").locator(".row-more")).to_have_text(
        f"{refusal['title']}. {refusal['detail']}"
    )
    frames = {item["bytes"]: item for item in station.client.get(path).json()["items"]}
    posed, plain = frames[len(wall(1))], frames[len(wall(0))]
    assert posed["pose"]["parent_frame"] == "r7/monday"
    assert posed["pose"]["matrix"] == pose.tolist()
    assert plain["pose"] is None
    for frame in frames.values():
        assert (frame["robot"], frame["session"], frame["tags"]) == (
            "r7",
            "monday",
            ["door", "north"],
        )
    assert {n: posed["intrinsics"][n] for n in LENS} == LENS
    assert posed["depth_scale"] == 500
    assert {frame["points"] for frame in frames.values() if frame["kind"] == "cloud"} == {4500}
    link = row(page, "frame-000001.depth.png").get_by_role("link")
    assert link.get_attribute("href") == f"#/maps/dropped/frames/{posed['frame_id']}"
    assert (posed["name"], posed["sequence"]) == ("frame-000001.depth.png", 1)


@pytest.mark.thorough
def test_a_cloud_or_mesh_may_be_a_whole_map(page, station, settle, axe, room_mesh):
    chooser = open_upload(page, station, "whole", settle)
    chooser.set_input_files([named("room.ply", room_mesh), named("room.glb", b"glTF")])
    expect(row(page, "room.ply").locator(".row-about")).to_contain_text("Point cloud")
    expect(row(page, "room.glb").locator(".row-about")).to_contain_text("Whole map")
    page.get_by_role("button", name="Remove room.glb").click()
    page.get_by_role("checkbox", name="Whole map").check()
    expect(row(page, "room.ply").locator(".row-about")).to_contain_text("Whole map")
    page.locator("summary", has_text="Whole maps").click()
    page.locator("select[name=map_up]").select_option("z")
    page.locator("input[name=map_offset]").fill("1,0,-2")
    assert axe(page) == []
    page.get_by_role("button", name="Upload 1 file").click()
    more = row(page, "room.ply").locator(".row-more")
    expect(more).to_contain_text("other views of this file", timeout=300_000)
    [job] = station.client.get("/v1/jobs", params={"kind": "import-map"}).json()["items"]
    result = job["result"]
    assert result["up_from"] == "stated"
    assert result["offset"] == {"x": 1, "y": 0, "z": -2}
    expect(more).to_contain_text(f"{result['views']} views are in the map")
    expect(more).to_contain_text("Offset: 1,0,-2 m")
    expect(more).to_contain_text(f"{result['found']} were found, {result['ambiguous']} ambiguous")
    [frame] = station.client.get("/v1/maps/whole/frames", params={"limit": 1}).json()["items"]
    assert frame["tags"] == ["virtual"]


@pytest.mark.thorough
def test_a_recording_becomes_a_map_with_its_coverage(page, station, settle, axe, ros, tmp_path):
    def fill(writer):
        for i, shot in enumerate(circled(range(0, 360, 60))):
            writer.transforms(20 * i, {("odom", "camera"): np.array(shot.meta["pose"]["matrix"])})
            lens = shot.meta["intrinsics"]
            k = tuple(lens[name] for name in ("fx", "fy", "cx", "cy"))
            writer.camera_info(20 * i, k=k, size=(lens["width"], lens["height"]))
            writer.image(20 * i, 1000 * np.nan_to_num(np.load(io.BytesIO(shot.data))))
            writer.image(20 * i, np.full((48, 64), 2000 + i), topic="/other/image_raw")
            writer.camera_info(20 * i, "/other/camera_info")

    bag = ros.write(tmp_path, fill, "ros1", name="Room 7")
    page.goto(f"{station.home}#/")
    settle(page)
    transfer = page.evaluate_handle(
        """([name, data]) => {
            const transfer = new DataTransfer();
            const bytes = Uint8Array.from(atob(data), (one) => one.charCodeAt(0));
            transfer.items.add(new File([bytes], name));
            return transfer;
        }""",
        [bag.name, base64.b64encode(bag.read_bytes()).decode()],
    )
    page.locator("main").dispatch_event("drop", {"dataTransfer": transfer})
    dialog = page.get_by_role("dialog", name="New map")
    expect(dialog.get_by_label("Name")).to_have_value("room-7")
    expect(dialog.get_by_role("radio", name="Rooms")).to_be_checked()
    dialog.get_by_role("button", name="Create map").click()
    mine = row(page, bag.name)
    expect(mine.locator(".row-more > p").first).to_contain_text("2 topics have frames")
    topics = mine.locator("tbody tr").all_inner_texts()
    assert [topic.split()[0] for topic in topics][:2] == [
        "/camera/depth/image_raw", "/other/image_raw",
    ]  # fmt: skip
    mine.get_by_role("button", name="Import /camera/depth/image_raw").click()
    expect(mine.locator(".row-plan .plan")).to_be_visible()
    expect(mine.locator(".badge")).to_have_text("imported")
    expect(mine.locator(".row-more > p").first).to_have_text("Frames: 6 imported.")
    expect(mine.get_by_role("heading", name="6 of 6 frames queried")).to_be_visible()
    assert axe(page) == []
    about = station.client.get("/v1/maps/room-7").json()
    assert (about["frames"]["indexed"], about["posed_frames"]) == (6, 6)
    mine.get_by_role("link", name="Coverage, cell by cell").click()
    expect(page.get_by_role("heading", name="Coverage of room-7")).to_be_visible()
