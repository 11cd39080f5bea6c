"""Tests of associations of two runs with separate origins, and of their differences."""

import json
import re
import shutil
from dataclasses import asdict, replace
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from sqlalchemy import update

from sceneprint.engine.products import associations
from sceneprint.engine.products.edge_consensus import finish_association
from sceneprint.engine.products.session_differences import POINTS
from sceneprint.engine.upkeep.housekeeping import Housekeeping
from sceneprint.errors import InvalidRequest, NotIndexed
from sceneprint.geometry.rigid import inverse, pose_difference, transform_points
from sceneprint.settings import Settings
from sceneprint.store.frame_queries import PathFrame
from sceneprint.store.parent_joins import ParentJoin, join_parent, posed_runs
from sceneprint.store.tables import frames, jobs
from sceneprint_client.api import Filter, JobState, NewMap
from sceneprint_client.api.sessions import GONE, NEW, NewAssociation, NewDifference
from sceneprint_client.surface_encoding import decode_points
from sceneprint_lab.synth.lookalikes import synthesise_lookalike
from tests.whole_engine import Engine

BEGIN = datetime(2026, 1, 1, tzinfo=UTC)


def origin(seed):
    rng = np.random.default_rng(seed)
    u, _, vt = np.linalg.svd(rng.normal(size=(3, 3)))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt, rng.normal(0, 4, 3)
    return T


#: Where the parent frames of both robots are in the room.
ORIGINS = {"ann/a": origin(1), "bob/b": origin(2)}


@pytest.fixture(scope="session")
def two_runs(tmp_path_factory, make_upload, room_views):
    """A map `hall`: even frames of a path are ann's run a, odd ones bob's run b."""
    folder = tmp_path_factory.mktemp("runs") / "data"
    room = room_views(21, 0, 12, along_path=True)
    with Engine(Settings(data_dir=folder)) as engine:
        engine.create_map(NewMap(name="hall", model="depth"))
        for i, frame in enumerate(room.frames):
            robot, session = (("ann", "a"), ("bob", "b"))[i % 2]
            pose = inverse(ORIGINS[f"{robot}/{session}"]) @ frame.pose
            upload = make_upload(
                frame, room.name, robot=robot, session=session, pose={"matrix": pose.tolist()},
                captured_at=BEGIN + timedelta(seconds=i),
            )  # fmt: skip
            engine.add(upload)
        assert set(engine.work_off()) == {JobState.SUCCEEDED}
    return folder


@pytest.fixture
def engine(two_runs, tmp_path, make_engine):
    shutil.copytree(two_runs, tmp_path / "data")
    return make_engine()


def done(engine, **body):
    begun = engine.associations.begin("hall", NewAssociation.model_validate(body))
    assert begun.state is JobState.QUEUED
    engine.work_off()
    return engine.associations.get("hall", begun.job_id)


def test_two_robots_maps_are_joined(engine):
    record = done(engine, sessions=["a", "b"])
    assert record.state is JobState.SUCCEEDED
    assert (record.progress.done, record.progress.total) == (6, 6)
    result = record.result
    assert result.frames == 6
    assert result.edges >= 12
    assert (result.consistent, result.inconsistent, result.unchecked) == (result.edges, 0, 0)
    (join,) = result.joins
    assert (join.from_parent, join.to_parent) == ("ann/a", "bob/b")
    assert (join.support, join.votes) == (result.edges, result.edges)
    assert join.strength == "weak"  # ten edges of either run and more, of a few centimetres
    assert join.root is None
    with engine.store.database.read() as connection:
        assert {run.parent for run in posed_runs(connection, 1)} == {"ann/a", "bob/b"}
    assert "all within 0.0" in join.reason
    between = (join.transform.parent_frame, join.transform.child_frame)
    assert between == ("bob/b", "ann/a")
    # x_b = T_b_room T_room_a x_a
    T, true = np.array(join.transform.matrix), inverse(ORIGINS["bob/b"]) @ ORIGINS["ann/a"]
    for edge in engine.associations.edges("hall", record.job_id).items:
        here = pose_of(engine, edge.from_frame)
        assert pose_difference(T @ here, true @ here)[0] < 0.02
    assert pose_difference(T, true)[1] < np.radians(0.5)
    (event,) = engine.events.page(engine.events.wanted("hall", ["association.found"])).items
    assert event.data["edges"] == result.edges


