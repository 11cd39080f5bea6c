"""Tests of downloads from a map, and of names and order of its frames."""

import base64
import io
from datetime import UTC, datetime
from functools import partial

import numpy as np
import pytest

from sceneprint.engine.maps.map_frames import (
    BYTES,
    NPY,
    list_frames,
    list_sessions,
    trajectory,
    trajectory_file,
    upload_type,
)
from sceneprint.engine.maps.map_lifecycle import edit_frame
from sceneprint.errors import (
    InvalidRequest,
    NotIndexed,
    PreconditionFailed,
    UnknownFrame,
    UnknownMap,
)
from sceneprint.formats.dataset import read_trajectory
from sceneprint.signing import describe
from sceneprint_client.api import FrameMeta, FrameState
from sceneprint_client.api.listing import FrameListing, Run
from sceneprint_client.poses import rotation_of


def rows(ply):
    head, _, body = ply.partition(b"end_header\n")
    lines = [line.split(" ") for line in head.decode().splitlines()]
    count = next(int(line[2]) for line in lines if line[:2] == ["element", "vertex"])
    result = {line[1]: " ".join(line[2:]) for line in lines if line[0] == "comment"}
    return result, np.frombuffer(body, "<f4").reshape(count, 6)


def test_a_cloud_is_the_surface_of_the_artifact(full, uploads, prepared):
    name, surface, T = full.ids()[7], prepared[7][1].surface, uploads[7].pose
    result, actual = rows(full.outputs.cloud("hall", name).make())
    assert result["frame"] == f"{name}.optical"
    assert np.array_equal(actual[:, :3], surface.points[surface.valid])
    assert np.array_equal(actual[:, 3:], surface.normals[surface.valid])
    result, actual = rows(full.outputs.cloud("hall", name, "parent").make())
    assert result["frame"] == uploads[7].room
    at = surface.points[surface.valid].astype(float) @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(actual[:, :3], at, atol=1e-5)
    turned = surface.normals[surface.valid].astype(float) @ T[:3, :3].T
    np.testing.assert_allclose(actual[:, 3:], turned, atol=1e-6)


def test_patches_are_those_that_were_signed(full, uploads, prepared, signer):
    result = full.outputs.patches("hall", full.ids()[3]).make()
    signature, geometry = prepared[3]
    levels = describe(uploads[3].frame, signer.model.parameters).levels
    sizes = [len(level.mean) for level in result.levels]
    assert tuple(sizes[level] for level in signer.model.levels) == signature.n_patches
    assert result.frame == f"{full.ids()[3]}.optical"
    for one, level in zip(
        (*result.levels, result.validation), (*levels, geometry.patches), strict=True
    ):
        np.testing.assert_allclose(one.mean, level.means, atol=5.1e-5)
        np.testing.assert_allclose(one.normal, level.normals, atol=5.1e-5)
        np.testing.assert_allclose(one.area_m2, level.areas, atol=5.1e-6)
        assert one.size == level.sizes.tolist()


def test_a_signature_is_that_of_the_library(full, prepared):
    name, psi = full.ids()[2], prepared[2][0]
    result = full.outputs.signature("hall", name).make()
    assert np.array_equal(np.frombuffer(base64.b64decode(result.base64), np.uint8), psi.vector)
    assert (result.model_id, result.length, result.dtype) == (
        psi.model_id,
        len(psi.vector),
        "uint8",
    )
    assert tuple(result.n_patches) == psi.n_patches
    assert tuple(result.n_pairs) == psi.n_pairs
    assert full.outputs.vector("hall", name, BYTES).make() == psi.vector.tobytes()
    read = np.load(io.BytesIO(full.outputs.vector("hall", name, NPY).make()), allow_pickle=False)
    assert np.array_equal(read, psi.vector)
    assert read.dtype == np.uint8


def test_an_upload_is_had_back_as_it_came(full, uploads):
    for name, sent in zip(full.ids(), uploads, strict=True):
        assert full.outputs.upload("hall", name).make() == sent.data
    assert upload_type(uploads[0].data) == ("image/png", ".png")
    buffer = io.BytesIO()
    np.save(buffer, uploads[0].frame.depth)
    assert upload_type(buffer.getvalue()) == ("application/x-npy", ".npy")


def made_outputs(engine, name):
    """Return functions that find what is made of a frame."""
    o = engine.outputs
    return [partial(find, "hall", name) for find in (o.cloud, o.preview, o.patches, o.signature)]


def test_what_is_not_there_is_said(empty, uploads):
    waiting, _ = empty.add(uploads[0])
    for find in made_outputs(empty, waiting.frame_id):
        with pytest.raises(NotIndexed, match="is received: The frame is stored durably"):
            find()
    assert empty.outputs.upload("hall", waiting.frame_id).make() == uploads[0].data
    bare = FrameMeta(intrinsics=uploads[1].meta.intrinsics)
    posed, _ = empty.add_frame("hall", uploads[1].data, bare)
    empty.work_off()
    for within, lacks in (("parent", "has no pose"), ("base", "has no T_base_sensor")):
        with pytest.raises(InvalidRequest, match=lacks) as result:
            empty.outputs.cloud("hall", posed.frame_id, within)
        assert result.value.fields[0][0] == "frame"
    empty.delete_frame("hall", waiting.frame_id)
    for name, why in ((waiting.frame_id, "was deleted"), ("nobody", "no frame 'nobody'")):
        for find in (*made_outputs(empty, name), partial(empty.outputs.upload, "hall", name)):
            with pytest.raises(UnknownFrame, match=why):
                find()


