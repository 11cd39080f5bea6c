"""Tests of downloads from a map against the library's results."""

import base64
import io

import numpy as np
import pytest
from PIL import Image

from sceneprint.engine.maps.map_frames import (
    BYTES,
    NPY,
    find_indexed,
    list_sessions,
    trajectory,
    trajectory_file,
    upload_type,
)
from sceneprint.engine.maps.map_lifecycle import edit_frame
from sceneprint.errors import InvalidRequest, NotIndexed, UnknownFrame, UnknownMap
from sceneprint.formats.dataset import read_trajectory
from sceneprint.pictures import depth_view, normals_view, picture
from sceneprint.signing import describe
from sceneprint.store.maps import find_frame, find_map
from sceneprint_client.api import FrameMeta, NewMap
from sceneprint_client.api.listing import Run
from sceneprint_client.poses import rotation_of


def rows(ply):
    """Comments by their first word, and a row x y z nx ny nz for each point."""
    head, _, body = ply.partition(b"end_header\n")
    lines = [line.split(" ") for line in head.decode().splitlines()]
    count = next(int(line[2]) for line in lines if line[:2] == ["element", "vertex"])
    told = {line[1]: " ".join(line[2:]) for line in lines if line[0] == "comment"}
    return told, np.frombuffer(body, "<f4").reshape(count, 6)


def test_a_cloud_is_the_surface_of_the_artifact(full, ids, uploads, prepared):
    for i in (0, 7):
        name, surface = ids(full)[i], prepared[i][1].surface
        told, found = rows(full.outputs.cloud("hall", name).make())
        assert told["frame"] == f"{name}.optical"
        assert np.array_equal(found[:, :3], surface.points[surface.valid])
        assert np.array_equal(found[:, 3:], surface.normals[surface.valid])
        told, found = rows(full.outputs.cloud("hall", name, "parent").make())
        T = uploads[i].pose
        assert told["frame"] == uploads[i].room
        at = surface.points[surface.valid].astype(float) @ T[:3, :3].T + T[:3, 3]
        np.testing.assert_allclose(found[:, :3], at, atol=1e-5)
        turned = surface.normals[surface.valid].astype(float) @ T[:3, :3].T
        np.testing.assert_allclose(found[:, 3:], turned, atol=1e-6)


def test_a_preview_is_that_of_the_artifact(full, ids, uploads, prepared, signer):
    name, surface = ids(full)[0], prepared[0][1].surface
    views = {"depth": depth_view, "normals": normals_view}
    for view, make in views.items():
        data = full.outputs.preview("hall", name, view, 160).make()
        colours, _ = make(surface)
        with Image.open(io.BytesIO(data)) as image:
            assert np.array_equal(np.asarray(image), colours)
            assert image.text["frame"] == f"{name}.optical"
        assert len(data) < 3 * len(picture(colours, 160, {}))
    data = full.outputs.preview("hall", name, "patches", 640).make()
    with Image.open(io.BytesIO(data)) as image:
        assert image.size[0] == 640
        own = len(describe(uploads[0].frame, signer.model.parameters).levels[0].means)
        assert image.text["patches"] == str(own)
        assert len(np.unique(np.asarray(image).reshape(-1, 3), axis=0)) in (own, own + 1)


def test_patches_are_those_that_were_signed(full, ids, uploads, prepared, signer):
    told = full.outputs.patches("hall", ids(full)[3]).make()
    signature, geometry = prepared[3]
    levels = describe(uploads[3].frame, signer.model.parameters).levels
    sizes = [len(one.mean) for one in told.levels]
    assert tuple(sizes[level] for level in signer.model.levels) == signature.n_patches
    assert told.frame == f"{ids(full)[3]}.optical"
    for one, level in zip(
        (*told.levels, told.validation), (*levels, geometry.patches), strict=True
    ):
        np.testing.assert_allclose(one.mean, level.means, atol=5.1e-5)
        np.testing.assert_allclose(one.normal, level.normals, atol=5.1e-5)
        np.testing.assert_allclose(one.area_m2, level.areas, atol=5.1e-6)
        assert one.size == level.sizes.tolist()