def test_sessions_of_rooms_that_look_alike_are_not_strongly_joined(empty, make_upload):
    site = synthesise_lookalike("unmapped", 41, 8, queries=20)  # the queries show another room
    for session, views in (("a", site.map), ("b", site.queries)):
        for frame in views:
            sent = make_upload(frame, session, robot=session, session=session)
            empty.add(sent)
    empty.work_off()
    begun = empty.associations.begin("hall", NewAssociation(sessions=["b", "a"]))
    empty.work_off()
    (join,) = empty.associations.get("hall", begun.job_id).result.joins
    assert join.support >= 10  # enough for a strong join
    assert (join.strength, join.root) == ("weak", None)
    share = int(re.search(r"but (\d+)% of the surfaces contradict", join.reason)[1])
    assert 15 <= share <= 45


def test_parent_frames_are_associated_unasked(engine):
    def look(*, auto=True):
        before = {job.job_id for job in engine.associations.list_all("hall").items}
        joins = {"join_sessions": "auto" if auto else "on_request"}
        settings = engine.settings.model_copy(update=joins)
        Housekeeping(replace(engine.context, settings=settings)).run()
        after = engine.associations.list_all("hall").items
        return [one.request for one in after if one.job_id not in before]

    assert look(auto=False) == []
    assert look() == [NewAssociation(sessions=["b", "a"], robots=["bob", "ann"])]
    assert look() == []  # it is queued
    engine.work_off()
    assert look() == []  # the two sessions have not grown
    sides = {"source": [1, 2, 3, 4], "target": [5, 6, 7, 8, 9]}
    of_kind = jobs.c.kind == associations.Associations.kind  # 9 frames, and 12 are a quarter more
    engine.write(update(jobs).where(of_kind).values(progress=sides))
    (request,) = look()
    assert request.sessions == ["b", "a"]
    # but never again once it was undone, whatever the sessions have become
    engine.work_off()
    begun = engine.associations.list_all("hall").items[0].job_id
    with engine.store.database.write() as connection:
        assert join_parent(connection, 1, ParentJoin("bob/b", "ann/a", np.eye(4)), begun)
    undone = engine.associations.undo_join("hall", begun)
    assert undone.state is JobState.SUCCEEDED
    engine.associations.remove("hall", begun)
    engine.write(update(jobs).where(of_kind).values(progress=sides))
    assert look() == []


def pose_of(engine, frame_id):
    pose = engine.get_frame("hall", frame_id).pose
    return np.array(pose.matrix)


def test_a_slice_that_is_done_again_finds_the_same_edges(engine):
    engine.associations.begin("hall", NewAssociation(sessions=["a", "b"]))
    task = engine.claim("w")
    first, second = (asdict(engine.associations.run_slice(task, lambda: True)) for _ in range(2))
    assert first == second
    assert first["items"]


def concluded(here, there, off, scale=1.0):
    """Edges of the frames of two runs at some metres along a line, in their order; `off` by so
    many metres.
    """
    stops = {}
    runs = [], []
    for run, places in enumerate((here, there)):
        for x in places:
            pose = np.eye(4)
            pose[0, 3] = x
            name, number = "ab"[run], len(stops)
            runs[run].append(number)
            stops[number] = PathFrame(
                number, f"{number}", None, name, float(number), name, pose.tolist(), is_cloud=False
            )
    actual = []
    for i, (a, b) in enumerate(zip(here, there, strict=True)):
        T = np.eye(4)
        T[0, 3] = a - b + off.get(i, 0.0)
        actual.append({"from": runs[0][i], "to": runs[1][i], "T": T.ravel(), "strength": "strong"})
    result, counts, joins = finish_association(
        actual, *runs, stops, NewAssociation(sessions=["a", "b"]), scale
    )
    return [item["consistent"] for item in result], counts, joins


def test_an_edge_needs_a_second_one_from_elsewhere():
    # a robot that stands still: all agree, and nothing supports them
    result, counts, (join,) = concluded([0.0, 0.02, 0.04], [0.0, 0.01, 0.02], {})
    assert result == [None, None, None]
    assert counts == {"consistent": 0, "inconsistent": 0, "unchecked": 3}
    assert join["transform"] is None
    assert "one viewpoint" in join["reason"]
    result, _, _ = concluded([0.0, 0.2], [0.0, 0.2], {})
    assert result == [True, True]
    result, counts, _ = concluded([0.0, 0.2], [0.0, 0.2], {1: 0.5})
    assert set(result) == {None, False}
    assert counts == {"consistent": 0, "inconsistent": 1, "unchecked": 1}


