"""From matches to a pose: votes by place, competitors, the map's frames, priors and sequences."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from sceneprint.formats.artifact import read_geometry, write_geometry
from sceneprint.geometry.pose.rigid import inverse
from sceneprint.geometry.validation.map_verification import (
    MapParameters,
    MapViews,
    compare_poses,
    map_frame,
    score_pose,
)
from sceneprint.geometry.validation.overlap import OverlapParameters
from sceneprint.geometry.validation.validation import PairValidation
from sceneprint.lab.synth import KINECT, render, symmetric_box, synthesise_room
from sceneprint.localization import (
    LocalizationParameters,
    PoseEstimate,
    PosePrior,
    QueryFrame,
    is_expected,
    localize,
    views_of_rows,
)
from sceneprint.matches import PairMatch, associate
from sceneprint.pipeline import Signer, open_signer, prepare, retrieve
from sceneprint.types import DepthFrame, Floats, Geometry


def outcome(
    status: str = "accepted", strength: str | None = "strong", T: Floats | None = None
) -> PairValidation:
    """What `validate` might have said."""
    T = np.eye(4) if T is None else T
    return PairValidation(
        status,  # type: ignore[arg-type]
        strength if status == "accepted" else None,  # type: ignore[arg-type]
        "as given", T, 0.01, 0.01, 0.5, 0.4, 0.0, 100, 0.0,
        None, 0, hypotheses=T[None],
    )  # fmt: skip


def shifted(x: float, y: float = 0.0) -> Floats:
    T = np.eye(4)
    T[:2, 3] = x, y
    return T


def about_up(degrees: float) -> Floats:
    """A turn about z."""
    T, a = np.eye(4), math.radians(degrees)
    T[:2, :2] = [[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]]
    return T


def match(index: int, validation: PairValidation) -> PairMatch:
    return PairMatch(index, 10, 0.5, validation)


@pytest.fixture(scope="module")
def signer() -> Signer:
    return open_signer("depth")


@pytest.fixture(scope="module")
def blank(room_frames: tuple[DepthFrame, ...], signer: Signer) -> Geometry:
    """A query's artifact where the map is not asked: any."""
    return prepare(room_frames[0], signer)[1]


#: Rows of a database a metre apart: viewpoints that differ.
ROWS = [shifted(float(i)) for i in range(12)]


def seen_at(x: float, rows: Sequence[int], strength: str = "strong") -> list[PairMatch]:
    """Matches of some rows that all say that the query is at x."""
    return [match(i, outcome(T=inverse(ROWS[i]) @ shifted(x), strength=strength)) for i in rows]


def by_pairs(blank: Geometry, matches: Sequence[PairMatch]) -> PoseEstimate | None:
    """What the matches alone decide."""
    return localize([QueryFrame(blank, matches)], ROWS)


# Votes by hand


def test_the_pose_of_a_match_leads_to_that_of_the_query(blank: Geometry) -> None:
    turn = np.array([[0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]], float)
    frame = QueryFrame(blank, [match(1, outcome(T=shifted(2.0)))])
    found = localize([frame], [np.eye(4), turn], ["here", "there"])
    assert found is not None
    assert found.average is not None
    np.testing.assert_allclose(found.average.T, turn @ shifted(2.0), atol=1e-12)
    assert (found.status, found.parent, found.votes, found.members) == ("found", "there", 1, (1,))
    assert found.reason == "one match gives the pose; one view, unconfirmed"
    assert (found.rival_ratio, found.verified_by, found.alternatives) == (None, "matches", ())


@pytest.mark.parametrize(
    ("here", "there", "status", "alternatives"),
    [
        (2, 1, "found", 0),  # twice the weight
        (3, 2, "ambiguous", 2),
        (1, 1, "ambiguous", 2),
        (5, 2, "found", 0),
    ],
)
def test_a_pose_is_found_where_it_outweighs_every_other(
    blank: Geometry, here: int, there: int, status: str, alternatives: int
) -> None:
    matches = seen_at(0.0, range(here)) + seen_at(5.0, range(here, here + there))
    found = by_pairs(blank, matches)
    assert found is not None
    assert (found.status, len(found.alternatives)) == (status, alternatives)
    assert found.votes == here + there
    if status == "found":
        assert found.average is not None
        assert (found.average.support, found.average.T[0, 3]) == (here, pytest.approx(0.0))
    else:
        assert found.average is None
        assert "none of their poses" in found.reason
        told = [(one.weight, one.support, one.T[0, 3]) for one in found.alternatives]
        assert told == [(here, here, pytest.approx(0.0)), (there, there, pytest.approx(5.0))]


