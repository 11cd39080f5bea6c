"""Tests of poses from matches: votes, competitors, parent frames, priors and sequences."""

import math
from dataclasses import replace

import numpy as np
import pytest

from sceneprint.formats.artifact import read_geometry, write_geometry
from sceneprint.geometry.registration.overlap import OverlapParameters
from sceneprint.geometry.retrieval.ranking import Ranking
from sceneprint.geometry.rigid import inverse
from sceneprint.geometry.validation.confidence import (
    KNOTS,
    ConfidenceModel,
    ConfidenceParameters,
    Penalty,
)
from sceneprint.geometry.validation.map_verification import (
    MapParameters,
    MapViews,
    compare_poses,
    map_frame,
    median_contradiction,
    prior_starts,
    score_pose,
)
from sceneprint.geometry.validation.validation import PairValidation
from sceneprint.localization import (
    PosedFrame,
    decide,
    localize,
    mark_unconfirmed,
    rival_rows,
    views_of_rows,
)
from sceneprint.pipeline import PairMatch, open_signer, prepare
from sceneprint.places import LocalizationParameters, PosePrior, QueryFrame
from sceneprint.types import DepthFrame, Geometry, Intrinsics, Patches, Surface
from sceneprint_lab.synth import KINECT, render, symmetric_box
from tests.test_lookalikes import looking


def outcome(status="accepted", strength="strong", T=None):
    T = np.eye(4) if T is None else T
    return PairValidation(
        status,
        strength if status == "accepted" else None,
        "as given", T, 0.01, 0.01, 0.5, 0.4, 0.0, 100, 0.0,
        None, 0, hypotheses=T[None],
    )  # fmt: skip


def shifted(x, y=0.0):
    T = np.eye(4)
    T[:2, 3] = x, y
    return T


def about_up(degrees):
    T, a = np.eye(4), math.radians(degrees)
    T[:2, :2] = [[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]]
    return T


def match(index, validation):
    return PairMatch(index, 10, 0.5, validation)


@pytest.fixture(scope="module")
def signer():
    return open_signer("depth")


@pytest.fixture(scope="module")
def blank(room_frames, signer):
    """Return any artifact, for queries that are not compared with the map."""
    return prepare(room_frames[0], signer)[1]


#: Rows of a database a metre apart: viewpoints that differ.
ROWS = [shifted(float(i)) for i in range(12)]


def seen_at(x, rows, strength="strong"):
    """Matches of some rows that all say that the query is at x."""
    return [match(i, outcome(T=inverse(ROWS[i]) @ shifted(x), strength=strength)) for i in rows]


def by_pairs(blank, matches):
    return localize([QueryFrame(blank, matches)], ROWS)


def test_the_pose_of_a_match_leads_to_that_of_the_query(blank):
    turn = np.array([[0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]], float)
    frame = QueryFrame(blank, [match(1, outcome(T=shifted(2.0)))])
    found = localize([frame], [np.eye(4), turn], ["here", "there"])
    np.testing.assert_allclose(found.average.T, turn @ shifted(2.0), atol=1e-12)
    assert (found.status, found.parent, found.votes, found.members) == ("found", "there", 1, (1,))
    assert found.reason == "one match determines the pose"
    assert (found.evidence, found.confidence, found.verified_by) == (None, None, "matches")
    [itself] = found.alternatives
    assert (itself.T.tolist(), itself.support) == (found.average.T.tolist(), 1)


def test_the_covariance_of_an_earlier_frame_refers_to_the_localized_frame(blank):
    """Its sensor is 2 m ahead in x, so its errors of rotation move the pose in y and z."""
    certain = replace(outcome(T=shifted(3.0)), covariance=np.eye(6) * 1e-4)
    answer = localize(
        [QueryFrame(blank, []), QueryFrame(blank, [match(0, certain)], shifted(2.0))], ROWS
    )
    np.testing.assert_allclose(answer.average.T, shifted(1.0), atol=1e-12)
    assert answer.covariance is not None
    np.testing.assert_allclose(np.diag(answer.covariance)[:3], [1e-4, 5e-4, 5e-4], rtol=1e-6)


def test_near_views_and_certain_matches_count_more(blank):
    """The query is at x = 0, and a camera in row 0 looks the same way as the query."""

    def located(rows, deviations):
        matches = [
            match(
                row,
                replace(outcome(T=inverse(ROWS[row]) @ shifted(0.03 * (i + 1))),
                        covariance=np.eye(6) * deviation**2),
            )
            for i, (row, deviation) in enumerate(zip(rows, deviations, strict=True))
        ]  # fmt: skip
        answer = by_pairs(blank, matches)
        return float(answer.average.T[0, 3])

    # equal separations: 4 parts of the first, 1 of the second
    assert located([1, 1], [0.01, 0.02]) == pytest.approx((4 * 0.03 + 0.06) / 5, abs=1e-3)
    near, far = (1 + (30 * abs(row - x) / 3.5) ** 2 for row, x in ((0, 0.03), (2, 0.06)))
    expected = (0.03 / near + 0.06 / far) / (1 / near + 1 / far)
    assert located([0, 2], [0.01, 0.01]) == pytest.approx(expected, abs=1e-6)
    assert expected < 0.0302


@pytest.mark.parametrize(
    ("here", "there", "status", "alternatives"),
    [
        (2, 1, "found", 1),  # twice the weight
        (3, 2, "ambiguous", 2),
        (1, 1, "ambiguous", 2),
        (5, 2, "found", 1),
    ],
)
def test_a_pose_is_found_where_it_outweighs_every_other(blank, here, there, status, alternatives):
    matches = seen_at(0.0, range(here)) + seen_at(5.0, range(here, here + there))
    answer = by_pairs(blank, matches)
    assert (answer.status, len(answer.alternatives)) == (status, alternatives)
    assert answer.votes == here + there
    if status == "found":
        assert (answer.average.support, answer.average.T[0, 3]) == (here, pytest.approx(0.0))
    else:
        assert answer.average is None
        assert "less than twice the weight" in answer.reason
        others = [(alternative.support, alternative.T[0, 3]) for alternative in answer.alternatives]
        assert others == [(here, pytest.approx(0.0)), (there, pytest.approx(5.0))]


def test_weak_and_ambiguous_matches_weigh_less_and_still_compete(blank):
    weak = by_pairs(blank, seen_at(0.0, [0, 1, 2], "weak"))
    assert (weak.status, weak.strength) == ("ambiguous", None)
    assert weak.alternatives[0].support == 3
    assert "weak" in weak.reason
    # strength is that of the winning place: a strong match elsewhere lends none
    mixed = by_pairs(blank, seen_at(0.0, [0, 1, 2, 3, 4, 5], "weak") + seen_at(5.0, [6]))
    assert mixed.status == "ambiguous"
    unsure = match(3, outcome("ambiguous", T=inverse(ROWS[3]) @ shifted(5.0)))
    assert by_pairs(blank, [*seen_at(0.0, [0]), unsure]).status == "found"
    two = [unsure, match(4, outcome("ambiguous", T=inverse(ROWS[4]) @ shifted(5.0)))]
    assert by_pairs(blank, [*seen_at(0.0, [0]), *two]).status == "ambiguous"


