"""Tests of the tracker: priors, missing answers, logs, threads, and runs through synthetic
buildings with kidnapped robots and ambiguous places.
"""

from __future__ import annotations

import io
from dataclasses import dataclass, field
from itertools import pairwise
from threading import Event
from typing import Any

import numpy as np
import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint_client import AsyncTracker, Tracker, errors
from sceneprint_client.api import Alternative, FrameMeta, GivenPose, Localization
from sceneprint_client.api.base import GivenDirection
from sceneprint_client.frame_files import camera_of
from sceneprint_client.tracker import TrackerParameters, replay
from sceneprint_client.tracker_core import difference, inverse, observation_of, rotation_matrix
from sceneprint_lab.synth import synthesise_lookalike
from tests.client.conftest import answer

DEPTH = np.ones((3, 4), np.float32)
K = (5.0, 5.0, 1.5, 1.0)


@dataclass
class FakeClient:
    answers: list[Localization | Exception]
    requests: list[dict[str, Any]] = field(default_factory=list)
    begun: Event = field(default_factory=Event)
    may_answer: Event = field(default_factory=Event)

    def __post_init__(self):
        self.may_answer.set()

    def localize(self, map_name, frame, meta=None, **how):
        return self.answer({"map": map_name, "frames": [depth_of(frame)], "metas": [meta], **how})

    def localize_sequence(self, map_name, frames, metas, **how):
        seen = [depth_of(frame) for frame in frames]
        return self.answer({"map": map_name, "frames": seen, "metas": metas, **how})

    def answer(self, request):
        self.requests.append(request)
        self.begun.set()
        assert self.may_answer.wait(PATIENCE_S)
        reply = self.answers[min(len(self.requests), len(self.answers)) - 1]
        if isinstance(reply, Exception):
            raise reply
        return reply


def depth(metres):
    return np.full((3, 4), metres, np.float32)


def depth_of(data):
    sent = np.load(io.BytesIO(data))
    assert (sent.shape, sent.min()) == ((3, 4), sent.max())
    return float(sent[0, 0])


def ahead(x):
    T = np.eye(4)
    T[0, 3] = x
    return T


def fake(*answers):
    return FakeClient(list(answers))


def equal(a, b):
    names = ("T_map_odom", "T_map_sensor", "covariance")
    same = all(np.array_equal(getattr(a, n), getattr(b, n)) for n in names)
    plain = [(s.status, s.stamp, s.parent_frame, s.age, s.reason) for s in (a, b)]
    return same and plain[0] == plain[1]


def test_its_state_is_the_prior_of_the_next_question():
    client = fake(answer("found", 5.0), answer("found", 6.0), answer("not_found"))
    tracker = Tracker(client, "m", camera=K)
    state = tracker.update(DEPTH, ahead(0), stamp=0.0, up=(0, -1, 0))
    assert (state.status, state.parent_frame) == ("tracking", "map")
    tracker.update(DEPTH, ahead(1), stamp=1.0, meta=camera_of(K, (4, 3)))
    first, second = client.requests
    (meta,) = first["metas"]
    up = GivenDirection(x=0, y=-1, z=0)
    assert (first["map"], first["frames"], first["prior"]) == ("m", [1.0], None)
    assert (meta.intrinsics, meta.up) == (camera_of(K, (4, 3)), up)
    assert second["metas"] == [FrameMeta(intrinsics=camera_of(K, (4, 3)))]
    assert second["prior"].pose.parent_frame == "map"
    np.testing.assert_allclose(second["prior"].pose.matrix, ahead(6), atol=1e-9)
    covariance = np.reshape(second["prior"].covariance, (6, 6))
    assert (np.diag(covariance) > 0).all()
    assert tracker.update(DEPTH, ahead(2), stamp=2.0).age == 1.0