def test_weak_and_ambiguous_matches_weigh_less_and_still_compete(blank: Geometry) -> None:
    weak = by_pairs(blank, seen_at(0.0, [0, 1, 2], "weak"))
    assert weak is not None
    assert (weak.status, weak.strength) == ("ambiguous", None)
    assert weak.alternatives[0].weight == pytest.approx(1.2)
    assert "weak" in weak.reason
    # strength is that of the winning place: a strong match elsewhere lends none
    mixed = by_pairs(blank, seen_at(0.0, [0, 1, 2, 3, 4, 5], "weak") + seen_at(5.0, [6]))
    assert mixed is not None
    assert mixed.status == "ambiguous"
    unsure = match(3, outcome("ambiguous", T=inverse(ROWS[3]) @ shifted(5.0)))
    assert by_pairs(blank, [*seen_at(0.0, [0]), unsure]).status == "found"  # type: ignore[union-attr]
    two = [unsure, match(4, outcome("ambiguous", T=inverse(ROWS[4]) @ shifted(5.0)))]
    assert by_pairs(blank, [*seen_at(0.0, [0]), *two]).status == "ambiguous"  # type: ignore[union-attr]


def test_rejected_matches_do_not_vote(blank: Geometry) -> None:
    lost = replace(outcome("rejected"), T_match_query=None, hypotheses=np.empty((0, 4, 4)))
    found = by_pairs(blank, [*seen_at(0.0, [0]), match(1, outcome("rejected")), match(2, lost)])
    assert found is not None
    assert (found.status, found.votes) == ("found", 1)
    assert by_pairs(blank, [match(1, outcome("rejected")), match(2, lost)]) is None
    assert by_pairs(blank, []) is None


def test_poses_of_one_parent_frame_are_compared(blank: Geometry) -> None:
    # three matches of a hall, two of a flat whose coordinates mean something else
    parents = ["flat", "hall", "flat", "hall", "hall", "attic"]
    poses = [shifted(0.0, y=float(i)) for i in range(6)]
    matches = [match(i, outcome(T=inverse(poses[i]) @ shifted(0.01 * i))) for i in range(5)]
    found = localize([QueryFrame(blank, matches)], poses, parents)
    assert found is not None
    assert found.average is not None
    assert (found.parent, found.votes) == ("hall", 3)
    assert found.average.T[0, 3] == pytest.approx((0.01 + 0.03 + 0.04) / 3)
    found = localize([QueryFrame(blank, matches[:4])], poses, parents)
    assert found is not None
    assert found.average is not None
    assert (found.parent, found.average.T[0, 3]) == ("flat", pytest.approx(0.01))


def test_five_votes_are_averaged(blank: Geometry) -> None:
    found = by_pairs(blank, [m for i in range(8) for m in seen_at(0.01 * i, [i])])
    assert found is not None
    assert found.average is not None
    assert (found.average.votes, len(found.members), found.votes) == (5, 8, 8)
    assert found.average.T[0, 3] == pytest.approx(0.02)


# Properties


def test_a_copy_of_a_view_is_no_second_vote(blank: Geometry) -> None:
    """Whatever is uploaded twice, ambiguous never becomes found."""
    rows = [*ROWS, *(T @ shifted(0.01) for T in ROWS)]  # each viewpoint again, a centimetre off
    both = [*seen_at(0.0, [0]), *seen_at(5.0, [1])]
    copy = match(12, outcome(T=inverse(rows[12]) @ shifted(0.0)))
    for matches in ([*both], [*both, copy], [*both, copy, copy]):
        found = localize([QueryFrame(blank, matches)], rows)
        assert found is not None
        assert (found.status, {one.weight for one in found.alternatives}) == ("ambiguous", {1.0})
    other = localize([QueryFrame(blank, [*both, *seen_at(0.0, [2])])], rows)
    assert other is not None
    assert other.status == "found"