def test_rejected_matches_do_not_vote(blank):
    lost = replace(outcome("rejected"), T_match_query=None, hypotheses=np.empty((0, 4, 4)))
    answer = by_pairs(blank, [*seen_at(0.0, [0]), match(1, outcome("rejected")), match(2, lost)])
    assert (answer.status, answer.votes) == ("found", 1)
    assert by_pairs(blank, [match(1, outcome("rejected")), match(2, lost)]) is None
    assert by_pairs(blank, []) is None


def test_poses_of_one_parent_frame_are_compared(blank):
    # three matches of a hall, two of a flat whose coordinates mean something else
    parents = ["flat", "hall", "flat", "hall", "hall", "attic"]
    poses = [shifted(0.0, y=float(i)) for i in range(6)]
    matches = [match(i, outcome(T=inverse(poses[i]) @ shifted(0.01 * i))) for i in range(5)]
    answer = localize([QueryFrame(blank, matches)], poses, parents)
    assert (answer.parent, answer.votes) == ("hall", 3)
    assert answer.average.T[0, 3] == pytest.approx((0.01 + 0.03 + 0.04) / 3)
    answer = localize([QueryFrame(blank, matches[:4])], poses, parents)
    assert (answer.parent, answer.average.T[0, 3]) == ("flat", pytest.approx(0.01))


def test_five_votes_are_averaged(blank):
    answer = by_pairs(blank, [m for i in range(8) for m in seen_at(0.01 * i, [i])])
    assert (answer.average.votes, len(answer.members), answer.votes) == (5, 8, 8)
    assert answer.average.T[0, 3] == pytest.approx(0.02)


def test_a_copy_of_a_view_is_no_second_vote(blank):
    """Whatever is uploaded twice, ambiguous never becomes found."""
    rows = [*ROWS, *(T @ shifted(0.01) for T in ROWS)]  # each viewpoint again, a centimetre off
    both = [*seen_at(0.0, [0]), *seen_at(5.0, [1])]
    copy = match(12, outcome(T=inverse(rows[12]) @ shifted(0.0)))
    for matches in ([*both], [*both, copy], [*both, copy, copy]):
        answer = localize([QueryFrame(blank, matches)], rows)
        assert (answer.status, {a.support for a in answer.alternatives}) == ("ambiguous", {1})
    other = localize([QueryFrame(blank, [*both, *seen_at(0.0, [2])])], rows)
    assert other.status == "found"


@pytest.fixture(scope="module")
def box_views(signer):
    """Views of a cube on a bare floor, from all around: every 30 degrees at two metres."""
    room, views, poses = symmetric_box(), [], []
    for degrees in range(0, 360, 30):
        T = looking_at_the_box(float(degrees))
        depth = render(room, T, KINECT)
        frame = DepthFrame(depth, KINECT, f"{degrees}", T)
        poses.append(T)
        views.append(read_geometry(write_geometry(prepare(frame, signer)[1])))
    return poses, views


def looking_at_the_box(degrees):
    """A camera two metres from the origin, a metre up, its optical axis through the box."""
    eye = about_up(degrees)[:3, :3] @ np.array([2.0, 0.0, 1.0])
    return looking(eye, np.array([0.0, 0.0, 0.3]))


@pytest.fixture(scope="module")
def path(signer, room_views):
    """Geometries and poses of three frames along a path; the map has the last two."""
    frames = room_views(21, 0, 4, along_path=True).frames[:3]
    geometries = [prepare(frame, signer)[1] for frame in frames]
    return geometries, np.stack([frame.pose for frame in frames])


def test_a_room_bears_out_the_true_pose_alone(path):
    p, overlap_p = MapParameters(), OverlapParameters()
    geometries, poses = path
    views = MapViews(poses[1:3], geometries[1:3].__getitem__, p, overlap_p)
    query = map_frame(geometries[0], np.eye(4), p, overlap_p)
    here = score_pose([query], poses[0], views, p, overlap_p)
    assert here.score > 0.4
    assert here.violations + here.hidden < 0.02
    assert here.share == pytest.approx(here.planes / float(query.planes.weights.sum()), rel=1e-6)
    shift, turn = poses[0].copy(), poses[0] @ about_up(90)
    shift[0, 3] += 0.6
    wrong = [score_pose([query], T, views, p, overlap_p) for T in (shift, turn)]
    assert max(place.score for place in wrong) < 0.3 * here.score
    assert all(place.violations + place.hidden > 0.05 or place.share < 0.1 for place in wrong)
    ranked = compare_poses([query], np.stack([shift, turn, poses[0]]), views, p, overlap_p)
    np.testing.assert_allclose(ranked[0].T, poses[0], atol=0.03)
    # the pose may be that of a frame that was taken elsewhere, by odometry
    before = shifted(-1.0) @ about_up(20.0)
    earlier = map_frame(geometries[0], before, p, overlap_p)
    start = poses[0] @ inverse(before)
    start[:3, 3] += 0.05, -0.04, 0.03
    (drawn, *_) = compare_poses([earlier], start[None], views, p, overlap_p)
    np.testing.assert_allclose(drawn.T, poses[0] @ inverse(before), atol=0.02)


def test_frames_of_another_room_contradict_the_map(path, room_views, signer):
    p, overlap_p = MapParameters(), OverlapParameters()
    (here, *seen), (T, *poses) = path
    wrong = prepare(room_views(21, 2, 4, along_path=True).frames[0], signer)[1]
    views = MapViews(np.stack(poses), seen.__getitem__, p, overlap_p)

    def contradiction(*posed):
        return median_contradiction(posed, views, p, overlap_p)

    drifted = shifted(0.15) @ T  # contradicts the map until the pose is refined
    scored = score_pose([map_frame(here, np.eye(4), p, overlap_p)], drifted, views, p, overlap_p)
    assert scored.violations + scored.hidden > 0.2
    assert contradiction((here, T)) == pytest.approx(0.0, abs=0.02)
    assert contradiction((here, drifted)) == pytest.approx(0.0, abs=0.02)
    scored = score_pose([map_frame(wrong, np.eye(4), p, overlap_p)], T, views, p, overlap_p)
    most = contradiction((wrong, T))
    assert most == pytest.approx((scored.violations + scored.hidden) / 2.0, abs=0.05)
    assert 0.6 < most <= 1.0
    assert contradiction((here, T), (wrong, T), (here, T)) == contradiction((here, T))
    assert contradiction((wrong, T), (here, T), (wrong, T)) == most
    far = shifted(50.0) @ T  # no frame of the map agrees there, so it does not count
    assert contradiction((here, far), (wrong, T)) == most
    assert contradiction((here, far)) == 0.0


