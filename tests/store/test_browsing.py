"""Tests of lists of frames and sessions against plain Python with random metadata."""

from collections import Counter
from datetime import UTC, datetime, timedelta
from itertools import product

import numpy as np
import pytest
from sqlalchemy import update

from sceneprint.store.frame_queries import (
    CapturePosition,
    count_run,
    list_frames,
    list_runs,
    poses_of_run,
    stamps_of_run,
)
from sceneprint.store.frames import write_frame
from sceneprint.store.maps import add_map
from sceneprint.store.tables import frames
from sceneprint_client.api import FrameState
from sceneprint_client.api.listing import FrameListing, Run

START = datetime(2026, 11, 16, 9, 30, tzinfo=UTC)


def drawn(rng):
    """Metadata of a frame; times and names are few, so that bounds and equals are met."""
    pose = np.eye(4)
    pose[:3, 3] = rng.integers(-2, 3, 3)
    parent = rng.choice([None, "p1", "p2"], p=[0.2, 0.5, 0.3])
    at = None if rng.random() < 0.2 else START + timedelta(seconds=int(rng.integers(20)))
    return {
        "robot": rng.choice([None, "r1", "r2"]),
        "session": rng.choice([None, "s1", "s2"], p=[0.2, 0.5, 0.3]),
        "captured_at": None if at is None else at.timestamp(),
        "tags": [tag for tag in ("door", "é", "c") if rng.random() < 0.5],
        "pose_parent": parent, "pose": None if parent is None else pose.tolist(),
        "name": rng.choice([None, "a/1.png", "a/2.png", "b", "b\U0010ffff\U0010ffff", "c\ud7ff9"]),
        "sequence": None if rng.random() < 0.3 else int(rng.integers(6)),
    }  # fmt: skip


def taken(one):
    """The order in which frames were taken, by its sentence."""
    return (
        one.captured_at is None, one.captured_at or 0.0, one.sequence is None, one.sequence or 0,
        one.number,
    )  # fmt: skip