def test_weak_answers_are_no_fix_alone():
    for fields in ({"support": 1}, {"strength": "weak"}):
        tracker = Tracker(fake(answer("found", 5.0, **fields)), "m", camera=K)
        assert tracker.update(DEPTH, ahead(0), stamp=0.0).status == "lost"
    weak = answer("found", 5.0, verified_by="prior")
    assert Tracker(fake(weak), "m", camera=K).update(DEPTH, ahead(0)).status == "lost"
    no_poses = Tracker(fake(answer("found", pose=None)), "m", camera=K)
    assert "no matching frame" in no_poses.update(DEPTH, ahead(0)).reason.lower()


def test_a_service_that_is_away_leaves_it_to_odometry():
    away = (errors.Unreachable("away"), errors.Busy("busy"), errors.Refused("bad", 502, {}))
    client = fake(answer("found", 5.0), *away, errors.UselessFrame("blank"))
    tracker = Tracker(client, "m", camera=K)
    states = [tracker.update(DEPTH, ahead(i), stamp=i) for i in range(5)]
    assert {state.status for state in states} == {"tracking"}
    np.testing.assert_allclose(states[-1].T_map_sensor, ahead(9), atol=1e-9)
    assert states[-1].age == 4
    for wrong in (errors.UnknownMap("no map"), errors.Refused("odd", 418, {})):
        with pytest.raises(type(wrong)):
            Tracker(fake(wrong), "m", camera=K).update(DEPTH, ahead(0))


def test_its_log_replays_to_the_same_states():
    answers = [answer("found", 5.0), answer("ambiguous", 6.0), answer("found", 40.0),
            answer("found", 41.0), answer("not_found"), answer("found", 43.0)]  # fmt: skip
    log = io.StringIO()
    tracker = Tracker(fake(*answers), "m", camera=K, log=log)
    states = []
    for i in range(6):
        states.append(tracker.move(ahead(i - 0.5), i - 0.5))
        states.append(tracker.update(DEPTH, ahead(i), stamp=float(i)))
    states.append(tracker.reset("a lift"))
    assert "".join(state.status[0] for state in states) == "lttttttlllltl"
    again = list(replay(log.getvalue().splitlines()))
    assert len(again) == len(states)
    assert all(map(equal, again, states))
    other = list(replay(log.getvalue().splitlines(), TrackerParameters(strong_weight=0.1)))
    assert {one.status for one in other} == {"lost", "ambiguous"}


def test_a_thread_asks_for_the_latest_frame_alone():
    client = fake(answer("found", 5.0), answer("found", 8.0))
    client.may_answer.clear()
    log = io.StringIO()
    with AsyncTracker(Tracker(client, "m", camera=K, log=log)) as tracker:
        assert tracker.submit(depth(0), ahead(0), stamp=0.0).status == "lost"
        assert client.begun.wait(PATIENCE_S)
        for i in (1, 2, 3):
            assert tracker.submit(depth(i), ahead(i), stamp=float(i)).status == "lost"
        assert not tracker.wait(0)
        client.may_answer.set()
        assert tracker.wait(PATIENCE_S)
        assert [request["frames"] for request in client.requests] == [[0.0], [3.0]]
        assert tracker.dropped == 2
        state = tracker.submit(depth(4), ahead(4), stamp=4.0)
        assert (state.status, state.age) == ("tracking", 1.0)
        np.testing.assert_allclose(state.T_map_sensor, ahead(9), atol=1e-9)
        assert tracker.wait(PATIENCE_S)
    assert equal(list(replay(log.getvalue().splitlines()))[-2], state)


def test_an_answer_to_a_frame_from_before_a_reset_is_not_used():
    client = fake(answer("found", 5.0))
    client.may_answer.clear()
    inner = Tracker(client, "m", camera=K)
    with AsyncTracker(inner) as tracker:
        tracker.submit(DEPTH, ahead(0), stamp=0.0)
        assert client.begun.wait(PATIENCE_S)
        tracker.submit(DEPTH, ahead(1), stamp=1.0)
        assert inner.reset("a lift").reason == "a lift"
        client.may_answer.set()
        assert tracker.wait(PATIENCE_S)
        assert tracker.submit(DEPTH, ahead(0), stamp=0.5).status == "lost"  # the clock began anew
        assert tracker.wait(PATIENCE_S)
        assert tracker.submit(DEPTH, ahead(0), stamp=0.6).status == "tracking"