def test_a_pose_is_expected_within_the_mass_of_its_prior():
    prior = PosePrior("", shifted(1.0), np.diag([0.01] * 3 + [0.0004] * 3))
    # chi-square of six degrees of freedom: 22.458 holds 99.9 %
    assert prior.expects(shifted(1.0 + 0.1 * math.sqrt(22.4)))
    assert not prior.expects(shifted(1.0 + 0.1 * math.sqrt(22.5)))
    assert prior.expects(shifted(1.0) @ about_up(math.degrees(0.02 * math.sqrt(22.4))))
    assert not prior.expects(shifted(1.0) @ about_up(math.degrees(0.02 * math.sqrt(22.6))))


# What the map's frames decide, by hand

#: A picture of so many tiles shows a wall in each, square to the optical axis. No two are one
#: plane, so that each tile weighs 1.
TILES = 60
TILED = Intrinsics(100, 60, 100.0, 100.0, 49.5, 29.5)
#: How much farther off than in the query's picture a wall is, metres: it agrees, the map saw
#: through the query's, or the query through the map's; or there is none.
SAME, FARTHER, NEARER, NOTHING = 0.0, 20.0, -10.0, math.nan
#: Lengths do not grow with depth, poses are not refined, and the map is not asked for its noise.
FIXED = OverlapParameters(growth=0)
#: Odds of e^8 with the best evidence; 0.99 alone is e^4.6. Only these kinds cost anything.
_OF_FRAMES = ConfidenceParameters(
    best=8.0,
    planes=Penalty(9.0, 5.0, 0.0),  # 0 from 12 planes on, 5 at 6
    excess=Penalty(8.0, 6.0, 3.0),  # 3 at 5 %, 6 at 12 %
    rival=Penalty(6.0, 4.0, 1.0),  # 1 at half its score, 4 at 0.8, 6 from its own score on
    suggested=Penalty(4.0, 4.0, 0.0),  # 4 if only one view suggests the pose
    **{
        name: Penalty(0.0, 0.0, 0.0)
        for name in KNOTS
        if name not in ("planes", "excess", "rival", "suggested")
    },
)
#: Of views of a surface, what is missing says nothing.
JUDGEMENT = ConfidenceModel(_OF_FRAMES, replace(_OF_FRAMES, excess=Penalty(0.0, 0.0, 0.0)))
BY_HAND = LocalizationParameters(map=MapParameters(n_refining=0, n_noise=0), judgement=JUDGEMENT)
#: Places of the map lie so far apart, metres: what one shows tells nothing of another.
APART = 100.0


def picture(*tiles):
    """Runs of tiles, the first row first: how many, and how much farther off."""
    off = np.full(TILES, NOTHING)
    offsets = np.repeat([away for _, away in tiles], [count for count, _ in tiles])
    off[: len(offsets)] = offsets
    depth = np.nan_to_num(20.0 + 0.1 * np.arange(TILES) + off)
    image = np.kron(depth.reshape(6, 10), np.ones((10, 10)))
    y, x = np.mgrid[:60, :100]
    rays = np.dstack([(x - TILED.cx) / TILED.fx, (y - TILED.cy) / TILED.fy, np.ones_like(image)])
    points, valid = rays * image[..., None], image > 0
    normals = np.where(valid[..., None], (0.0, 0.0, -1.0), 0.0)
    surface = Surface(
        points.astype(np.float32), normals.astype(np.float32), valid,
        valid.astype(np.float32), TILED,
    )  # fmt: skip
    shown = depth > 0
    means = points[5::10, 5::10].reshape(-1, 3)[shown]
    n = len(means)
    patches = Patches(
        means, np.tile((0.0, 0.0, -1.0), (n, 1)), np.ones(n), np.full(n, 100, np.int32), np.ones(n)
    )
    return Geometry(surface, patches, np.zeros((n, 16), np.uint8), "a" * 64)


WHOLE = picture((TILES, SAME))


def told_by(*places, parent="", rendered=None):
    """A map with these pictures at each place, in the parent frame of that name alone."""
    pictures = [one for place in places for one in place]
    poses = [shifted(APART * k) for k, place in enumerate(places) for _ in place]

    def views_of(frame, at):
        opened = pictures.__getitem__ if frame == parent else lambda _: None
        return MapViews(np.stack(poses), opened, BY_HAND.map, FIXED, rendered=rendered)

    return views_of


def suggested_at(x, row, status="rejected"):
    """A match that votes for nothing, or for little, and suggests a pose."""
    return match(row, outcome(status, T=inverse(ROWS[row]) @ shifted(x)))


def judged(matches, *places, query=WHOLE, prior=None, p=BY_HAND):
    """What comes of matches of the whole picture where the map has these."""
    frames = [QueryFrame(query, matches)]
    answer = localize(frames, ROWS, None, told_by(*places), prior, p, FIXED)
    assert answer is not None
    return answer


def at_place(k, answer):
    return answer.average is not None and np.allclose(answer.average.T, shifted(APART * k))


def near_place(k, deviation=0.1):
    return PosePrior("", shifted(APART * k), np.eye(6) * deviation**2)


def test_a_score_by_hand():
    views = told_by([
        picture((40, SAME), (10, FARTHER)),
        picture((45, SAME), (5, NOTHING), (3, NEARER)),
        picture((30, SAME), (10, FARTHER)),
        picture((1, SAME), (20, NEARER)),  # agrees too little to have a say in what is hidden
        picture(),
    ])("", np.empty((0, 4, 4)))  # fmt: skip
    query = map_frame(WHOLE, np.eye(4), BY_HAND.map, FIXED)
    score = score_pose([query], np.eye(4), views, BY_HAND.map, FIXED)
    # tiles 0 to 39 have more for than against, 40 to 44 as much, 45 to 49 are seen through
    violations, hidden = 5 / 45, 3 / (40 + 45 + 30 + 3)
    assert (score.views, score.planes) == (((0, 1), (0, 0), (0, 2)), 40.0)
    assert (score.share, score.violations, score.hidden) == pytest.approx(
        (40 / 60, violations, hidden)
    )
    assert score.score == pytest.approx(40 / 60 * (1 - 2 * (violations + hidden)))


def test_the_best_places_are_refined_and_hopeless_ones_left_out():
    views = told_by(*[[picture((n, SAME))] for n in (40, 36, 20, 19)])("", np.empty((0, 4, 4)))
    query = map_frame(WHOLE, np.eye(4), BY_HAND.map, FIXED)
    poses = np.stack([shifted(APART * k) for k in (3, 2, 1, 0)])
    for numbers, planes, refined in (
        ({}, [40, 36, 20, 19], [1, 1, 1, 0]),
        ({"n_places": 2, "n_refined": 1}, [40, 36], [1, 0]),
        ({"hopeful": 0.5}, [40, 36, 20], [1, 1, 1]),
    ):
        p = replace(BY_HAND.map, **numbers)
        ranked = compare_poses([query], poses, views, p, FIXED)
        assert [place.planes for place in ranked] == planes
        assert [len(place.starts) for place in ranked] == refined


