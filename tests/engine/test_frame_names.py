"""Tests of original names of frames, and of their order in a session."""

import json
from datetime import UTC, datetime

import numpy as np
import pytest

from sceneprint.engine.maps.map_frames import list_frames, trajectory, trajectory_file
from sceneprint.engine.maps.map_lifecycle import edit_frame
from sceneprint.errors import InvalidRequest, PreconditionFailed
from sceneprint.formats.dataset import read_trajectory
from sceneprint_client.api import FrameMeta, FrameState, JobState, NewMap, Query
from sceneprint_client.api.listing import FrameListing, Run
from sceneprint_client.api.sessions import NewAssociation
from tests.whole_engine import Engine

#: Orders in which the eight frames of a run are uploaded.
IN_ORDER, SHUFFLED = range(8), (5, 0, 7, 2, 6, 1, 4, 3)


def listed(engine, map_name="hall", **wanted):
    """Names of the frames of a list, page by page."""
    names, cursor = [], None
    while True:
        asked = FrameListing.model_validate(wanted)
        page = list_frames(engine.store, map_name, asked, cursor, 3)
        names += [one.name for one in page.items]
        cursor = page.next_cursor
        if cursor is None:
            return names


@pytest.fixture(scope="module")
def two_orders(tmp_path_factory, make_upload, work_off, room_views):
    """Maps `sorted` and `shuffled`: one run without times, uploaded in two orders."""
    from sceneprint.settings import Settings

    folder = tmp_path_factory.mktemp("orders") / "data"
    frames = room_views(21, 0, 8, along_path=True).frames
    with Engine(Settings(data_dir=folder)) as engine:
        for name, order in (("sorted", IN_ORDER), ("shuffled", SHUFFLED)):
            engine.create_map(NewMap(name=name, model="depth"))
            for i in order:
                made = make_upload(
                    frames[i], "room", session="run", name=f"{i}.png", sequence=10 * i
                )
                engine.add_frame(name, made.data, made.meta)
        assert set(work_off(engine)) == {JobState.SUCCEEDED}
        yield engine


def test_a_shuffled_upload_is_the_same_session(two_orders):
    run, names = Run(session="run"), [f"{i}.png" for i in range(8)]
    in_order, shuffled = (
        trajectory(two_orders.store, name, run) for name in ("sorted", "shuffled")
    )
    assert [row[0] for row in shuffled.poses] == [10.0 * i for i in range(8)]
    assert shuffled.poses == in_order.poses
    assert (shuffled.stamps, shuffled.left_out, shuffled.reason) == ("sequence", 0, None)
    for name in ("sorted", "shuffled"):
        assert listed(two_orders, name, session=["run"], order="taken") == names
    assert listed(two_orders, "shuffled") == [f"{i}.png" for i in SHUFFLED]
    came = trajectory(two_orders.store, "shuffled", Run(session="run", clock="received"))
    assert [row[1:] for row in came.poses] == [in_order.poses[i][1:] for i in SHUFFLED]


def test_edges_and_odometry_follow_the_order_taken(two_orders, work_off):
    found, graphs, texts = [], [], []
    for name in ("sorted", "shuffled"):
        asked = NewAssociation.model_validate({"sessions": ["run"], "apart": 3, "k": 2})
        begun = two_orders.associations.begin(name, asked).job_id
        work_off(two_orders)
        edges = two_orders.associations.edges(name, begun).items
        found.append(
            [(e.from_name, e.to_name, e.overlap, e.transform.matrix, e.consistent) for e in edges]
        )
        graph = json.loads(two_orders.associations.graph(name, begun, "json", odometry=True))
        graphs.append(
            (
                [(v["name"], v["sequence"], v["pose"]["matrix"]) for v in graph["vertices"]],
                [(e["kind"], e["first"], e["second"], e["matrix"]) for e in graph["edges"]],
            )
        )
        texts.append(two_orders.associations.graph(name, begun, "tum"))
    assert found[0] == found[1]
    assert found[0]
    # each is looked up among those that were taken at least three before it
    assert all(int(a[0]) - int(b[0]) >= 3 for a, b, *_ in found[1])
    assert graphs[0] == graphs[1]
    odometry = [(a, b) for kind, a, b, _ in graphs[1][1] if kind == "odometry"]
    assert odometry == [(i, i + 1) for i in range(7)]
    assert texts[0] == texts[1]
    assert "# t: sequence, place within the session" in texts[0]
    rows = [line for line in texts[0].splitlines() if not line.startswith("#")]
    assert [float(row.split()[0]) for row in rows] == [10.0 * i for i in range(8)]


def test_answers_do_not_depend_on_the_order(two_orders, uploads):
    asked = uploads[2]
    answers = [
        two_orders.queries.upload([name], asked.data, asked.meta, Query(k=3))
        for name in ("sorted", "shuffled")
    ]
    told = [
        [
            (m.name, m.sequence, m.rank, m.distance, m.validation.status, m.validation.overlap)
            for m in one.matches
        ]
        for one in answers
    ]
    assert told[0] == told[1]
    assert [one.status for one in answers] == ["found"] * 2
    assert answers[0].location.pose.matrix == answers[1].location.pose.matrix


