"""Tests of metadata edits: changed and unchanged fields, and their visibility."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

import numpy as np
import pytest

from sceneprint.engine.maps.map_lifecycle import edit_frame, edit_map
from sceneprint.errors import FrameConflict, InvalidPose, InvalidRequest, PreconditionFailed
from sceneprint.maintenance.fsck.check import fsck
from sceneprint_client.api import Filter, Frame, Query
from sceneprint_client.api.listing import FrameListing

EDITABLE = ("robot", "session", "captured_at", "tags", "pose", "base_frame", "T_base_sensor")
TURN = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]  # 90 degrees about z


@pytest.fixture
def edit(full):
    """Edit the first frame of `hall`; in the end nothing contradicts."""
    name = full.ids()[0]

    def change(patch, *tags):
        before = full.get_frame("hall", name)
        result = edit_frame(full.store, "hall", name, patch, tags or None)
        assert result == full.get_frame("hall", name)
        rest = {n for n in Frame.model_fields if n not in (*EDITABLE, "etag")}
        assert {n: getattr(result, n) for n in rest} == {n: getattr(before, n) for n in rest}
        same = all(getattr(result, n) == getattr(before, n) for n in EDITABLE)
        assert (result.etag == before.etag) == same
        return result

    yield change
    assert list(fsck(full.settings)) == []


def test_what_is_left_out_stays_and_null_removes(edit):
    at = "2026-11-16T10:30:00.250+01:00"
    one = edit({"robot": "r1", "session": "monday", "captured_at": at, "tags": ["b", "a", "a"]})
    assert (one.robot, one.session, one.tags) == ("r1", "monday", ["b", "a", "a"])
    assert one.captured_at.isoformat() == "2026-11-16T09:30:00.250000+00:00"
    two = edit({"session": None, "tags": ["c"]})
    assert (two.robot, two.session, two.tags) == ("r1", None, ["c"])
    assert two.captured_at == one.captured_at
    three = edit({"robot": None, "captured_at": None, "tags": None})
    assert (three.robot, three.tags, three.captured_at) == (None, [], None)
    assert edit({}) == three


def test_a_pose_by_parts(edit, uploads):
    was = edit({}).pose
    renamed = edit({"pose": {"parent_frame": "building"}}).pose
    assert renamed.matrix == was.matrix  # not a digit has changed
    assert renamed.parent_frame == "building"
    put = edit({"pose": {"translation": {"x": 1, "y": 2, "z": 3}}}).pose
    assert np.array(put.matrix)[:3, 3].tolist() == [1, 2, 3]
    np.testing.assert_allclose(np.array(put.matrix)[:3, :3], uploads[0].pose[:3, :3], atol=1e-12)
    assert put.parent_frame == "building"
    turned = edit({"pose": {"rotation": {"x": 0, "y": 0, "z": 1, "w": 0}}}).pose
    np.testing.assert_allclose(
        turned.matrix, [[-1, 0, 0, 1], [0, -1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], atol=1e-12
    )
    whole = edit({"pose": {"matrix": TURN}}).pose
    assert (whole.matrix, whole.parent_frame) == (TURN, "building")
    assert edit({"pose": None}).pose is None
    result = edit({"session": "s", "robot": "r", "pose": {"matrix": TURN}}).pose
    assert result.parent_frame == "r/s"  # as with an upload
    kept = edit({"session": "t"}).pose
    assert kept.parent_frame == "r/s"  # it stays what it was named then
    again = edit({"pose": {"parent_frame": None}}).pose
    assert (again.parent_frame, again.matrix) == ("r/t", TURN)


def test_where_the_camera_sits(edit, full):
    one = edit({"T_base_sensor": {"matrix": TURN}})
    assert (one.base_frame, one.T_base_sensor.matrix) == ("base_link", TURN)
    two = edit({"T_base_sensor": {"base_frame": "chassis"}})
    assert (two.base_frame, two.T_base_sensor.matrix) == ("chassis", TURN)
    ply = full.outputs.cloud("hall", one.frame_id, "base").make()
    optical = full.outputs.cloud("hall", one.frame_id).make()
    assert b"comment frame chassis\n" in ply
    a, b = (
        np.frombuffer(data.partition(b"end_header\n")[2], "<f4").reshape(-1, 6)
        for data in (optical, ply)
    )
    np.testing.assert_allclose(b[:, :2], np.stack([1 - a[:, 1], 2 + a[:, 0]], 1), atol=1e-5)
    np.testing.assert_allclose(b[:, 3:], np.stack([-a[:, 4], a[:, 3], a[:, 5]], 1), atol=1e-6)
    three = edit({"T_base_sensor": None})
    assert (three.base_frame, three.T_base_sensor) == (None, None)


def test_what_cannot_be_is_refused_and_nothing_changes(full):
    name = full.ids()[0]
    before = full.get_frame("hall", name)
    for patch, text in (
        ({"intrinsics": {}}, "`intrinsics` is part of the identity of the frame"),
        ({"depth_scale": 5000}, "`depth_scale` is part of the identity of the frame"),
        ({"state": "indexed"}, "an unknown field 'state'. Its fields are robot, session"),
        ({"robot": ""}, "robot: "),
        ({"tags": ["a"] * 33}, "tags: "),
        ({"captured_at": "2026-11-16T10:30:00"}, "captured_at: "),
        ({"pose": 5}, "pose: "),
        ({"pose": {"translation": {"x": 1}}}, "pose.translation.y: "),
        ({"pose": {"matrix": TURN, "translation": {"x": 1, "y": 2, "z": 3}}}, "pose: specify "),
        ({"pose": {"nose": 1}}, "pose.nose: "),
        ({"pose": {"parent_frame": None}}, "specify its parent_frame, or the session"),
        ({"T_base_sensor": {"base_frame": "b"}}, "T_base_sensor: specify "),
    ):
        with pytest.raises(InvalidRequest) as result:
            edit_frame(full.store, "hall", name, {"tags": ["x"], **patch})
        assert text in str(result.value)
        assert result.value.fields
    with pytest.raises(InvalidPose):
        edit_frame(full.store, "hall", name, {"pose": {"matrix": np.ones((4, 4)).tolist()}})
    assert full.get_frame("hall", name) == before


def test_lists_and_queries_see_it_at_once(full):
    first, second, *_ = full.ids()
    box = {"parent_frame": "p", "min": {"x": 6, "y": 6, "z": 6}, "max": {"x": 8, "y": 8, "z": 8}}
    tagged = Query(stages=("retrieve",), filter=Filter(tags=["seen"]))
    inside = Query.model_validate({"stages": ["retrieve"], "filter": {"region": box}})

    def frame_lists():
        answers = (full.query_frame("hall", second, query) for query in (tagged, inside))
        return [[match.frame_id for match in answer.matches] for answer in answers]

    assert frame_lists() == [[], []]
    edit_frame(full.store, "hall", first, {"tags": ["seen"], "pose": {"parent_frame": "p"}})
    assert frame_lists() == [[first], []]
    for wanted in (FrameListing(tag=["seen"]), FrameListing(parent_frame="p")):
        assert [f.frame_id for f in full.list_frames("hall", wanted=wanted).items] == [first]
    edit_frame(full.store, "hall", first, {"pose": {"translation": {"x": 7, "y": 7, "z": 7}}})
    assert frame_lists() == [[first], [first]]
    edit_frame(full.store, "hall", first, {"pose": None, "tags": []})
    assert frame_lists() == [[], []]


def test_events_tell_what_was_edited(full):
    name = full.ids()[0]
    edit_frame(full.store, "hall", name, {"robot": "r", "tags": []})  # it had no tags
    edit_frame(full.store, "hall", name, {"robot": "r"})
    edit_map(full.store, "hall", {"title": "The hall"})
    edit_map(full.store, "hall", {"title": "The hall"})
    actual = full.events.page(full.events.wanted("hall", ["frame.edited", "map.edited"])).items
    assert [(item.kind, item.frame_id, item.data) for item in actual] == [
        ("frame.edited", name, {"fields": ["robot"]}),
        ("map.edited", None, {"fields": ["title"]}),
    ]


def test_an_upload_is_compared_with_what_it_is_by_now(full, uploads):
    one, name = uploads[0], full.ids()[0]
    edit_frame(full.store, "hall", name, {"robot": "r1"})
    with pytest.raises(FrameConflict, match="a different robot"):
        full.add(one)
    now = one.meta.model_copy(update={"robot": "r1"})
    added, new = full.add_frame("hall", one.data, now)
    assert (added.frame_id, new) == (name, False)


def test_of_many_who_read_the_same_one_edits(full):
    name = full.ids()[0]
    tag = full.get_frame("hall", name).etag

    def one(i):
        with suppress(PreconditionFailed):
            edit_frame(full.store, "hall", name, {"robot": f"r{i}"}, [tag])
            return True
        return False

    with ThreadPoolExecutor(8) as pool:
        won = list(pool.map(one, range(8)))
    assert won.count(True) == 1
    now = full.get_frame("hall", name)
    assert now.robot == f"r{won.index(True)}"
    with pytest.raises(PreconditionFailed, match="was edited after you read it") as result:
        edit_frame(full.store, "hall", name, {"robot": None}, [tag])
    assert f'"{now.etag}"' in str(result.value)
    edit_frame(full.store, "hall", name, {"robot": None})
    assert edit_frame(full.store, "hall", name, {"robot": "x"}, ["other", tag]).robot == "x"


def test_a_map_has_a_title(full):
    before = full.get_map("hall")
    edited = edit_map(full.store, "hall", {"title": "Küche"}, [before.etag])
    assert (edited.title, edited) == ("Küche", full.get_map("hall"))
    with pytest.raises(PreconditionFailed, match="Map 'hall' was edited"):
        edit_map(full.store, "hall", {"title": None}, [before.etag])
    assert edit_map(full.store, "hall", {"title": None}).title is None