def test_frames_that_look_the_same_way_are_asked_first():
    """Of a camera the middle of what it sees counts, 1.5 m ahead, and its direction."""
    back, aside = shifted(0.0), shifted(0.0)
    back[:3, :3] = aside[:3, :3] = np.diag([-1.0, 1.0, -1.0])
    back[2, 3] = 3.0  # looks at the same from the other side: 3 m for that
    poses = np.stack([back, shifted(3.4), shifted(1.0), shifted(3.6), aside])
    views = MapViews(poses, lambda _: None, MapParameters(), FIXED)
    assert views.near(np.eye(4), True) == [2, 0, 1]
    assert views.near(np.eye(4), True, np.array([4, 1, 2])) == [2, 1]
    assert views.near(shifted(-2.5), True) == []  # frame 2 is 3.5 m off, too far
    # of a scan where it stands, 1.5, 1.5, 1.8, 3.7 and 3.9 m from what the cameras see
    assert views.near(np.eye(4), False) == [0, 4, 2, 1, 3]
    scans = MapViews(poses, lambda _: None, MapParameters(), FIXED, ahead=[False] * 5)
    assert scans.near(np.eye(4), False) == [4, 2, 0, 1, 3]  # 0, 1, 3, 3.4 and 3.6 m
    assert scans.near(shifted(4.5), False) == [3, 1, 2]  # no farther than 4 m
    # a camera sees 1.5 m ahead of where the scans stand, whichever way their axes point; frame 2
    # is a camera, 0.9 of its reach off in what it sees
    mixed = MapViews(
        poses, lambda _: None, MapParameters(), FIXED, ahead=[False, False, True, False, False]
    )
    assert mixed.near(shifted(-2.15), True) == [0, 4, 2]


def test_evidence_by_hand():
    matches = [
        *seen_at(0.0, [0, 1]), *seen_at(0.0, [2], "weak"), suggested_at(0.0, 3),
        *seen_at(APART, [4], "weak"),  # of another place
    ]  # fmt: skip
    for row, similarity, distinctness in ((1, 0.7, 1.7), (4, 0.9, 2.5)):
        seen = replace(matches[row].validation, distinctness=distinctness)
        matches[row] = replace(matches[row], similarity=similarity, validation=seen)
    here = [picture((40, SAME)), picture((30, SAME), (10, FARTHER)), picture((40, SAME))]
    answer = judged(matches, here, [picture((10, SAME))])
    assert answer.status == "found"
    [itself] = answer.alternatives
    evidence = itself.evidence
    # tiles 30 to 39 have two frames for them and one against, which leaves no violation
    assert (evidence.share, evidence.planes) == pytest.approx((40 / 60, 40.0))
    assert (evidence.score, evidence.excess) == pytest.approx((40 / 60, 0.0))
    assert (evidence.frames, evidence.viewpoints) == (3, 1)  # the frames stand at one place
    assert (evidence.weight, evidence.strong, evidence.suggested) == (pytest.approx(2.4), 2, 4)
    assert (evidence.accepted, evidence.acceptance) == (3, 1.0)
    assert (evidence.similarity, evidence.distinctness) == (0.7, 1.7)
    assert (evidence.rival, evidence.rival_weight) == pytest.approx((10 / 40, 0.4))
    assert itself.support == 3
    assert answer.evidence is evidence


@pytest.mark.parametrize(
    ("rival", "confidence", "status"),
    [
        # the rival has odds of e^2; half of 40 costs 1, and 0.6 of 40 costs 2
        (20, 1 / (1 + math.exp(-7) + math.exp(-5)), "found"),
        (24, 1 / (1 + math.exp(-6) + math.exp(-4)), "ambiguous"),
        (40, 1 / (2 + math.exp(-2)), "ambiguous"),  # both odds are e^2
    ],
)
def test_a_pose_is_found_where_its_confidence_is_enough(rival, confidence, status):
    matches = [*seen_at(0.0, [0, 1]), *(suggested_at(APART, row) for row in (5, 6))]
    places = [picture((40, SAME))], [picture((rival, SAME))]
    answer = judged(matches, *places)
    assert answer.status == status
    assert answer.confidence == pytest.approx(confidence, abs=1e-4)
    assert answer.evidence.rival == pytest.approx(rival / 40)
    if status == "found":
        assert (answer.verified_by, at_place(0, answer)) == ("matches", True)
        strict = replace(BY_HAND, confidence=0.995)
        assert judged(matches, *places, p=strict).status == "ambiguous"
    else:
        assert answer.reason.startswith("another pose explains the frame equally well")
        lenient = replace(BY_HAND, confidence=0.95)
        again = judged(matches, *places, p=lenient)
        assert again.status == ("found" if rival == 24 else "ambiguous")


def test_a_confidence_that_equals_the_limit_suffices():
    matches = [*seen_at(0.0, [0, 1]), *(suggested_at(APART, row) for row in (5, 6))]
    places = [picture((40, SAME))], [picture((24, SAME))]
    for prior in (None, near_place(0)):
        least = judged(matches, *places, prior=prior).confidence
        for limit, by in ((least, "matches" if prior is None else "prior"), (least + 1e-9, None)):
            answer = judged(matches, *places, prior=prior, p=replace(BY_HAND, confidence=limit))
            assert answer.verified_by == by
    least = judged(matches, *places).confidence
    for limit, status in ((least, "ambiguous"), (least + 1e-9, "not_found")):
        assert judged(matches, *places, p=replace(BY_HAND, worth=limit)).status == status


def test_alternatives_are_told_with_their_confidences_the_best_first():
    matches = [suggested_at(APART * k, row) for k in range(3) for row in (2 * k, 2 * k + 1)]
    places = [[picture((count, SAME))] for count in (36, 36, 12)]
    answer = judged(matches, *places)
    assert (answer.status, answer.average) == ("ambiguous", None)
    assert sorted(a.T[0, 3] for a in answer.alternatives) == [0.0, APART, 2 * APART]
    assert [a.confidence for a in answer.alternatives] == pytest.approx([1 / 2.2] * 3, abs=1)
    few = judged(matches, [picture((36, SAME))], [picture((30, SAME))], [picture((8, SAME))])
    assert [alternative.T[0, 3] for alternative in few.alternatives] == [0.0, APART]
    assert few.alternatives[0].confidence > few.alternatives[1].confidence