def test_what_the_thread_meets_is_raised_by_the_next_submit():
    with AsyncTracker(Tracker(fake(errors.UnknownMap("no map")), "m", camera=K)) as tracker:
        tracker.submit(DEPTH, ahead(0), stamp=0.0)
        assert tracker.wait(PATIENCE_S)
        with pytest.raises(errors.UnknownMap):
            tracker.submit(DEPTH, ahead(1), stamp=1.0)


def test_alternatives_weigh_by_their_confidence():
    pose = answer("found", 5.0).pose
    alternatives = [
        Alternative(pose=pose, confidence=p, weight=2, support=1, score=0.9)
        for p in (0.6, 0.3, 0.0, None)
    ]
    unsure = answer("ambiguous").model_copy(update={"alternatives": alternatives})
    weights = [pose.weight for pose in observation_of(unsure).poses]
    assert weights == [0.6, 0.3, 0.001, 0.001]


# Several frames in one question, while no place is tracked.


def asked_with(tracker, xs, client):
    """Depths of the frames of each question; the depth of a frame is its place on the way."""
    for i, x in enumerate(xs):
        tracker.update(depth(x), ahead(x), stamp=float(i))
    return [request["frames"] for request in client.requests]


def test_while_it_is_lost_it_asks_with_the_latest_frames_that_differ():
    client = fake(answer("not_found"), answer("ambiguous"))
    tracker = Tracker(client, "m", camera=K)
    requests = asked_with(tracker, [5, 5.05, 5.2, 5.4, 5.41, 5.8, 8.75], client)
    # 5.05 is too near to 5, and 5.41 to 5.4; only 5.8 is within 3 m of 8.75
    expected = [
        [5], [5.05], [5, 5.2], [5, 5.2, 5.4], [5, 5.2, 5.41], [5.2, 5.4, 5.8], [5.8, 8.75],
    ]  # fmt: skip
    assert [[round(frame, 2) for frame in frames] for frames in requests] == expected
    third = client.requests[3]
    # odometry from the last frame: 40 cm and 20 cm behind it
    for meta, x in zip(third["metas"], (-0.4, -0.2, 0.0), strict=True):
        assert meta.pose.parent_frame == "odom"
        np.testing.assert_allclose(meta.pose.matrix, ahead(x), atol=1e-12)
        assert meta.intrinsics == camera_of(K, (4, 3))
    assert third["keep"] is False


def test_it_asks_with_one_frame_while_it_tracks_or_where_only_one_is_wanted():
    client = fake(answer("not_found"), answer("found", 6.0), answer("not_found"))
    assert asked_with(Tracker(client, "m", camera=K), [5, 6, 7, 8], client) == [
        [5.0], [5.0, 6.0], [7.0], [8.0]
    ]  # fmt: skip
    client = fake(answer("not_found"))
    alone = Tracker(client, "m", camera=K, parameters=TrackerParameters(frames=1))
    assert asked_with(alone, [5, 6, 7], client) == [[5.0], [6.0], [7.0]]
    for wrong in (0, 11):
        with pytest.raises(errors.InvalidRequest, match="Set `frames` to 1 to 10"):
            TrackerParameters(frames=wrong)


def test_after_a_kidnapping_no_frame_from_before_is_sent():
    # at 2 it is carried away: both answers there contradict the tracked place
    answers = [answer("found", 0.0), answer("found", 1.0), answer("found", 40.0)]
    client = fake(*answers, answer("found", 41.0), answer("not_found"))
    tracker = Tracker(client, "m", camera=K)
    assert asked_with(tracker, [0, 1, 2, 3, 4], client)[2:] == [[2.0], [3.0], [3.0, 4.0]]
    assert tracker.state().status == "lost"
    tracker.reset("a lift")
    tracker.update(depth(5), ahead(5), stamp=5.0)
    assert client.requests[-1]["frames"] == [5.0]


