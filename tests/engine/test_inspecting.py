"""Tests of stored answers: points, ranking, and details of a match."""

from dataclasses import replace

import numpy as np
import pytest

from sceneprint.engine.serializers import transform
from sceneprint.errors import InvalidRequest, NotIndexed, UnknownFrame
from sceneprint.formats.export import points_of
from sceneprint.geometry.registration.icp import adjoint
from sceneprint.geometry.rigid import pose_difference, transform_points
from sceneprint.geometry.validation.inspection import patches_at
from sceneprint.pipeline import distance, validate
from sceneprint_client.api import Query, ValidationOptions
from sceneprint_client.surface_encoding import HEADER, POINT


def vertices(data):
    """Comments and rows of a PLY file of points, normals and, if it has them, colours."""
    head, body = data.split(b"end_header\n", 1)
    lines = head.decode("ascii").splitlines()
    kinds = [(line.split()[2], "u1" if " uchar " in line else "<f4")
             for line in lines if line.startswith("property")]  # fmt: skip
    return [line[8:] for line in lines if line.startswith("comment ")], np.frombuffer(body, kinds)


def xyz(rows, of=("x", "y", "z")):
    return np.stack([rows[name] for name in of], axis=1)


@pytest.fixture
def response(full):
    return full.query_frame("hall", full.ids()[3], Query(k=2, seed=5))


def test_the_cloud_is_what_the_query_saw(full, uploads, prepared, response):
    comments, rows = vertices(full.inspection.cloud(response.query_id))
    points, normals = points_of(prepared[3][1].surface)
    assert xyz(rows).tobytes() == points.tobytes()
    assert xyz(rows, ("nx", "ny", "nz")).tobytes() == normals.tobytes()
    assert comments[0] == f"frame {full.ids()[3]}.optical"
    unseen = full.query_frame("hall", full.ids()[3], Query(k=1, stages=("retrieve",)))
    for call in (
        lambda: full.inspection.cloud(unseen.query_id),
        lambda: full.inspection.match(unseen.query_id, unseen.matches[0].frame_id),
    ):
        with pytest.raises(NotIndexed, match="without validation"):
            call()


def test_similarities_are_those_of_the_signatures(full, prepared, response, signer):
    answer = full.inspection.similarities(response.query_id)
    numbers = {frame_id: i for i, frame_id in enumerate(full.ids())}
    ranked = [numbers[frame.frame_id] for frame in answer.frames]
    assert len(ranked) == 11
    assert sorted(ranked) == [i for i in range(12) if i != 3]
    for match in response.matches:
        assert answer.frames[match.rank - 1].frame_id == match.frame_id
    every = [3, *ranked]
    scale = signer.model.unrelated_distance
    for i, a in enumerate(every):
        for j, b in enumerate(every):
            share = 1 - distance(prepared[a][0], prepared[b][0]) / scale
            assert answer.similarity[i][j] == pytest.approx(min(max(share, 0), 1), abs=5e-5)
    full.delete_frame("hall", answer.frames[0].frame_id)
    fewer = full.inspection.similarities(response.query_id, 3)
    assert fewer.frames == answer.frames[1:3]
    assert fewer.similarity == [[answer.similarity[i][j] for j in (0, 2, 3)] for i in (0, 2, 3)]


def test_a_match_is_validated_as_the_query_was(full, prepared):
    strict = ValidationOptions(residual_m=1e-6)
    names = full.ids()
    answer = full.query_frame("hall", names[3], Query(k=2, seed=5, validation=strict))
    assert {match.validation.status for match in answer.matches} == {"rejected"}
    for match in answer.matches[:3]:
        result = full.inspection.match(answer.query_id, match.frame_id)
        assert result.validation == match.validation
        assert result.transform == match.transform
        assert (result.seed, result.map, result.uncertainty) == (5, "hall", None)