def test_few_planes_and_violations_lower_a_confidence():
    votes = seen_at(0.0, [0, 1])
    for there, logit, why in (
        (picture((6, SAME)), 3.0, "only 6 distinct planes agree"),
        (picture((38, SAME), (2, FARTHER)), 5.0, "a pose fits, but 5%"),
        (picture((38, SAME), (2, NEARER)), 5.0, "a pose fits, but 5%"),
        (picture((30, SAME), (2, FARTHER), (2, NEARER)), 1.923, "a pose fits, but 12%"),
    ):
        answer = judged(votes, [there])
        assert answer.confidence == pytest.approx(1 / (1 + math.exp(-logit)), abs=2e-3)
        assert (answer.status == "found") is (logit > 4.6)
        assert answer.evidence.acceptance == 1.0  # of two votes for one frame
        assert answer.status == "found" or answer.reason.startswith(why)


def test_a_pose_that_one_view_alone_suggests_is_not_sure():
    alone, other = seen_at(0.0, [0]), suggested_at(0.0, 5)
    for matches, status in ((alone, "ambiguous"), ([*alone, other], "found")):
        answer = judged(matches, [WHOLE] * 3)
        assert answer.status == status
        assert [alternative.support for alternative in answer.alternatives] == [1]
        assert (answer.evidence.rival, answer.evidence.rival_weight) == (0.0, 0.0)
        assert status == "found" or "views of the place suggests this pose" in answer.reason
    assert judged(alone, [WHOLE]).evidence.acceptance == 1.0  # the only frame


@pytest.mark.parametrize(
    ("same", "missing", "unlike", "excess"),
    [
        (30, 4, 0, 4 / 34),  # the map is at one with itself
        (30, 4, 4, 4 / 34 - 4 / 38),
        (24, 12, 15, 12 / 36 - 0.2),  # of 15 / 51 but a fifth is believed
    ],
)
def test_violations_that_the_map_shows_of_itself_are_borne(same, missing, unlike, excess):
    query = picture((same + missing, SAME))
    frames = [
        picture((same, SAME), (missing, FARTHER), (unlike, away)) for away in (SAME, FARTHER)
    ]  # fmt: skip
    noisy = replace(BY_HAND, map=MapParameters(n_refining=0), worth=0.0)
    answer = judged(seen_at(0.0, [0]), frames, query=query, p=noisy)
    assert answer.alternatives[0].evidence.excess == pytest.approx(excess)


@pytest.mark.parametrize(
    ("rendered", "status"), [((False, True, False), "ambiguous"), ((False, True, True), "found")]
)
def test_most_of_the_frames_that_agree_decide_what_a_map_is_made_of(rendered, status):
    """A tenth is missing, for which frames of a sensor pay and rendered views do not."""
    query = picture((40, SAME))
    frames = [picture((36, SAME), (4, FARTHER))] * 3
    views_of = told_by(frames, [picture()], rendered=[*rendered, True])
    matches = seen_at(0.0, [0, 1, 2])
    found = localize([QueryFrame(query, matches)], ROWS, None, views_of, p=BY_HAND, overlap_p=FIXED)
    assert found.status == status
    assert found.evidence.rendered == (status == "found")
    assert found.evidence.excess == pytest.approx(0.1)


def test_a_pose_that_refines_to_another_is_no_rival(path):
    """Beyond the distance between places, but in the basin of the right pose."""
    p, overlap_p = MapParameters(same_m=0.02, place_m=0.05), OverlapParameters()
    geometries, poses = path
    views = MapViews(poses[1:3], geometries[1:3].__getitem__, p, overlap_p)
    query = map_frame(geometries[0], np.eye(4), p, overlap_p)
    near = poses[0].copy()
    near[:3, 3] += 0.06, -0.05, 0.0
    ranked = compare_poses([query], np.stack([poses[0], near]), views, p, overlap_p)
    assert len(ranked) == 1
    np.testing.assert_allclose(ranked[0].T, poses[0], atol=0.03)
    assert ranked[0].is_of(near, p)
    away = near.copy()
    away[2, 3] += 1.0
    assert not ranked[0].is_of(away, p)


def test_weak_matches_suffice_where_nothing_is_known_of_free_space(blank):
    """A cloud without a viewpoint has no strong ones; here the map is not asked."""
    weak = seen_at(0.0, [0, 1, 2], "weak")
    lost = replace(blank, surface=replace(blank.surface, camera=None))
    for geometry, status in ((blank, "ambiguous"), (lost, "found")):
        answer = localize([QueryFrame(geometry, weak)], ROWS)
        assert answer.status == status
    assert (answer.strength, answer.verified_by) == ("weak", "matches")
    unsure = [suggested_at(0.0, row, "ambiguous") for row in range(3)]
    none = localize([QueryFrame(lost, unsure)], ROWS)
    assert (none.status, none.reason) == ("ambiguous", "no match is accepted")


def test_the_map_alone_may_decide_where_no_match_votes():
    suggested = [suggested_at(0.0, 0), suggested_at(0.0, 2)]
    located = judged(suggested, [WHOLE] * 8, [picture((10, SAME))])
    assert (located.status, located.verified_by, located.strength) == ("found", "map", "weak")
    assert at_place(0, located)
    [itself] = located.alternatives
    assert (itself.support, located.votes) == (0, 0)
    # what a caller asks of matches, a pose without the vote of one does not meet
    strict = replace(BY_HAND, voted_only=True)
    answer = judged(suggested, [WHOLE] * 8, p=strict)
    assert (answer.status, answer.alternatives) == ("not_found", ())
    voted = judged([*suggested, suggested_at(0.0, 4, "ambiguous")], [WHOLE] * 8, p=strict)
    assert voted.status == "found"


def test_a_copy_of_a_view_suggests_nothing_new():
    for rows, status in (((0, 0), "ambiguous"), ((0, 2), "found")):
        assert judged([suggested_at(0.0, row) for row in rows], [WHOLE] * 8).status == status


def test_the_first_poses_of_all_candidates_come_before_their_second():
    both = outcome("rejected", T=inverse(ROWS[0]))
    both = replace(
        both, hypotheses=np.stack([both.T_match_query, inverse(ROWS[0]) @ shifted(APART)])
    )
    matches = [match(0, both), suggested_at(2 * APART, 1)]
    for n, at in ((2, [0.0, 2 * APART]), (3, [0.0, APART, 2 * APART])):
        p = replace(BY_HAND, map=replace(BY_HAND.map, n_poses=n))
        answer = judged(matches, *[[WHOLE]] * 3, p=p)
        assert sorted(place.T[0, 3] for place in answer.places) == at


def test_a_place_that_the_map_does_not_show_loses_to_any_rival():
    matches = [*seen_at(0.0, [0, 1]), *seen_at(APART, [2])]
    for hopeful, excess in ((0.0, 0.0), (0.2, 1.0)):
        p = replace(BY_HAND, map=replace(BY_HAND.map, hopeful=hopeful))
        answer = judged(matches, [WHOLE], [picture()], p=p)
        [here, there] = sorted(answer.places, key=lambda place: place.T[0, 3])
        assert (here.evidence.rival, here.evidence.rival_weight) == (0.0, 1.0)
        assert (there.evidence.rival, there.evidence.rival_weight) == (1.0, 2.0)
        assert (there.evidence.score, there.evidence.frames, there.score) == (0.0, 0, 0.0)
        assert (there.evidence.share, there.evidence.planes, there.evidence.viewpoints) == (0, 0, 0)
        assert there.evidence.excess == excess