def test_a_trajectory_is_read_back(full, uploads, tmp_path):
    names = full.ids()
    for i, name in enumerate(names[:6]):
        at = None if i == 5 else f"2026-11-16T09:30:{20 - max(i, 1):02}.125Z"
        edit_frame(full.store, "hall", name, {"session": "s", "captured_at": at})
    result = trajectory(full.store, "hall", Run(session="s"))
    assert result.frame_ids == [names[i] for i in (4, 3, 2, 0)]
    assert (result.parent_frame, result.robot, result.left_out) == (uploads[0].room, None, 2)
    (tmp_path / "a.tum").write_text(trajectory_file(result))
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


def test_pages_of_sessions(empty, uploads):
    for i, upload in enumerate(uploads[:5]):
        meta = upload.meta.model_copy(update={"session": f"s{i}" if i else None})
        empty.add_frame("hall", upload.data, meta)
    page = list_sessions(empty.store, "hall", None, 2)
    rest = list_sessions(empty.store, "hall", page.next_cursor, 9)
    actual = [*page.items, *rest.items]
    assert (len(page.items), rest.next_cursor) == (2, None)
    assert [item.session for item in actual] == [None, "s1", "s2", "s3", "s4"]
    assert [item.parent_frames for item in actual] == [["room-000"]] * 5
    assert [item.frames for item in actual] == [{"received": 1}] * 5
    lone = base64.urlsafe_b64encode(b'["\\ud800", ""]').decode()
    for bad in ("0", "%", "W10", "WzEsIDJd", "[" * 2000, lone, "é"):
        with pytest.raises(InvalidRequest, match="is not valid"):
            list_sessions(empty.store, "hall", bad, 2)
    with pytest.raises(UnknownMap):
        list_sessions(empty.store, "nowhere", None, 2)


def listed(engine, map_name="hall", **wanted):
    names, cursor = [], None
    while True:
        request = FrameListing.model_validate(wanted)
        page = list_frames(engine.store, map_name, request, cursor, 3)
        names += [item.name for item in page.items]
        cursor = page.next_cursor
        if cursor is None:
            return names


def send(engine, upload, **more):
    fields = upload.meta.model_dump() | more
    added, new = engine.add_frame("hall", upload.data, FrameMeta.model_validate(fields))
    return added.frame_id, new


def test_names_are_labels_and_tell_no_uploads_apart(empty, uploads):
    frame, new = send(empty, uploads[0], session="s", name="a.png", sequence=3)
    assert new
    assert send(empty, uploads[0], session="s", name="b.png", sequence=4) == (frame, False)
    result = empty.get_frame("hall", frame)
    assert (result.name, result.sequence) == ("a.png", 3)
    tag = result.etag
    now = edit_frame(empty.store, "hall", frame, {"name": "c/d.png", "sequence": 0}, [str(tag)])
    assert (now.name, now.sequence) == ("c/d.png", 0)
    with pytest.raises(PreconditionFailed):
        edit_frame(empty.store, "hall", frame, {"name": "e"}, [str(tag)])
    edit_frame(empty.store, "hall", frame, {"name": None, "sequence": None})
    result = empty.get_frame("hall", frame)
    assert (result.name, result.sequence) == (None, None)


def test_what_is_deleted_is_forgotten_and_pages_go_on_after_it(empty, uploads):
    order = (4, 1, None, 3, 0, None)
    for i, (upload, place) in enumerate(zip(uploads, order, strict=False)):
        at = datetime.fromtimestamp(1.7e9 - i, UTC) if i < 2 else None
        send(empty, upload, session="s", name=f"{i}", sequence=place, captured_at=at)
    taken = ["1", "0", "4", "3", "2", "5"]
    assert listed(empty, session="s", order="taken") == taken
    wanted = FrameListing(session=["s"], order="taken")
    page = list_frames(empty.store, "hall", wanted, None, 2)
    empty.delete_frame("hall", page.items[-1].frame_id)
    gone = empty.list_frames("hall", state=FrameState.DELETED).items[0]
    assert (gone.name, gone.sequence, gone.captured_at) == (None, None, None)
    rest = list_frames(empty.store, "hall", wanted, page.next_cursor, 9)
    assert [item.name for item in rest.items] == taken[2:]
    cursor = str(page.next_cursor)
    sealed = cursor.partition("~")[0]
    for bad in (sealed, f"{sealed}~", f"{sealed}~x", f"{sealed}~W251bGwsIC0xXQ", cursor[1:]):
        with pytest.raises(InvalidRequest, match="is not valid"):
            list_frames(empty.store, "hall", wanted, bad, 9)


def test_frames_without_a_stamp_are_left_out_of_a_trajectory(empty, uploads):
    def count(**run):
        run = Run.model_validate({"session": "s"} | run)
        return len(trajectory(empty.store, "hall", run).poses)

    send(empty, uploads[0], session="s", pose=None)
    send(empty, uploads[1], session="s")
    assert (count(), count(clock="received")) == (0, 1)
    send(empty, uploads[2], session="s", sequence=7)
    send(empty, uploads[3], session="s", sequence=8, captured_at=datetime(2026, 1, 1, tzinfo=UTC))
    assert (count(), count(clock="sequence")) == (1, 2)