def send(engine, upload, **more):
    known = upload.meta.model_dump() | more
    added, new = engine.add_frame("hall", upload.data, FrameMeta.model_validate(known))
    return added.frame_id, new


def test_names_are_labels_and_tell_no_uploads_apart(empty, uploads):
    frame, new = send(empty, uploads[0], session="s", name="a.png", sequence=3)
    assert new
    assert send(empty, uploads[0], session="s", name="b.png", sequence=4) == (frame, False)
    told = empty.get_frame("hall", frame)
    assert (told.name, told.sequence) == ("a.png", 3)
    tag = told.etag
    now = edit_frame(empty.store, "hall", frame, {"name": "c/d.png", "sequence": 0}, [str(tag)])
    assert (now.name, now.sequence) == ("c/d.png", 0)
    with pytest.raises(PreconditionFailed):
        edit_frame(empty.store, "hall", frame, {"name": "e"}, [str(tag)])
    edit_frame(empty.store, "hall", frame, {"name": None, "sequence": None})
    told = empty.get_frame("hall", frame)
    assert (told.name, told.sequence) == (None, None)
    for bad in ("", "/etc/passwd", "a/../b", "a//b", "a\\b", "a\nb", "x" * 256):
        with pytest.raises(InvalidRequest, match="name"):
            edit_frame(empty.store, "hall", frame, {"name": bad})
    for worse in (-1, 2**53, 1.5):
        with pytest.raises(InvalidRequest, match="sequence"):
            edit_frame(empty.store, "hall", frame, {"sequence": worse})


def test_what_is_deleted_is_forgotten_and_pages_go_on_after_it(empty, uploads):
    order = (4, 1, None, 3, 0, None)
    for i, (upload, place) in enumerate(zip(uploads, order, strict=False)):
        at = datetime.fromtimestamp(1.7e9 - i, UTC) if i < 2 else None
        send(empty, upload, session="s", name=f"{i}", sequence=place, captured_at=at)
    # by time; then by place; then as they came
    taken = ["1", "0", "4", "3", "2", "5"]
    assert listed(empty, session="s", order="taken") == taken
    wanted = FrameListing(session=["s"], order="taken")
    page = list_frames(empty.store, "hall", wanted, None, 2)
    empty.delete_frame("hall", page.items[-1].frame_id)
    gone = empty.list_frames("hall", state=FrameState.DELETED).items[0]
    assert (gone.name, gone.sequence, gone.captured_at) == (None, None, None)
    rest = list_frames(empty.store, "hall", wanted, page.next_cursor, 9)
    assert [one.name for one in rest.items] == taken[2:]
    cursor = str(page.next_cursor)
    sealed = cursor.partition("~")[0]
    for bad in (sealed, f"{sealed}~", f"{sealed}~x", f"{sealed}~W251bGwsIC0xXQ", cursor[1:]):
        with pytest.raises(InvalidRequest, match="is not valid"):
            list_frames(empty.store, "hall", wanted, bad, 9)


def test_an_empty_trajectory_says_why(empty, uploads, tmp_path):
    def told(**run):
        found = trajectory(empty.store, "hall", Run.model_validate({"session": "s"} | run))
        assert (found.stamps is None) == (found.poses == [])
        text = trajectory_file(found)
        assert (f"# empty: {found.reason}" in text) == (not found.poses)
        return len(found.poses), found.reason

    assert told() == (0, "the map has no frame of session 's'")
    send(empty, uploads[0], session="s", pose=None)
    assert told() == (0, "none of its 1 frames has a pose; send `pose` with uploads, or edit them")
    after = datetime(2026, 1, 1, tzinfo=UTC)
    assert told(captured_after=after) == (0, "the map has no frame of session 's' in this period")
    send(empty, uploads[1], session="s")
    count, why = told()
    assert count == 0
    assert why == (
        f"none of its 2 frames has a pose in {uploads[1].room!r} with `captured_at` or `sequence`; "
        "`clock=received` orders them by upload"
    )
    assert told(clock="received") == (1, None)
    send(empty, uploads[2], session="s", sequence=7)
    assert told() == (1, None)
    assert told(clock="captured")[0] == 0
    (tmp_path / "a.tum").write_text(
        trajectory_file(trajectory(empty.store, "hall", Run(session="s")))
    )
    assert read_trajectory(tmp_path / "a.tum").stamps.tolist() == [7.0]
    assert np.allclose(read_trajectory(tmp_path / "a.tum").positions[0], uploads[2].pose[:3, 3])
    # where some have times, places would be stamps of another kind
    send(empty, uploads[3], session="s", sequence=8, captured_at=after)
    assert told() == (1, None)
    assert told(clock="sequence") == (2, None)