def test_a_pose_against_which_up_speaks_is_not_suggested():
    suggested = [suggested_at(0.0, row) for row in (0, 2)]
    assert judged(suggested, [WHOLE] * 8).status == "found"
    tilted = [match(m.index, replace(m.validation, contradicts_up=True)) for m in suggested]
    frames = [QueryFrame(WHOLE, tilted)]
    assert localize(frames, ROWS, None, told_by([WHOLE] * 8), None, BY_HAND, FIXED) is None


def test_where_no_match_is_accepted_the_pose_is_that_of_the_map():
    aside = inverse(ROWS[0])
    aside[2, 3] = 0.2
    unsure = match(0, outcome("ambiguous", T=aside))
    answer = judged([unsure, suggested_at(0.0, 1)], [WHOLE] * 8)
    assert (answer.status, answer.verified_by) == ("found", "map")
    assert at_place(0, answer)


@pytest.mark.parametrize(
    ("same", "farther", "elsewhere", "confirmed"),
    [
        (36, 0, 36, True),
        (36, 0, 39, True),
        (36, 0, 41, False),  # nine tenths of the best of all
        (3, 0, 3, False),  # three planes cost 9
        (38, 2, 36, True),  # 5 % violations cost 3
        (36, 4, 36, False),  # 10 %
    ],
)
def test_a_prior_decides_for_what_the_map_bears_out(same, farther, elsewhere, confirmed):
    matches = [suggested_at(APART * k, row) for k in range(2) for row in (k, 2 + k)]
    places = [picture((elsewhere, SAME))], [picture((same, SAME), (farther, FARTHER))]
    assert judged(matches, *places).status != "found"
    answer = judged(matches, *places, prior=near_place(1))
    assert (answer.status == "found") is confirmed
    assert (answer.verified_by == "prior") is confirmed
    assert at_place(1, answer) is confirmed


@pytest.mark.parametrize(("second", "confirmed"), [(18, True), (25, False)])
def test_a_prior_does_not_decide_between_poses_that_it_expects(second, confirmed):
    matches = [suggested_at(APART * k, row) for k in (0, 1, 5) for row in (k, 6 + k)]
    places = [[picture((36, SAME))], [picture((second, SAME))], [], [], [], [picture((36, SAME))]]
    answer = judged(matches, *places, prior=near_place(0, deviation=30.0))
    assert at_place(0, answer) is confirmed  # half of 36 costs 1, and seven tenths 2.9
    assert judged(matches, *places, prior=near_place(0)).verified_by == "prior"


@pytest.mark.parametrize(
    ("expected", "other", "decided"),
    [
        (0, 16, ("found", "matches", 0)),
        (1, 16, ("found", "matches", 0)),  # what the prior expects does not fit
        (1, 25, ("ambiguous", None, None)),  # it fits, but for less than nine tenths of 40
        (1, 37, ("found", "prior", 1)),
        (0, 37, ("found", "prior", 0)),
        (2, 37, ("ambiguous", None, None)),  # nothing is where the prior expects it
    ],
)
def test_a_prior_decides_where_another_pose_fits_as_well(expected, other, decided):
    matches = [*seen_at(0.0, [0, 1]), suggested_at(APART, 8), suggested_at(APART, 9)]
    places = [picture((40, SAME))], [picture((other, SAME))]
    answer = judged(matches, *places, prior=near_place(expected))
    at = next((k for k in (0, 1) if at_place(k, answer)), None)
    assert (answer.status, answer.verified_by, at) == decided


def test_a_prior_chooses_the_parent_frame_unless_matches_have():
    parents = ["here", "here", "here", "there", "there"]
    views_of = told_by([WHOLE] * 8, [picture((56, SAME))], parent="there")

    def answer(matches, parent, x=0.0):
        prior = PosePrior(parent, shifted(x), np.eye(6) * 0.01)
        frames = [QueryFrame(WHOLE, matches)]
        answer = localize(frames, ROWS[:5], parents, views_of, prior, BY_HAND, FIXED)
        return answer.status, answer.parent, answer.verified_by

    tried = [suggested_at(0.0, row) for row in range(5)]  # three of them here
    assert answer(tried, "here")[1] == "here"
    assert answer(tried, "there") == ("found", "there", "map")
    # of a parent frame that no match has, the prior tells nothing about that of the accepted:
    # its numbers are those of a pose there that fits too
    accepted = [*seen_at(0.0, [3, 4]), suggested_at(APART, 3)]
    assert answer([*tried[:2], *accepted], "here", APART) == ("ambiguous", "there", None)
    assert answer([*tried[:2], *accepted], "there", APART) == ("found", "there", "prior")
    both = [*seen_at(0.0, [0, 1]), *seen_at(0.0, [3])]
    assert answer(both, "there")[1] == "there"


def test_the_parent_frame_is_that_of_the_strongest_matches(blank):
    parents = ["here", "here", "there"]
    weak, strong = seen_at(0.0, [0, 1], "weak"), seen_at(0.0, [2])
    tried = [suggested_at(0.0, 0), suggested_at(0.0, 1)]
    for matches in ([*weak, *strong], [*tried, *seen_at(0.0, [2], "weak")]):
        answer = localize([QueryFrame(blank, matches)], ROWS[:3], parents)
        assert (answer.parent, answer.votes) == ("there", 1)


@pytest.mark.parametrize(("cost", "confirmed"), [(6.2, True), (6.6, False)])
def test_a_prior_stands_for_a_second_view_and_for_odds_of_twenty(cost, confirmed):
    """Odds of 20 e^1.8 reach .99, and odds of 20 e^1.4 do not; with a third view both would."""
    costs = replace(_OF_FRAMES, suggested=Penalty(8.0, 8.0, cost))
    p = replace(BY_HAND, judgement=ConfidenceModel(costs, costs))
    answer = judged([suggested_at(0.0, 0)], [WHOLE] * 3, prior=near_place(0), p=p)
    assert (answer.verified_by == "prior") is confirmed


def test_a_prior_may_confirm_the_best_of_equal_poses_alone():
    matches = [suggested_at(APART * k, row) for k in range(2) for row in (k, 2 + k)]
    best = replace(BY_HAND, prior_share=1.0)
    for second, confirmed in ((36, True), (35, False)):
        places = [picture((36, SAME))], [picture((second, SAME))]
        answer = judged(matches, *places, prior=near_place(1), p=best)
        assert (answer.verified_by == "prior") is confirmed
        # the only pose that the prior expects has no rival
        assert not confirmed or (answer.evidence.rival, answer.evidence.rival_weight) == (0.0, 0.0)