def test_the_join_supports_edges_that_no_loop_reaches():
    far = [0.0, 3.0, 6.0, 9.0, 12.0]
    result, counts, (join,) = concluded(far, far, {3: 2.0})
    assert join["support"] == 4
    assert result == [True, True, True, None, True]
    assert counts == {"consistent": 4, "inconsistent": 0, "unchecked": 1}
    # two alone join nothing: of rooms they are too far apart for a loop, of halls they are not
    assert concluded(far[:2], far[:2], {})[0] == [None, None]
    assert concluded(far[:2], far[:2], {}, 5.0)[0] == [True, True]


def test_loop_closures_are_with_frames_long_before(engine):
    order = [frame.frame_id for frame in engine.list_frames("hall").items if frame.session == "a"]
    # frames are two seconds apart: more than 4 s are three of them
    for how, least in (({"apart": 2}, 2), ({"not_within_s": 4.0}, 3)):
        result = done(engine, sessions=["a"], **how)
        edges = engine.associations.edges("hall", result.job_id).items
        assert least == min(order.index(e.from_frame) - order.index(e.to_frame) for e in edges)
        assert result.result.joins == []
    none = done(engine, sessions=["a"])  # 100 apart, and there are six
    assert (none.result.edges, none.result.frames, none.result.validated) == (0, 6, 0)


@pytest.mark.parametrize("sessions", [["a", "b"], ["b", "a"]])
def test_graphs(engine, sessions):
    name = done(engine, sessions=sessions).job_id
    whole = json.loads(engine.associations.graph("hall", name, "json", odometry=True))
    edges = len(engine.associations.edges("hall", name).items)
    kinds = [edge["kind"] for edge in whole["edges"]]
    assert (kinds.count("association"), kinds.count("odometry")) == (edges, 10)
    assert [vertex["vertex"] for vertex in whole["vertices"]] == list(range(12))
    assert {vertex["pose"]["parent_frame"] for vertex in whole["vertices"]} == {whole["frame"]}
    poses = [np.array(vertex["pose"]["matrix"]) for vertex in whole["vertices"]]
    for edge in whole["edges"]:  # all vertices are in one frame, and edges agree with them
        T = inverse(poses[edge["first"]]) @ poses[edge["second"]]
        metres, radians = pose_difference(T, np.array(edge["matrix"]))
        assert metres < (0.06 if edge["kind"] == "association" else 1e-9)
        assert radians < (np.radians(2.0) if edge["kind"] == "association" else 1e-6)
    rows = [
        [float(number) for number in line.split()]
        for line in engine.associations.graph("hall", name, "tum").splitlines()
        if not line.startswith("#")
    ]
    assert [row[0] for row in rows] == [BEGIN.timestamp() + i for i in range(12)]
    both = np.array(poses).reshape(2, 6, 4, 4)[:: 1 if sessions[0] == "a" else -1]
    in_time = both.transpose(1, 0, 2, 3).reshape(12, 4, 4)
    np.testing.assert_allclose([row[1:4] for row in rows], in_time[:, :3, 3], atol=1e-9)


def test_deleted_frames_vanish(engine):
    begun = engine.associations.begin("hall", NewAssociation(sessions=["a", "b"]))
    handler = engine.associations.run_slice
    task = engine.claim("w")
    engine.jobs._tasks._store_result(task, handler(task, lambda: True))
    name = begun.job_id
    before = engine.associations.edges("hall", name).items
    assert before
    assert before[0].consistent is None
    later = [frame.frame_id for frame in engine.list_frames("hall").items if frame.session == "a"]
    engine.delete_frame("hall", later[3])
    engine.delete_frame("hall", before[0].to_frame)
    with pytest.raises(NotIndexed):
        engine.associations.graph("hall", name)
    engine.work_off()
    result = engine.associations.get("hall", name)
    assert result.result.skipped == 1
    gone = {later[3], before[0].to_frame}
    edges = engine.associations.edges("hall", name).items
    assert edges
    assert not gone & {one for edge in edges for one in (edge.from_frame, edge.to_frame)}
    whole = json.loads(engine.associations.graph("hall", name, "json"))
    assert len(whole["vertices"]) == 10
    assert not gone & {vertex["frame_id"] for vertex in whole["vertices"]}