def test_what_a_match_rests_on(full, prepared, response):
    names, best = full.ids(), response.matches[0]
    answer = full.inspection.match(response.query_id, best.frame_id)
    query, match = prepared[3][1], prepared[names.index(best.frame_id)][1]
    v = validate(query, match, 5)
    assert answer.validation == best.validation
    assert (answer.transform, answer.uncertainty) == (best.transform, best.uncertainty)
    assert answer.uncertainty.covariance == v.covariance.ravel().tolist()
    named = f"{best.frame_id}.optical", f"{names[3]}.optical"
    assert answer.rival == (None if v.T_rival is None else transform(v.T_rival, *named))
    counted = len(answer.query.inliers) + len(answer.match.inliers)
    assert counted == v.inliers
    against = len(answer.query.violations) + len(answer.match.violations)
    assert against / max(against + counted, 1) == pytest.approx(v.violations)
    T, pairs = v.T_match_query, answer.patches
    assert len(pairs.query) == len(set(pairs.query)) == len(set(pairs.match)) > 20
    for k, (i, j) in enumerate(zip(pairs.query, pairs.match, strict=True)):
        there = T[:3, :3] @ query.patches.means[i] + T[:3, 3]
        apart = np.linalg.norm(there - match.patches.means[j])
        assert pairs.distance_m[k] == pytest.approx(apart, abs=6e-5)
        assert pairs.query_mean[k] == pytest.approx(query.patches.means[i], abs=6e-5)
        assert pairs.match_normal[k] == pytest.approx(match.patches.normals[j], abs=6e-5)


def test_overlays_lie_in_the_frame_of_the_match(full, prepared, response):
    names, best = full.ids(), response.matches[0]
    query, match = prepared[3][1], prepared[names.index(best.frame_id)][1]
    ours, theirs = points_of(query.surface)[0], points_of(match.surface)[0]

    def overlay(**how):
        return vertices(full.inspection.overlay(response.query_id, best.frame_id, **how))

    comments, rows = overlay()
    assert comments[0] == f"frame {best.frame_id}.optical"
    assert len(rows) == len(ours) + len(theirs)
    T = np.array(best.transform.matrix)
    there = ours.astype(float) @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(xyz(rows)[: len(ours)], there, atol=1e-5)
    assert xyz(rows)[len(ours) :].tobytes() == theirs.tobytes()
    colours = xyz(rows, ("red", "green", "blue"))
    assert len(np.unique(colours[: len(ours)], axis=0)) == 1
    assert (colours[0] != colours[-1]).any()
    _, apart = overlay(by="none", colour="residual")
    assert xyz(apart)[: len(ours)].tobytes() == ours.tobytes()
    _, laid = overlay(colour="residual")
    assert (laid["green"] == 130).mean() > 2 * (apart["green"] == 130).mean()


def test_what_is_not_there_is_refused(full, response):
    look, best = full.inspection, response.matches[0].frame_id
    elsewhere = full.ids()[6:]
    far = next(m for m in response.matches if m.frame_id in elsewhere)
    with pytest.raises(InvalidRequest, match="has no rival"):
        look.overlay(response.query_id, far.frame_id, by="rival")
    with pytest.raises(UnknownFrame, match="has no match"):
        look.match(response.query_id, full.ids()[3])
    with pytest.raises(UnknownFrame, match="in map 'attic'"):
        look.match(response.query_id, best, "attic")
    full.delete_frame("hall", best)
    for call in (look.match, look.overlay):
        with pytest.raises(UnknownFrame, match="was deleted"):
            call(response.query_id, best)
    assert look.answer(response.query_id) == response