def test_the_parent_frame_of_rejected_matches_is_that_of_most():
    tried = [suggested_at(0.0, row) for row in range(3)]
    for middle in ("here", "there"):
        parents, parent = ["there", middle, "here"], middle
        views_of = told_by([WHOLE] * 3, parent=parent)
        frames = [QueryFrame(WHOLE, tried)]
        answer = localize(frames, ROWS[:3], parents, views_of, None, BY_HAND, FIXED)
        assert (answer.status, answer.parent) == ("found", parent)


def test_poses_about_a_prior_are_drawn_to_where_the_map_fits(box_views, signer):
    poses, views = box_views
    T = looking_at_the_box(45.0)
    query = prepare(DepthFrame(render(symmetric_box(), T, KINECT), KINECT, "query", T), signer)[1]
    off = T.copy()
    off[:3, 3] += 0.1, -0.1, 0.05
    prior = PosePrior("", off, np.diag([0.1**2] * 3 + [0.05**2] * 3))
    views_of = views_of_rows([], poses, views.__getitem__)
    answer = localize([QueryFrame(query, [])], poses, None, views_of, prior)
    assert (answer.status, answer.votes) == ("found", 0)
    np.testing.assert_allclose(answer.average.T, T, atol=0.03)


def test_starts_lie_a_deviation_about_a_prior():
    T = shifted(1.0, 2.0) @ about_up(30.0)
    starts = prior_starts(T, np.diag([0.04, 0.09, 4.0, 1.0, 1.0, 1.0]), MapParameters())
    np.testing.assert_array_equal(starts[:, :3, :3], np.tile(T[:3, :3], (7, 1, 1)))
    by_hand = [
        (0, 0, 0), (0.2, 0, 0), (-0.2, 0, 0), (0, 0.3, 0), (0, -0.3, 0), (0, 0, 0.5), (0, 0, -0.5),
    ]  # fmt: skip
    np.testing.assert_allclose(starts[:, :3, 3] - T[:3, 3], by_hand, atol=1e-12)


def test_frames_of_a_sequence_vote_for_the_pose_of_the_last(blank):
    before = shifted(-1.0) @ about_up(20.0)  # T_query_sensor of the frame before
    truth = about_up(40.0) @ shifted(3.0)
    first = [match(i, outcome(T=inverse(ROWS[i]) @ truth @ before)) for i in (0, 1)]
    last = [match(2, outcome(T=inverse(ROWS[2]) @ truth))]
    alone = by_pairs(blank, [*last, *seen_at(9.0, [3])])
    assert alone.status == "ambiguous"
    frames = [QueryFrame(blank, first, before), QueryFrame(blank, [*last, *seen_at(9.0, [3])])]
    answer = localize(frames, ROWS)
    assert (answer.status, answer.average.support, answer.votes) == ("found", 3, 4)
    np.testing.assert_allclose(answer.average.T, truth, atol=1e-12)


def test_the_best_matches_of_all_frames_vote_first(blank):
    before = QueryFrame(blank, seen_at(0.0, [0, 1], "weak"))
    answer = localize([before, QueryFrame(blank, seen_at(0.0, [2]))], ROWS)
    assert (answer.status, answer.members) == ("found", (2, 0, 1))


def test_candidates_of_an_earlier_frame_suggest_poses_of_the_last():
    """Both frames are looked up where odometry puts them, and planes are those of one frame."""
    query = picture((30, SAME))
    suggested = [suggested_at(0.0, row) for row in (0, 2)]
    before = QueryFrame(query, suggested, shifted(-APART))  # a place behind
    for planes, status in ((6, "ambiguous"), (12, "found")):
        map_frames = [picture((planes, SAME))] * 4
        views_of = told_by(map_frames, map_frames)
        answer = localize(
            [before, QueryFrame(query, [])], ROWS, None, views_of, None, BY_HAND, FIXED
        )
        assert answer.status == status
    assert (answer.verified_by, at_place(1, answer)) == ("map", True)


def test_a_prior_reaches_frames_within_sight_and_three_deviations():
    T, covariance = np.eye(4), np.diag([0.01, 0.25, 0.04, 1.0, 1.0, 1.0])  # 0.5 m at most
    T[:3, 3] = (1.0, 2.0, 3.0)
    prior = PosePrior("room", T, covariance)
    reach = MapParameters().same_surfaces + 3 * 0.5
    pose = np.eye(4)
    pose[:3, 3] = (1.0 + reach - 1e-6, 2.0, 3.0)
    assert prior.reaches(pose, MapParameters())
    pose[0, 3] += 2e-6
    assert not prior.reaches(pose, MapParameters())


# Frames elsewhere that look like the query

#: Where eight frames stand side by side that look along z, 5 m apart.
CORRIDOR = {row: shifted(5.0 * row) for row in range(8)}


def corridor_rivals(estimate, nearest, tried, *, ahead=True, distances=(1,) * 8, **numbers):
    def posed(rows):
        parents = {**dict.fromkeys(CORRIDOR, ""), 6: "another floor"}
        return {row: PosedFrame(parents[row], CORRIDOR[row], ahead) for row in rows if row != 7}

    p, n = LocalizationParameters(**numbers), len(nearest)
    ranking = Ranking(np.array(nearest), np.array(distances[:n]), np.zeros(n))
    return rival_rows(estimate, ranking, set(tried), posed, ahead, p)


def test_rivals_are_the_first_of_the_ranking_elsewhere(blank):
    at_origin = by_pairs(blank, seen_at(0.0, [0, 1]))
    assert at_origin.members == (0, 1)
    # 0 stands there; 1 was tried; 6 is of another parent frame, 7 has no pose
    ranking = [6, 7, 0, 1, 4, 2, 3, 5]
    assert corridor_rivals(at_origin, ranking, [0, 1]) == [4, 2]
    assert corridor_rivals(at_origin, ranking, [0, 1], rivals=9) == [4, 2, 3, 5]
    assert corridor_rivals(at_origin, ranking, [0, 1, 4], rivals=9) == [2, 3, 5]
    # frame 0 was not tried, but shows the same; sensors that look all around see 4 m far
    assert corridor_rivals(at_origin, ranking, [1], rivals=9) == [4, 2, 3, 5]
    assert corridor_rivals(at_origin, ranking, [0, 1], ahead=False, rivals=9) == [4, 2, 3, 5]


def test_rivals_are_about_as_near_as_the_farthest_vote(blank):
    at_origin = by_pairs(blank, seen_at(0.0, [0, 1]))
    nearest, distances = [0, 4, 1, 2, 3], (10, 11, 100, 120, 121)
    assert corridor_rivals(at_origin, nearest, [0, 1], distances=distances, rivals=9) == [4, 2]
    rivals = corridor_rivals(at_origin, nearest, [0, 1], distances=distances, rival_distance=1.0)
    assert rivals == [4]
    # the farthest that was tried did not vote; one that votes was not ranked
    without = corridor_rivals(
        at_origin, [1, 2, 3, 5], [1, 5], distances=(100, 119, 121, 130), rivals=9
    )
    assert without == [2]