def test_a_signature_is_that_of_the_library(full, ids, prepared):
    name, made = ids(full)[2], prepared[2][0]
    told = full.outputs.signature("hall", name).make()
    assert np.array_equal(np.frombuffer(base64.b64decode(told.base64), np.uint8), made.vector)
    assert (told.model_id, told.length, told.dtype) == (made.model_id, len(made.vector), "uint8")
    assert tuple(told.n_patches) == made.n_patches
    assert tuple(told.n_pairs) == made.n_pairs
    assert full.outputs.vector("hall", name, BYTES).make() == made.vector.tobytes()
    read = np.load(io.BytesIO(full.outputs.vector("hall", name, NPY).make()), allow_pickle=False)
    assert np.array_equal(read, made.vector)
    assert read.dtype == np.uint8


def test_an_upload_is_had_back_as_it_came(full, ids, uploads):
    for name, sent in zip(ids(full), uploads, strict=True):
        assert full.outputs.upload("hall", name).make() == sent.data
    assert upload_type(uploads[0].data) == ("image/png", ".png")
    buffer = io.BytesIO()
    np.save(buffer, uploads[0].frame.depth)
    assert upload_type(buffer.getvalue()) == ("application/x-npy", ".npy")


def every_output(engine, name):
    o = engine.outputs
    return {
        "optical": lambda: o.cloud("hall", name), "parent": lambda: o.cloud("hall", name, "parent"),
        "depth": lambda: o.preview("hall", name),
        "small": lambda: o.preview("hall", name, "depth", 64),
        "normals": lambda: o.preview("hall", name, "normals"),
        "patches": lambda: o.preview("hall", name, "patches"),
        "lists": lambda: o.patches("hall", name), "signature": lambda: o.signature("hall", name),
        "bytes": lambda: o.vector("hall", name, BYTES), "npy": lambda: o.vector("hall", name, NPY),
        "upload": lambda: o.upload("hall", name),
    }  # fmt: skip


def test_a_tag_stands_for_one_content(full, ids):
    first, second, *_ = ids(full)
    tags = {name: find().tag for name, find in every_output(full, first).items()}
    assert tags == {name: find().tag for name, find in every_output(full, first).items()}
    others = [find().tag for find in every_output(full, second).values()]
    assert len({*tags.values(), *others}) == 2 * len(tags)
    edit_frame(full.store, "hall", first, {"tags": ["seen"]})
    assert tags == {name: find().tag for name, find in every_output(full, first).items()}
    edit_frame(full.store, "hall", first, {"pose": {"parent_frame": "elsewhere"}})
    now = {name: find().tag for name, find in every_output(full, first).items()}
    assert {name for name, tag in tags.items() if tag != now[name]} == {"parent"}
    told, _ = rows(full.outputs.cloud("hall", first, "parent").make())
    assert told["frame"] == "elsewhere"


def test_what_is_not_there_is_said(empty, uploads, work_off):
    waiting, _ = empty.add_frame("hall", uploads[0].data, uploads[0].meta)
    for name, find in every_output(empty, waiting.frame_id).items():
        if name != "upload":
            with pytest.raises(NotIndexed, match="is received: The frame is stored durably"):
                find()
    assert empty.outputs.upload("hall", waiting.frame_id).make() == uploads[0].data
    bare = FrameMeta(intrinsics=uploads[1].meta.intrinsics)
    posed, _ = empty.add_frame("hall", uploads[1].data, bare)
    work_off(empty)
    for within, lacks in (("parent", "has no pose"), ("base", "has no T_base_sensor")):
        with pytest.raises(InvalidRequest, match=lacks) as told:
            empty.outputs.cloud("hall", posed.frame_id, within)
        assert told.value.fields[0][0] == "frame"
    empty.delete_frame("hall", waiting.frame_id)
    for find in every_output(empty, waiting.frame_id).values():
        with pytest.raises(UnknownFrame, match="was deleted"):
            find()
    for find in every_output(empty, "nobody").values():
        with pytest.raises(UnknownFrame, match="no frame 'nobody'"):
            find()
    with pytest.raises(UnknownMap):
        empty.outputs.upload("nowhere", posed.frame_id)


def test_a_redundant_frame_has_no_upload(full, uploads, work_off):
    depth = uploads[0].frame.depth.copy()
    depth[200:208, 300:308] = 0  # another content of the same place
    buffer = io.BytesIO()
    np.save(buffer, depth)
    added, _ = full.add_frame("hall", buffer.getvalue(), uploads[0].meta, if_novel=1.0)
    work_off(full)
    assert full.get_frame("hall", added.frame_id).state == "redundant"
    for find in every_output(full, added.frame_id).values():
        with pytest.raises(NotIndexed, match="is redundant"):
            find()