def test_answers_speak_of_the_robots_base(full, make_upload, uploads):
    base = np.eye(4)  # the camera looks ahead, 0.2 m before the base's middle and 0.5 m above
    base[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    base[:3, 3] = (0.2, 0.0, 0.5)
    sent = {"T_base_sensor": {"base_frame": "base", "matrix": base.tolist()}}
    one = make_upload(replace(uploads[8].frame, pose=uploads[8].pose), "room-001", **sent)
    answer = full.ask(one, Query(k=2))
    best, there = answer.matches[0], answer.location
    for camera, robot in ((best.pose_in_map, best.base_in_map), (there.pose, there.base)):
        assert (robot.parent_frame, robot.child_frame) == (camera.parent_frame, "base")
        np.testing.assert_allclose(
            np.array(robot.matrix) @ base, np.array(camera.matrix), atol=1e-12
        )
        # where the camera is, as the base sees it
        back = np.linalg.inv(robot.matrix) @ np.array(camera.matrix)
        np.testing.assert_allclose(back[:3, 3], (0.2, 0.0, 0.5), atol=1e-12)
    result = full.inspection.answer(answer.query_id)
    assert result.location == there
    plain = full.ask(uploads[8], Query(k=1))
    assert plain.matches[0].base_in_map is None
    assert plain.location.base is None


def test_the_uncertainty_of_a_place_is_told_in_its_axes(full, uploads):
    one = uploads[8]
    answer = full.ask(one, Query(candidates=1))
    (match,) = [m for m in answer.matches if m.validation.status == "accepted"]
    own = np.array(match.uncertainty.covariance).reshape(6, 6)
    result = np.array(answer.location.uncertainty.covariance).reshape(6, 6)
    T_map_match = np.array(match.pose_in_map.matrix) @ np.linalg.inv(match.transform.matrix)
    A = adjoint(T_map_match[:3, :3], np.zeros(3))
    np.testing.assert_allclose(result, A @ own @ A.T, rtol=1e-6, atol=1e-12)
    assert np.linalg.eigvalsh(result).min() > 0
    assert 1e-3 < np.sqrt(np.trace(result[:3, :3])) < 0.1
    assert answer.location.uncertainty.method == "votes-and-spread"
    assert match.uncertainty.method == "information-scaled"
    rest = [m for m in answer.matches if m.validation.status != "accepted"]
    assert [m.uncertainty for m in rest] == [None] * len(rest)


def test_a_guided_match_is_labelled_and_had_again(empty, make_upload, room_views):
    frames = room_views(21, 0, 36, along_path=True, step=6).frames
    for frame in [*frames[:2], *frames[3:]]:
        one = make_upload(frame, "room")
        empty.add(one)
    empty.work_off()
    asking = make_upload(frames[2], "room")
    meta = asking.meta.model_copy(update={"pose": None})
    answer = empty.ask(asking, Query(), meta=meta)
    assert (answer.status, answer.location.support, answer.location.guided) == ("found", 5, 3)
    assert pose_difference(np.array(answer.location.pose.matrix), asking.pose)[0] < 0.02
    guided = [match for match in answer.matches if match.validation.search == "guided"]
    assert len(guided) == 3
    for match in answer.matches:
        assert (match.predicted is not None) == (match in guided)
        result = empty.inspection.match(answer.query_id, match.frame_id)
        assert (result.validation, result.transform) == (match.validation, match.transform)
        assert result.uncertainty == match.uncertainty
    for match in guided:
        predicted, actual = (np.array(T.matrix) for T in (match.predicted, match.transform))
        assert pose_difference(predicted, actual)[0] < 0.05


def rows_of(data):
    head = HEADER.unpack_from(data)
    rows = np.frombuffer(data, POINT, offset=HEADER.size)
    return head, rows, np.array(head[5:8]) + rows["position"] / 65535 * np.array(head[8:11])


def test_the_points_of_a_frame(full, prepared):
    geometry = prepared[3][1]
    points, normals = points_of(geometry.surface)
    whole = full.points.frame("hall", full.ids()[3])
    head, rows, at = rows_of(whole.make())
    assert (head[2], head[3], head[11], head[12]) == (3, len(points), len(points), 0)
    assert at == pytest.approx(points, abs=1e-4)
    assert rows["normal"] / 127 == pytest.approx(normals, abs=0.5 / 127 + 1e-6)
    actual = patches_at(np.hstack([points, normals]), geometry.patches)
    assert (rows["patch"] == np.where(actual < 0, 65535, actual)).all()
    assert len(set(actual.tolist())) > 0.9 * len(geometry.patches)
    assert (rows["residual"] == 255).all()
    fewer = full.points.frame("hall", full.ids()[3], limit=100)
    assert rows_of(fewer.make())[0][3] == 100
    assert rows_of(fewer.make())[0][11] == len(points)
    assert fewer.tag != whole.tag
    with pytest.raises(InvalidRequest, match="no T_base_sensor"):
        full.points.frame("hall", full.ids()[3], "base")
    pose = np.array(full.get_frame("hall", full.ids()[3]).pose.matrix)
    _, _, there = rows_of(full.points.frame("hall", full.ids()[3], "parent").make())
    assert there == pytest.approx(transform_points(pose, points.astype(float)), abs=1e-4)