@pytest.fixture
def mixed(store, hall, received):
    """Frames of a map in all states, some edited since; another map has frames as well."""
    rng = np.random.default_rng(4)
    with store.database.write() as connection:
        other = add_map(connection, "other", None, hall.model_id)
        rows = []
        for i in range(60):
            if i % 6 == 0:
                received(f"o{i}", other, within=connection, **drawn(rng))
            rows.append(received(f"{i % 50:064d}", within=connection, **drawn(rng)))
    with store.database.write() as connection:
        for i, row in enumerate(rows):
            state = str(rng.choice(["indexed", "indexed", "received", "rejected", "deleted"]))
            values = {"state": state, "received_at": START.timestamp() + i // 2}
            own = frames.c.number == row.number
            connection.execute(update(frames).where(own).values(**values))
        for row in rows[::3]:
            write_frame(connection, hall, row, drawn(rng))
    with store.database.read() as connection:
        result = [
            frame
            for state in FrameState
            for frame in list_frames(connection, hall.number, None, 99, FrameListing(state=state))
        ]
    assert len(result) == 60
    return sorted(result, key=lambda row: row.number)


def passes(one, w):
    """By the sentences of `FrameListing`, condition by condition."""
    at = None if one.captured_at is None else datetime.fromtimestamp(one.captured_at, UTC)
    came = datetime.fromtimestamp(one.received_at, UTC)
    return (
        (one.state != "deleted" if w.state is None else one.state == w.state)
        and (not w.robot or one.robot in w.robot)
        and (not w.session or one.session in w.session)
        and set(w.tag) <= set(one.tags)
        and (w.captured_after is None or (at is not None and at >= w.captured_after))
        and (w.captured_before is None or (at is not None and at <= w.captured_before))
        and (w.received_after is None or came >= w.received_after)
        and (w.received_before is None or came <= w.received_before)
        and (w.parent_frame is None or one.pose_parent == w.parent_frame)
        and (w.has_pose is None or (one.pose is not None) == w.has_pose)
        and (w.content_id is None or one.content_id == w.content_id)
        and (w.name is None or (one.name or "").startswith(w.name))
        and (
            w.find is None
            or any((text or "").startswith(w.find) for text in (one.id, one.name, one.session))
        )
    )


def some_listing(rng):
    a, b, c, d = (START + timedelta(seconds=int(n)) for n in rng.integers(0, 30, 4))
    every = {
        "state": rng.choice(["indexed", "rejected", "deleted"]),
        "robot": ["r1"] if rng.random() < 0.5 else ["r2", "r1"],
        "session": str(rng.choice(["s1", "s2", "nobody"])),
        "tag": rng.permutation(["door", "é", "c"])[: rng.integers(1, 3)].tolist(),
        "captured_after": a, "captured_before": b, "received_after": c, "received_before": d,
        "parent_frame": "p1", "has_pose": bool(rng.random() < 0.5),
        "content_id": f"{rng.integers(0, 50):064d}",
        "name": str(rng.choice(["a", "a/2", "b", "b\U0010ffff", "c\ud7ff", "\U0010ffff", "B"])),
        "find": str(rng.choice(["a", "s1", "s", "b\U0010ffff", *"0123456789abcdef"])),
    }  # fmt: skip
    names = rng.permutation(list(every))[: rng.integers(0, 4)]
    fields = {name: every[name] for name in names}
    orders = ["asc", "desc", "taken", "taken"] if "session" in fields else ["asc", "desc"]
    return FrameListing.model_validate({**fields, "order": rng.choice(orders)})


def position(one):
    return CapturePosition(one.number, one.captured_at, one.sequence)


def test_every_list_is_that_of_plain_python(store, hall, mixed):
    rng, sizes = np.random.default_rng(9), Counter[bool]()
    sessions = [FrameListing(session=name, order="taken") for name in (["s1"], ["s2"])]
    with store.database.read() as connection:
        for wanted in [*sessions, *(some_listing(rng) for _ in range(110))]:
            limit = int(rng.integers(1, 9))
            expected = [row for row in mixed if passes(row, wanted)]
            if wanted.order == "desc":
                expected.reverse()
            elif wanted.order == "taken":
                expected.sort(key=taken)
            results = []
            while True:  # pages follow each other without a gap or a double
                last = position(results[-1]) if results else None
                page = list_frames(connection, hall.number, last, limit, wanted)
                results += page
                if len(page) < limit:
                    break
            assert results == expected, wanted
            sizes[len(expected) > 0] += 1
    assert min(sizes.values()) > 13  # neither all empty nor all full


def test_sessions_are_those_of_plain_python(store, hall, mixed):
    expected = {}
    for row in mixed:
        if row.state != "deleted":
            expected.setdefault((row.session or "", row.robot or ""), []).append(row)
    with store.database.read() as connection:
        runs = list_runs(connection, hall.number, None, 99)
        paged, after = [], None
        while result := list_runs(connection, hall.number, after, 2):
            paged += result
            after = (result[-1].session or "", result[-1].robot or "")
    assert paged == runs
    assert [(run.session or "", run.robot or "") for run in runs] == sorted(expected)
    for run in runs:
        own = expected[run.session or "", run.robot or ""]
        times = [row.captured_at for row in own if row.captured_at is not None]
        assert run.states == Counter(row.state for row in own)
        assert run.posed == sum(row.pose is not None for row in own)
        assert (run.first, run.last) == (min(times, default=None), max(times, default=None))
        assert run.parents == Counter(o.pose_parent for o in own if o.pose_parent is not None)


def stamped(own, run, stamp):
    """Ids, stamps and poses of frames in order of their stamps; of equal stamps, the first."""
    posed = [row for row in own if row.pose_parent == run.parent_frame and stamp(row) is not None]
    posed.sort(key=lambda one: (stamp(one), taken(one)), reverse=True)
    first = list({stamp(row): row for row in posed}.values())[::-1]
    return [(row.id, stamp(row), row.pose) for row in first]


def test_poses_of_a_run_are_those_of_plain_python(store, hall, mixed):
    since = START + timedelta(seconds=5)
    for run in (
        Run(session="s1", parent_frame="p1"),
        Run(session="s1", robot="r1", parent_frame="p2"),
        Run(session="s2", parent_frame="p1", captured_after=since),
        Run(session="s1", parent_frame="p1", captured_before=since),
    ):
        between = {"captured_after": run.captured_after, "captured_before": run.captured_before}
        own = [
            row
            for row in mixed
            if row.session == run.session
            and row.state != "deleted"
            and run.robot in (None, row.robot)
            and passes(row, FrameListing(**between))
        ]
        captured = stamped(own, run, lambda one: one.captured_at)
        assert captured
        with store.database.read() as connection:
            assert stamps_of_run(connection, hall.number, run) == "captured"
            result = poses_of_run(connection, hall.number, run, "captured")
            placed, _ = poses_of_run(connection, hall.number, run, "sequence")
            counted = count_run(connection, hall.number, run)
        assert result == (captured, len(captured))
        assert placed == stamped(own, run, lambda one: one.sequence)
        assert {(robot, parent): count for robot, parent, count in counted} == Counter(
            (row.robot, row.pose_parent) for row in own
        )


def test_poses_are_stamped_by_time_or_else_by_place(store, hall, received):
    posed = {"session": "s", "pose_parent": "p", "pose": np.eye(4).tolist()}
    run = Run(session="s", parent_frame="p")

    def stamps(clock="taken"):
        with store.database.read() as connection:
            query = run.model_copy(update={"clock": clock})
            return stamps_of_run(connection, hall.number, query)

    received("0" * 64, **posed)
    received("1" * 64, session="s", captured_at=1.0)  # of no pose, it stamps none
    assert stamps() is None
    assert stamps("received") == "received"
    received("2" * 64, **posed, sequence=0)
    assert stamps() == "sequence"
    received("3" * 64, **posed, captured_at=0.0)
    assert stamps() == "captured"
    assert stamps("sequence") == "sequence"


def test_poses_are_taken_evenly(store, hall, received):
    """At the multiples of 10 / (most - 1), rounded up, of the eleven times."""
    rows = [
        received(
            f"{i:064d}", session="s", pose_parent="p", pose=np.eye(4).tolist(),
            captured_at=START.timestamp() + (i * 7) % 11,
        )
        for i in range(11)
    ] + [received(f"{99:064d}", session="s", pose_parent="p", pose=np.eye(4).tolist(),
                  captured_at=START.timestamp())]  # fmt: skip
    for most, places in (
        (2, [0, 10]), (3, [0, 5, 10]), (4, [0, 4, 7, 10]), (6, [0, 2, 4, 6, 8, 10]),
        (10, [0, 2, 3, 4, 5, 6, 7, 8, 9, 10]), (11, range(11)), (12, range(11)),
    ):  # fmt: skip
        with store.database.read() as connection:
            run = Run(session="s", parent_frame="p", most=most)
            result, count = poses_of_run(connection, hall.number, run, "captured")
        assert count == 11
        assert [at - START.timestamp() for _, at, _ in result] == list(places), most
        assert result[0][0] == rows[0].id  # of two of one time, the first that came


SEARCHED = "USING COVERING INDEX ix_frames_searched"


def test_each_list_takes_the_index_that_is_meant_for_it(store, hall, plans):
    ways = [
        ({}, "INDEX ix_frames_map_number_number"),
        ({"state": "indexed"}, "INDEX ix_frames_map_number_number"),
        ({"state": "rejected"}, f"{SEARCHED} (map_number=? AND state=?"),
        ({"session": "s"}, f"{SEARCHED} (map_number=? AND state=? AND session=?"),
        ({"session": "s", "robot": "r", "order": "desc"},
         f"{SEARCHED} (map_number=? AND state=? AND session=? AND robot=?"),
        ({"robot": "r"}, SEARCHED),
        ({"parent_frame": "p"}, SEARCHED),
        ({"tag": "a"}, "INDEX ix_frame_tags_tag_frame_number (tag=?)"),
        ({"content_id": "a" * 64}, "INDEX ix_frames_map_number_content_id"),
        ({"name": "frame-0001"},
         "USING COVERING INDEX ix_frames_named (map_number=? AND name>? AND name<?)"),
        ({"session": "s", "order": "taken"},
         f"{SEARCHED} (map_number=? AND state=? AND session=?"),
    ]  # fmt: skip
    for (wanted, way), beyond in product(ways, (None, CapturePosition(7, 1.0, None))):
        listing = FrameListing.model_validate(wanted)
        with store.database.read() as connection, plans(connection) as steps:
            list_frames(connection, hall.number, beyond, 9, listing)
        assert any(way in step for step in steps), (wanted, steps)
        assert not any(step.startswith("SCAN") for step in steps), (wanted, steps)