def test_the_order_of_candidates_changes_no_status(blank: Geometry) -> None:
    matches = [
        *seen_at(0.0, [0, 1]), *seen_at(5.0, [2], "weak"), *seen_at(9.0, [3], "weak"),
        match(4, outcome("ambiguous", T=inverse(ROWS[4]) @ shifted(5.0))),
    ]  # fmt: skip
    statuses = set()
    for order in itertools.permutations(matches):
        found = by_pairs(blank, order)
        assert found is not None
        statuses.add(
            (found.status, found.members if found.status != "found" else frozenset((0, 1)))
        )
    assert statuses == {("found", frozenset((0, 1)))}


# The map's frames


@pytest.fixture(scope="module")
def box_views(signer: Signer) -> tuple[list[Floats], list[Geometry]]:
    """Views of a cube on a bare floor, from all around: every 30 degrees at two metres."""
    room, views, poses = symmetric_box(), [], []
    for degrees in range(0, 360, 30):
        T = looking_at_the_box(float(degrees))
        depth = render(room, T, KINECT)
        frame = DepthFrame(depth, KINECT, f"{degrees}", T)
        poses.append(T)
        views.append(read_geometry(write_geometry(prepare(frame, signer)[1])))
    return poses, views


def looking_at_the_box(degrees: float) -> Floats:
    """A camera two metres from the origin, a metre up, its optical axis through the box."""
    eye = about_up(degrees)[:3, :3] @ np.array([2.0, 0.0, 1.0])
    z = np.array([0.0, 0.0, 0.3]) - eye
    z /= np.linalg.norm(z)
    x = np.cross(z, (0.0, 0.0, 1.0))
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    T[:3, 3] = eye
    return T


def test_a_room_bears_out_the_true_pose_alone(signer: Signer) -> None:
    p, overlap_p = MapParameters(), OverlapParameters()
    frames = synthesise_room(21, 0, 3, along_path=True).frames
    geometries = [prepare(frame, signer)[1] for frame in frames]
    poses = np.stack([frame.pose for frame in frames if frame.pose is not None])
    views = MapViews(poses[1:3], geometries[1:3].__getitem__, p, overlap_p)
    query = map_frame(geometries[0], np.eye(4), p, overlap_p)
    here = score_pose([query], poses[0], views, p, overlap_p)
    assert here.score > 0.4
    assert here.violations + here.hidden < 0.02
    assert here.share == pytest.approx(here.planes / float(query.planes.weights.sum()), rel=1e-6)
    shift, turn = poses[0].copy(), poses[0] @ about_up(90)
    shift[0, 3] += 0.6
    wrong = [score_pose([query], T, views, p, overlap_p) for T in (shift, turn)]
    assert max(one.score for one in wrong) < 0.3 * here.score
    assert all(one.violations + one.hidden > 0.05 or one.share < 0.1 for one in wrong)
    ranked = compare_poses([query], np.stack([shift, turn, poses[0]]), views, p, overlap_p)
    np.testing.assert_allclose(ranked[0].T, poses[0], atol=0.03)
    # nothing of this depends on where the world's origin lies
    W = about_up(33.0)
    W[:3, 3] = 7.0, -3.0, 0.5
    moved = MapViews(W @ poses[1:3], geometries[1:3].__getitem__, p, overlap_p)
    again = score_pose([query], W @ poses[0], moved, p, overlap_p)
    assert again.score == pytest.approx(here.score, abs=0.02)