def test_a_lost_artifact_is_made_again(full, ids, work_off):
    name = ids(full)[4]
    before = full.outputs.cloud("hall", name).make()
    with full.store.database.read() as connection:
        frame = find_frame(connection, find_map(connection, "hall"), name)
    found = find_indexed(full.store, "hall", name)
    full.store.blobs.path(found.artifact).unlink()
    assert full.outputs.cloud("hall", name).make() == before
    assert frame.state == "indexed"
    assert work_off(full) == ["succeeded"]
    assert full.outputs.cloud("hall", name).make() == before


def test_a_trajectory_is_read_back(full, ids, uploads, tmp_path):
    """Times given by PATCH, backwards; two frames have one, one has none."""
    names = ids(full)
    for i, name in enumerate(names[:6]):
        at = None if i == 5 else f"2026-11-16T09:30:{20 - max(i, 1):02}.125Z"
        edit_frame(full.store, "hall", name, {"session": "s", "captured_at": at})
    told = trajectory(full.store, "hall", Run(session="s"))
    assert told.frame_ids == [names[i] for i in (4, 3, 2, 0)]
    assert (told.parent_frame, told.robot, told.left_out) == (uploads[0].room, None, 2)
    (tmp_path / "a.tum").write_text(trajectory_file(told))
    read = read_trajectory(tmp_path / "a.tum")
    assert np.diff(read.stamps).tolist() == [1.0, 1.0, 1.0]
    for i, place, q in zip((4, 3, 2, 0), read.positions, read.quaternions, strict=True):
        assert place.tolist() == uploads[i].pose[:3, 3].tolist()
        np.testing.assert_allclose(rotation_of(q), uploads[i].pose[:3, :3], atol=1e-12)
    assert trajectory(full.store, "hall", Run(session="nobody")).poses == []
    edit_frame(full.store, "hall", names[0], {"robot": "r1"})
    with pytest.raises(InvalidRequest, match=r"2 values of `robot` \(none, 'r1'\)"):
        trajectory(full.store, "hall", Run(session="s"))
    assert trajectory(full.store, "hall", Run(session="s", robot="r1")).frame_ids == names[:1]
    edit_frame(full.store, "hall", names[0], {"robot": None, "pose": {"parent_frame": "p"}})
    with pytest.raises(InvalidRequest, match=r"2 values of `parent_frame` \('p', 'room-000'\)"):
        trajectory(full.store, "hall", Run(session="s"))
    assert trajectory(full.store, "hall", Run(session="s", parent_frame="p")).frame_ids == names[:1]


def test_a_session_too_long_is_asked_for_in_parts(full, ids, monkeypatch):
    from sceneprint.engine.maps import map_frames

    for i, name in enumerate(ids(full)[:3]):
        at = f"2026-11-16T09:30:0{i}Z"
        edit_frame(full.store, "hall", name, {"session": "s", "captured_at": at})
    monkeypatch.setattr(map_frames, "MOST_POSES", 2)
    with pytest.raises(InvalidRequest, match="has 3 frames, but a trajectory has at most 2"):
        trajectory(full.store, "hall", Run(session="s"))
    part = Run.model_validate({"session": "s", "captured_after": "2026-11-16T09:30:01Z"})
    assert trajectory(full.store, "hall", part).frame_ids == ids(full)[1:3]


def test_pages_of_sessions(empty, uploads):
    for i, one in enumerate(uploads[:5]):
        meta = one.meta.model_copy(update={"session": f"s{i}" if i else None})
        empty.add_frame("hall", one.data, meta)
    found, cursor = [], None
    for _ in range(3):
        page = list_sessions(empty.store, "hall", cursor, 2)
        found += page.items
        cursor = page.next_cursor
    assert cursor is None
    assert [one.session for one in found] == [None, "s1", "s2", "s3", "s4"]
    assert [one.parent_frames for one in found] == [["room-000"]] * 5
    assert [one.frames for one in found] == [{"received": 1}] * 5
    lone = base64.urlsafe_b64encode(b'["\\ud800", ""]').decode()
    for bad in ("0", "%", "W10", "WzEsIDJd", "[" * 2000, lone, "é"):
        with pytest.raises(InvalidRequest, match="is not valid"):
            list_sessions(empty.store, "hall", bad, 2)
    with pytest.raises(UnknownMap):
        list_sessions(empty.store, "nowhere", None, 2)
    empty.create_map(NewMap(name="new", model="depth"))
    assert list_sessions(empty.store, "new", None, 2).items == []