def test_frames_that_were_not_answered_or_are_old_are_not_sent_again():
    not_found = answer("not_found")
    client = fake(not_found, errors.Busy("busy"), errors.UselessFrame("blank"), not_found)
    tracker = Tracker(client, "m", camera=K)
    # the blank frame is refused with the one before it, then alone
    assert asked_with(tracker, [1, 2], client) == [[1.0], [1.0, 2.0]]
    client.answers[3:] = [errors.UselessFrame("blank"), not_found]
    assert tracker.update(depth(2.5), ahead(2.5), stamp=2.0).reason == "blank"
    assert [request["frames"] for request in client.requests[2:]] == [[1.0, 2.5], [2.5]]
    tracker.update(depth(3), ahead(3), stamp=3.0)
    tracker.update(depth(3.5), ahead(3.5), stamp=32.0)  # 32 s after the first
    assert [request["frames"] for request in client.requests[4:]] == [[1.0, 3.0], [3.0, 3.5]]


@pytest.mark.parametrize("error", [errors.UselessFrame("blank"), errors.TooLarge("3 MB")])
def test_where_earlier_frames_are_refused_it_asks_with_the_last_alone(error):
    client = fake(answer("not_found"), error, answer("not_found"))
    tracker = Tracker(client, "m", camera=K)
    requests = asked_with(tracker, [1, 2, 3], client)
    assert requests == [[1.0], [1.0, 2.0], [2.0], [2.0, 3.0]]


def test_answers_that_share_frames_or_nearly_are_one_view():
    # weak answers are a fix where their frames lie more than 0.3 m apart, each from each
    way = (1.0, 1.2, 1.4, 1.6, 1.8)
    for frames, tracks_from in ((1, 1.4), (2, 1.6), (3, 1.8)):
        client, log = fake(*(answer("found", x, support=1) for x in way)), io.StringIO()
        parameters = TrackerParameters(frames=frames)
        tracker = Tracker(client, "m", camera=K, parameters=parameters, log=log)
        states = [tracker.update(depth(x), ahead(x), stamp=x) for x in way]
        assert [state.status == "tracking" for state in states] == [x >= tracks_from for x in way]
        assert all(map(equal, replay(log.getvalue().splitlines()), states))


# Runs through synthetic buildings, against a service in this process.


def drifted(poses, seed, share=0.01):
    """Odometry that begins at the origin: too long by a share, turning by 0.1 deg/m, and noisy."""
    rng = np.random.default_rng(seed)
    odometry = [np.eye(4)]
    for a, b in pairwise(poses):
        moved = inverse(a) @ b
        way = np.linalg.norm(moved[:3, 3])
        moved[:3, 3] += share * moved[:3, 3] + rng.normal(0, share * way, 3)
        moved[:3, :3] = moved[:3, :3] @ rotation_matrix(np.radians([0, 0.1 * way, 0]))
        odometry.append(odometry[-1] @ moved)
    return odometry


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["object", "offices"])
@pytest.mark.parametrize("index", range(4))
def test_beside_what_looks_alike_it_never_tracks_wrongly(client, map_name, kind, index):
    site = synthesise_lookalike(kind, 7000, index, queries=12)
    k = site.map[0].intrinsics
    camera = camera_of((k.fx, k.fy, k.cx, k.cy), (k.width, k.height))
    client.create_map(map_name, model="depth")
    jobs = []
    for view in site.map:
        pose = GivenPose(parent_frame="building", matrix=view.pose.tolist())
        meta = FrameMeta(intrinsics=camera, session="walk", pose=pose)
        jobs.append(client.upload(map_name, view.depth, meta).job_id)
    client.wait(jobs)
    tracker = Tracker(client, map_name, camera=camera)
    truth = [query.pose for query in site.queries]
    travelled = 0.0  # since the last fix; the views are up to 20 m apart, and odometry drifts
    for i, T in enumerate(drifted(truth, index)):
        state = tracker.update(site.queries[i].depth, T, stamp=0.4 * i)
        travelled = (
            0.0 if state.age == 0 else travelled + difference(truth[max(i - 1, 0)], truth[i])[0]
        )
        if state.status == "tracking":
            assert difference(state.T_map_sensor, truth[i])[0] < 0.3 + 0.03 * travelled