@pytest.mark.parametrize(("ahead", "reach"), [(True, 3.5), (False, 4.0)])
def test_rivals_stand_beyond_the_reach_of_a_view(blank, ahead, reach):
    at_origin = by_pairs(blank, seen_at(0.0, [0, 1]))
    poses = {4: shifted(reach - 0.01), 5: shifted(reach)}
    rows = rival_rows(
        at_origin, Ranking(np.array([0, 1, 4, 5]), np.ones(4, int), np.zeros(4)), {0, 1},
        lambda rows: {row: PosedFrame("", poses[row], ahead) for row in rows}, ahead,
    )  # fmt: skip
    assert rows == [5]


def test_rivals_are_asked_of_nothing_that_is_not_found(blank):
    assert corridor_rivals(None, [0, 1, 2, 3], []) == []
    unsure = by_pairs(blank, [*seen_at(0.0, [0]), *seen_at(9.0, [1])])
    assert unsure.status == "ambiguous"
    assert corridor_rivals(unsure, [0, 1, 2, 3], [0, 1]) == []
    sure = by_pairs(blank, seen_at(0.0, [0, 1]))
    assert sure is not None
    assert corridor_rivals(replace(sure, verified_by="prior"), [0, 1, 2, 3], [0, 1]) == []


def test_what_was_not_compared_is_ambiguous(blank):
    sure = by_pairs(blank, seen_at(4.0, [0, 1]))
    assert sure.average is not None
    weak = mark_unconfirmed(sure)
    assert (weak.status, weak.average, weak.strength, weak.members) == ("ambiguous", None, None, ())
    assert (weak.covariance, weak.verified_by, weak.guided) == (None, None, 0)
    [pose] = weak.alternatives
    np.testing.assert_allclose(pose.T, shifted(4.0), atol=1e-12)
    assert pose.support == 2
    assert mark_unconfirmed(weak) is weak


class Shelf:
    """Frames at ROWS, but row 5 a bit aside; what searches return is given, and calls are noted."""

    def __init__(self, unguided=None, elsewhere=()):
        self.unguided, self.elsewhere = unguided, elsewhere
        self.searched, self.compared = [], []

    def locate(self, frames):
        return localize(frames, ROWS)

    def search(self, frame, known):
        self.searched.append((frame, sorted(known)))
        return self.unguided

    def posed(self, rows):
        return {row: PosedFrame("", shifted(3.6) if row == 5 else ROWS[row], True) for row in rows}

    def compare(self, rows):
        self.compared.append(rows)
        return self.elsewhere


def decided(frames, shelf, rows=(0, 1)):
    n = len(rows)
    ranking = Ranking(np.array(rows), np.ones(n, np.int64), np.zeros(n))
    return decide(frames, ranking, shelf, LocalizationParameters())


def guided_at(x, row):
    [one] = seen_at(x, [row])
    return replace(one, validation=replace(one.validation, predicted=np.eye(4)))


def test_guided_matches_are_searched_where_no_pose_is_found(blank):
    before = QueryFrame(blank, [suggested_at(0.0, 3)])
    frames = [
        before,
        QueryFrame(blank, [*seen_at(0.0, [0]), guided_at(0.0, 1), *seen_at(5.0, [2])]),
    ]
    shelf = Shelf([*seen_at(0.0, [0, 1]), *seen_at(5.0, [2])])
    answer = decided(frames, shelf)
    assert (answer.status, answer.members, answer.guided) == ("found", (0, 1), 0)
    assert shelf.searched == [(1, [0, 2])]
    late = decided(frames, Shelf(None))  # the deadline has passed
    assert (late.status, len(late.alternatives)) == ("ambiguous", 2)


def test_guided_matches_of_a_found_pose_are_not_searched(blank):
    shelf = Shelf([])
    answer = decided([QueryFrame(blank, [*seen_at(0.0, [0]), guided_at(0.0, 1)])], shelf)
    assert (answer.status, answer.guided, shelf.searched) == ("found", 1, [])
    lost = replace(guided_at(0.0, 1), validation=replace(outcome("rejected"), predicted=np.eye(4)))
    assert decided([QueryFrame(blank, [lost])], shelf) is None
    assert (shelf.searched, shelf.compared) == ([], [])


def test_frames_elsewhere_are_compared_before_a_pose_is_found(blank):
    before = QueryFrame(
        blank, [match(5, outcome(T=inverse(ROWS[5]) @ shifted(-1.0)))], shifted(-1.0)
    )
    frames = [replace(before, geometry=replace(blank, surface=replace(blank.surface, camera=None))),
              QueryFrame(blank, seen_at(0.0, [0, 1]))]  # fmt: skip
    shelf = Shelf(elsewhere=seen_at(9.0, [4, 5]))
    unsure = decided(frames, shelf, (0, 1, 4, 5))
    assert shelf.compared == [[4, 5]]
    assert unsure.status == "ambiguous"
    assert [(a.support, a.T[0, 3]) for a in unsure.alternatives] == [(3, 0.0), (2, 9.0)]
    alone = Shelf()
    assert decided(frames, alone, (0, 1, 4)).status == "found"
    assert alone.compared == [[4]]
    assert decided(frames, alone).status == "found"
    assert alone.compared == [[4]]  # no frame is left


def test_views_of_rows_are_the_frames_of_one_parent():
    opened = []
    views_of = views_of_rows(
        seen_at(0.0, [1, 4]), ROWS[:6], opened.append, list("abbaba"),
        ahead=[True] * 4 + [False, True], rendered=[False, True, True, False, False, False],
    )  # fmt: skip
    views = views_of("b", np.empty((0, 4, 4)))
    np.testing.assert_array_equal(views.poses, [ROWS[1], ROWS[2], ROWS[4]])
    assert views.candidates.tolist() == [0, 2]
    assert [views[k] for k in range(3)] == [None] * 3
    assert opened == [1, 2, 4]
    assert [views.mostly_rendered([k]) for k in range(3)] == [True, True, False]
    # a camera at x = 4 has its view 1.5 m from where the scan of row 4 stands: 1.5 m of 4
    assert views.near(ROWS[4], True) == [2, 1, 0]
    assert views.near(ROWS[3], False) == [2, 1, 0]
    assert not views.mostly_rendered([1, 2])  # half of them
    every = views_of_rows([], ROWS[:2], lambda _: WHOLE)("", np.empty((0, 4, 4)))
    assert (len(every.poses), len(every.candidates)) == (2, 0)
    np.testing.assert_array_equal(every[1].T, ROWS[1])
    assert not every.mostly_rendered([])
