"""Tests of filtered queries against a ranking in plain Python."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, timezone

import numpy as np
import pytest

from sceneprint.errors import InvalidRequest
from sceneprint.geometry.retrieval.ranking import ranking_size
from sceneprint.store import maps as stored_maps
from sceneprint.store.maps import add_frame
from sceneprint.store.signatures import StoredSignature, index_frame
from sceneprint_client.api import Filter, NewMap, Query

START = datetime(2026, 11, 16, 9, 30, tzinfo=UTC)


@dataclass(frozen=True)
class Known:
    """A frame as the oracle knows it."""

    id: str
    vector: np.ndarray
    robot: str | None
    session: str | None
    at: datetime | None
    tags: list[str]
    parent: str | None
    place: tuple[int, ...]


def fill(engine, count, seed, name="hall"):
    """Index frames of random metadata; places and times are round, so that bounds are met."""
    rng = np.random.default_rng(seed)
    frames = []
    with engine.store.database.write() as connection:
        row = stored_maps.find_map(connection, name)
        model = engine.signers(row.model_id).model
        for i in range(count):
            at = None if rng.random() < 0.1 else START + timedelta(seconds=int(rng.integers(60)))
            place = tuple(rng.integers(-2, 3, 3).tolist())
            pose = np.eye(4)
            pose[:3, 3] = place
            parent = rng.choice([None, "p1", "p2"], p=[0.1, 0.7, 0.2])
            values = {
                "content_id": f"{seed}-{i}", "blob": "00" * 32, "bytes": 3,
                "intrinsics": {"width": 1, "height": 1, "fx": 1, "fy": 1, "cx": 0, "cy": 0},
                "depth_scale": 1000.0, "depth_along_ray": False,
                "robot": rng.choice([None, "r1", "r2", "r3"]),
                "session": rng.choice([None, "s1", "s2"], p=[0.1, 0.6, 0.3]),
                "captured_at": None if at is None else at.timestamp(),
                "tags": [tag for tag in ("door", "é", "c") if rng.random() < 0.5],
                "pose_parent": parent, "pose": None if parent is None else pose.tolist(),
            }  # fmt: skip
            frame = add_frame(connection, row.number, values)
            vector = rng.integers(0, 3, model.signature_bytes, np.uint8)
            signature = StoredSignature(model.id, vector.tobytes(), "11" * 32, [1], [1])
            index_frame(connection, frame, signature)
            robot, session, tags = (values[name] for name in ("robot", "session", "tags"))
            frames.append(Known(frame.id, vector, robot, session, at, tags, parent, place))
    return frames


def passes(one, wanted, own):
    inside = is_far = True
    if wanted.not_within_s is not None and one.session == own.session:
        other_robot = None not in (one.robot, own.robot) and one.robot != own.robot
        near = one.at is None or abs((one.at - own.at).total_seconds()) <= wanted.not_within_s
        is_far = other_robot or not near
    if wanted.region is not None:
        low, high = wanted.region.min, wanted.region.max
        sides = zip("xyz", one.place, strict=True)
        inside = one.parent == wanted.region.parent_frame and all(
            getattr(low, axis) <= x <= getattr(high, axis) for axis, x in sides
        )
    after, before = wanted.captured_after, wanted.captured_before
    return (
        (wanted.robot is None or one.robot in wanted.robot)
        and (wanted.session is None or one.session in wanted.session)
        and (after is None or (one.at is not None and one.at >= after))
        and (before is None or (one.at is not None and one.at <= before))
        and set(wanted.tags) <= set(one.tags)
        and (is_far and inside and one.id not in wanted.exclude_frames)
    )


def ranked(frames, own, wanted):
    actual = [
        (int(((frame.vector.astype(int) - own.vector) ** 2).sum()), i, frame.id)
        for i, frame in enumerate(frames)
        if frame.id != own.id and passes(frame, wanted, own)
    ]
    return [(frame_id, distance) for distance, _, frame_id in sorted(actual)]


def hold(answer, frames, own, wanted):
    expected = ranked(frames, own, wanted)
    counts = answer.counts
    assert (counts.map, counts.passed) == (len(frames) - 1, len(expected))
    assert (counts.compared, answer.exact) == (len(expected), True)
    assert counts.ranked == ranking_size(len(expected))
    assert [(m.frame_id, m.distance) for m in answer.matches] == expected[:50]
    return len(expected)


def draw(rng, frames):
    seconds = [int(integer) for integer in sorted(rng.integers(0, 60, 2))]
    corners = np.sort(rng.integers(-2, 3, (2, 3)), axis=0).tolist()
    fields = {
        "robot": "r1" if rng.random() < 0.5 else ["r2", "r3"],
        "session": rng.choice(["s1", "s2"]),
        "captured_after": START + timedelta(seconds=seconds[0]),
        "captured_before": START + timedelta(seconds=seconds[1]),
        "tags": rng.permutation(["door", "é", "c"])[: rng.integers(1, 4)].tolist(),
        "not_within_s": float(rng.integers(1, 20)),
        "region": {
            "parent_frame": "p1",
            **{k: dict(zip("xyz", c, strict=True)) for k, c in zip(("min", "max"), corners,
                                                                  strict=True)},
        },
        "exclude_frames": [one.id for one in rng.choice(np.array(frames, object), 9)],
    }  # fmt: skip
    chosen = rng.permutation(list(fields))[: rng.integers(1, 4)]
    return Filter.model_validate({name: fields[name] for name in chosen})


def ask(engine, own, wanted, *, exact=False):
    query = Query(stages=("retrieve",), k=50, filter=wanted, exact=exact)
    return engine.query_frame("hall", own.id, query)


@pytest.mark.parametrize("published", [False, True])
def test_a_filter_leaves_what_plain_python_leaves(make_engine, published):
    engine = make_engine(unindexed_frames=50)
    for name in ("hall", "other"):
        engine.create_map(NewMap(name=name, model="depth"))
    frames = fill(engine, 120, 1)
    fill(engine, 20, 4, "other")
    if published:
        assert engine.publish_due() == 1
    frames += fill(engine, 40, 2)
    for gone in frames[5:125:12]:
        engine.delete_frame("hall", gone.id)
        frames.remove(gone)
    rng, sizes = np.random.default_rng(3), []
    askers = [frame for frame in frames if frame.session is not None and frame.at is not None]
    for i in range(60):
        own = askers[int(rng.integers(len(askers)))]
        wanted = draw(rng, frames)
        answer = ask(engine, own, wanted, exact=i % 2 == 1)
        assert answer.index_version == int(published)
        sizes.append(hold(answer, frames, own, wanted))
    assert min(sizes) == 0
    assert sum(size > 20 for size in sizes) > 10
    own = askers[0]
    for options in (
        {}, {"captured_after": own.at, "captured_before": own.at},  # bounds are inside
        {"captured_before": own.at.astimezone(timezone(timedelta(hours=5)))},  # the same moment
        {"not_within_s": 1e300}, {"exclude_frames": [f.id for f in frames[:90]] + ["nobody"]},
    ):  # fmt: skip
        wanted = Filter.model_validate(options)
        assert hold(ask(engine, own, wanted), frames, own, wanted) > 0


def test_what_does_not_pass_is_neither_matched_nor_located_by(full, uploads):
    request, names = uploads[8], full.ids()
    for wanted in (
        Filter(exclude_frames=[names[8]]),
        Filter(exclude_frames=names[:6]),
        Filter.model_validate(
            {"region": {"parent_frame": request.room, "min": {"x": -99, "y": -99, "z": -99},
                        "max": {"x": 99, "y": 99, "z": 99}}}
        ),
    ):  # fmt: skip
        answer = full.ask(request, Query(k=50, filter=wanted))
        result = {match.frame_id for match in answer.matches}
        if wanted.region is not None:
            assert result == set(names[6:])
        else:
            assert result == set(names) - set(wanted.exclude_frames)
        assert answer.counts.passed == len(result)
        assert answer.status == "found"
    for stages in (("retrieve",), ("retrieve", "diversify", "validate")):
        query = Query(stages=stages, filter=Filter(tags=["nowhere"]))
        answer = full.ask(request, query)
        assert answer.status == ("unvalidated" if len(stages) == 1 else "not_found")
        assert (answer.matches, answer.location) == ([], None)
        assert answer.counts.model_dump() == {
            "map": 12, "passed": 0, "compared": 0, "ranked": 0, "selected": 0, "validated": 0,
            "accepted": 0,
        }  # fmt: skip


def test_who_asks_to_keep_away_from_itself_says_where_it_is(full, uploads, make_engine):
    query = Query(stages=("retrieve",), filter=Filter(not_within_s=5))
    needed = "needed by filter.not_within_s"
    with pytest.raises(InvalidRequest, match=r"captured_at\. Send both in") as caught:
        full.ask(uploads[0], query)
    assert caught.value.fields == (("session", needed), ("captured_at", needed))
    with pytest.raises(InvalidRequest, match="has no session and no captured_at"):
        full.query_frame("hall", full.ids()[0], query)
    named = uploads[0].meta.model_copy(update={"session": "s1"})
    with pytest.raises(InvalidRequest, match="has no captured_at"):
        full.ask(uploads[0], query, meta=named)
    whole = named.model_copy(update={"captured_at": START})
    assert full.ask(uploads[0], query, meta=whole).counts.passed == 12