def box_query(
    box_views: tuple[list[Floats], list[Geometry]], signer: Signer, prior: PosePrior | None = None
) -> tuple[PoseEstimate, Floats]:
    """A view between two of the map, asked of all."""
    poses, views = box_views
    T = looking_at_the_box(45.0)
    frame = DepthFrame(render(symmetric_box(), T, KINECT), KINECT, "query", T)
    signature, geometry = prepare(frame, signer)
    signatures = [
        prepare(DepthFrame(render(symmetric_box(), P, KINECT), KINECT, "", P), signer)[0]
        for P in poses
    ]
    ranking = retrieve(signature, signatures, signer.model)
    matches = associate(geometry, ranking, range(len(views)), views.__getitem__)
    views_of = views_of_rows(matches, poses, views.__getitem__)
    found = localize([QueryFrame(geometry, matches)], poses, None, views_of, prior)
    assert found is not None
    return found, T


def test_a_cube_is_ambiguous_by_quarter_turns_until_a_prior_decides(
    box_views: tuple[list[Floats], list[Geometry]], signer: Signer
) -> None:
    found, T = box_query(box_views, signer)
    assert (found.status, found.average, found.rival_ratio) == (
        "ambiguous", None, pytest.approx(1.0, abs=0.1),
    )  # fmt: skip
    turns = [about_up(quarter * 90.0) @ T for quarter in range(4)]
    near = [
        min(float(np.linalg.norm(one.T[:3, 3] - turn[:3, 3])) for turn in turns)
        for one in found.alternatives
    ]
    assert len(near) > 1
    assert max(near) < 0.2
    covariance = np.diag([0.2**2] * 3 + [math.radians(6) ** 2] * 3)
    for turn in turns[:2]:  # the map cannot tell which, and the robot can
        start = turn.copy()
        start[:3, 3] += 0.12, -0.1, 0.05
        sure, _ = box_query(box_views, signer, PosePrior("", start, covariance))
        assert sure.average is not None
        assert (sure.status, sure.verified_by) == ("found", "prior")
        np.testing.assert_allclose(sure.average.T, turn, atol=0.05)
    far = T.copy()
    far[:3, 3] += 2.0, 2.0, 0.0
    wrong, _ = box_query(box_views, signer, PosePrior("", far, covariance))
    assert wrong.status == "ambiguous"  # of a prior that is wrong by metres nothing becomes found


def test_a_pose_is_expected_within_the_mass_of_its_prior() -> None:
    prior = PosePrior("", shifted(1.0), np.diag([0.01] * 3 + [0.0004] * 3))
    # chi-square of six degrees of freedom: 22.458 holds 99.9 %
    assert is_expected(shifted(1.0 + 0.1 * math.sqrt(22.4)), prior)
    assert not is_expected(shifted(1.0 + 0.1 * math.sqrt(22.5)), prior)
    assert is_expected(shifted(1.0) @ about_up(math.degrees(0.02 * math.sqrt(22.4))), prior)
    assert not is_expected(shifted(1.0) @ about_up(math.degrees(0.02 * math.sqrt(22.6))), prior)


# Several frames


def test_frames_of_a_sequence_vote_for_the_pose_of_the_last(blank: Geometry) -> None:
    """Each match places its own frame; odometry brings that to the last."""
    before = shifted(-1.0) @ about_up(20.0)  # T_query_sensor of the frame before
    truth = about_up(40.0) @ shifted(3.0)
    first = [match(i, outcome(T=inverse(ROWS[i]) @ truth @ before)) for i in (0, 1)]
    last = [match(2, outcome(T=inverse(ROWS[2]) @ truth))]
    alone = by_pairs(blank, [*last, *seen_at(9.0, [3])])
    assert alone is not None
    assert alone.status == "ambiguous"
    frames = [QueryFrame(blank, first, before), QueryFrame(blank, [*last, *seen_at(9.0, [3])])]
    found = localize(frames, ROWS)
    assert found is not None
    assert found.average is not None
    assert (found.status, found.average.support, found.votes) == ("found", 3, 4)
    np.testing.assert_allclose(found.average.T, truth, atol=1e-12)


def test_the_numbers_are_those_of_the_docs() -> None:
    p = LocalizationParameters()
    told = (p.weak, p.outweigh, p.rival, p.violations, p.map_score, p.rival_unsure, p.map_planes)
    assert told == (0.4, 2.0, 0.9, 0.05, 0.3, 0.3, 12.0)