def test_what_cannot_be_associated(engine, monkeypatch):
    for request in (
        {"sessions": ["a", "nobody"]}, {"sessions": ["a"], "robots": ["bob"]},
        {"sessions": ["a"], "filter": Filter(robot=["bob"])},
    ):  # fmt: skip
        with pytest.raises(InvalidRequest, match="no indexed frame"):
            engine.associations.begin("hall", NewAssociation(**request))
    monkeypatch.setattr(associations, "MOST_FRAMES", 8)
    with pytest.raises(InvalidRequest, match="12 frames, but an association can have at most 8"):
        engine.associations.begin("hall", NewAssociation(sessions=["a", "b"]))


def test_a_session_of_two_robots_needs_a_name(engine):
    engine.write(update(frames).values(session="same"))
    with pytest.raises(InvalidRequest, match="several robots: 'ann, bob'"):
        engine.associations.begin("hall", NewAssociation(sessions=["same"]))
    result = done(engine, sessions=["same", "same"], robots=["ann", "bob"], k=1)
    (join,) = result.result.joins
    assert (join.from_robot, join.to_robot, join.from_session) == ("ann", "bob", "same")


#: Of the box's front, before the cameras; and the pixels that it fills there.
BOX_M = 0.8
BOX = (slice(120, 360), slice(160, 480))


@pytest.fixture
def compared(empty, uploads, make_upload):
    """Map `hall`: three frames of a room in session a, and in session b with something before the
    camera; one frame of another room in session c. Returns the engine and the box's pose."""
    for upload in uploads[:3]:
        meta = upload.meta.model_copy(update={"session": "a"})
        empty.add_frame("hall", upload.data, meta)
    for upload in uploads[:3]:
        depth = upload.frame.depth.copy()
        depth[BOX] = np.where(depth[BOX] > BOX_M, BOX_M, depth[BOX])
        frame = replace(upload.frame, depth=depth, pose=upload.pose)
        sent = make_upload(frame, upload.room, session="b")
        empty.add(sent)
    other = uploads[6].meta.model_copy(update={"session": "c"})
    empty.add_frame("hall", uploads[6].data, other)
    assert set(empty.work_off()) == {JobState.SUCCEEDED}
    return empty, [upload.pose for upload in uploads[:3]]


def difference(engine, before, after):
    begun = engine.differences.begin("hall", NewDifference(before=before, after=after))
    assert begun.state is JobState.QUEUED
    assert engine.work_off()[-1] is JobState.SUCCEEDED
    return engine.differences.get("hall", begun.job_id)


def points_of(engine, difference):
    file = engine.differences.file("hall", difference.job_id, POINTS)
    return decode_points(engine.store.blobs.get(file.blob))


def test_what_came_is_new_and_what_went_is_gone(compared):
    engine, poses = compared
    record = difference(engine, "a", "b")
    result = record.result
    assert (result.frames_before, result.frames_after, result.skipped) == (3, 3, 0)
    assert result.cell_m == 0.05
    assert result.new > 80
    assert result.gone <= 0.002 * result.same
    actual = points_of(engine, record)
    counts = np.bincount(actual.patches, minlength=5).tolist()
    assert counts == [
        result.same, result.gone, result.new, result.unseen_after, result.unseen_before,
    ]  # fmt: skip
    # what is new lies on the box of one of the frames
    new = actual.points[actual.patches == NEW]
    depths = np.stack([transform_points(inverse(T), new)[:, 2] for T in poses])
    assert (np.abs(depths - BOX_M).min(axis=0) < 0.05).mean() > 0.95
    back = difference(engine, "b", "a")
    assert (back.result.gone, back.result.new) == (result.new, result.gone)
    gone = points_of(engine, back)
    np.testing.assert_array_equal(gone.points[gone.patches == GONE], new)


def test_sessions_that_cannot_be_compared_are_refused(compared):
    engine, _ = compared
    for request, why in (
        ({"before": "a", "after": "z"}, "'z' of map 'hall' has no indexed frame with a pose"),
        ({"before": "a", "after": "c"}, "share no parent frame"),
        ({"before": "a", "after": "b", "parent_frame": "x"}, "parent frame 'x'. Choose from"),
    ):
        with pytest.raises(InvalidRequest, match=why):
            engine.differences.begin("hall", NewDifference.model_validate(request))
    with pytest.raises(ValueError, match="must differ from before"):
        NewDifference(before="a", after="a")
