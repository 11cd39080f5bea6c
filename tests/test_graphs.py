"""Tests of g2o files with two readers, and of their meaning."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneprint.formats.export import PoseEdge, g2o, information_of
from sceneprint.geometry.rigid import inverse


def rigid(rng, metres=2.0, radians=2.0):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rng.normal(0, radians, 3)).as_matrix()
    T[:3, 3] = rng.normal(0, metres, 3)
    return T


def positive(rng):
    A = rng.normal(0, 1, (6, 6))
    return A @ A.T + np.eye(6)


def a_graph(n=5):
    rng = np.random.default_rng(3)
    poses = [rigid(rng) for _ in range(n)]
    edges = [
        PoseEdge(i, j, inverse(poses[i]) @ poses[j] @ rigid(rng, 0.02, 0.02), positive(rng))
        for i, j in [(0, 1), (1, 2), (3, 2), (2, 4), (4, 0)]
    ]
    return poses, edges


def read_strictly(text):
    """Vertices and edges; every line must be one, with all its numbers."""
    assert text.endswith("\n")
    vertices = {}
    edges = []
    for line in text[:-1].split("\n"):
        kind, *rest = line.split(" ")
        if kind == "VERTEX_SE3:QUAT":
            assert len(rest) == 8
            assert int(rest[0]) == len(vertices)
            vertices[int(rest[0])] = np.array(rest[1:], float)
            continue
        assert kind == "EDGE_SE3:QUAT"
        assert len(rest) == 2 + 7 + 21
        assert {int(rest[0]), int(rest[1])} <= vertices.keys()
        information = np.zeros((6, 6))
        information[np.triu_indices(6)] = np.array(rest[9:], float)
        information += np.triu(information, 1).T
        edges.append((int(rest[0]), int(rest[1]), np.array(rest[2:9], float), information))
    return vertices, edges


def matrix(numbers):
    T = np.eye(4)
    assert np.linalg.norm(numbers[3:]) == pytest.approx(1.0, abs=1e-8)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(numbers[3:]).as_matrix(), numbers[:3]
    return T


def test_there_and_back():
    poses, edges = a_graph()
    vertices, read = read_strictly(g2o(poses, edges))
    for pose, numbers in zip(poses, vertices.values(), strict=True):
        np.testing.assert_allclose(matrix(numbers), pose, atol=1e-8)
    scale = np.diag([1, 1, 1, 2, 2, 2])
    for edge, (first, second, numbers, information) in zip(edges, read, strict=True):
        assert (first, second) == (edge.first, edge.second)
        np.testing.assert_allclose(matrix(numbers), edge.T, atol=1e-8)
        np.testing.assert_allclose(information, scale @ edge.information @ scale, rtol=1e-8)


def test_its_error_costs_what_the_information_says():
    """g2o's cost of a small error, by its own definition, against ours in metres and radians."""
    rng = np.random.default_rng(1)
    for _ in range(10):
        T, information = rigid(rng), positive(rng)
        error = rng.normal(0, 1e-4, 6)
        small = np.eye(4)
        small[:3, :3], small[:3, 3] = Rotation.from_rotvec(error[3:]).as_matrix(), error[:3]
        _, read = read_strictly(g2o([np.eye(4), T @ small], [PoseEdge(0, 1, T, information)]))
        delta = inverse(T) @ T @ small
        vector = Rotation.from_matrix(delta[:3, :3]).as_quat()[:3]
        theirs = np.concatenate([delta[:3, 3], vector])
        assert theirs @ read[0][3] @ theirs == pytest.approx(error @ information @ error, rel=1e-4)


def test_information_of_a_covariance_in_other_axes():
    """Drawn errors of the kind that `geometry.covariance` speaks of, told as T exp(xi)."""
    rng = np.random.default_rng(2)
    T = rigid(rng)
    covariance = positive(rng) * 1e-8
    results = []
    for x in rng.multivariate_normal(np.zeros(6), covariance, 20_000):
        true = np.eye(4)
        true[:3, :3] = Rotation.from_rotvec(x[3:]).as_matrix() @ T[:3, :3]
        true[:3, 3] = T[:3, 3] + x[:3]
        xi = inverse(T) @ true
        results.append([*xi[:3, 3], *Rotation.from_matrix(xi[:3, :3]).as_rotvec()])
    expected = np.linalg.inv(information_of(covariance, T))
    # sampling leaves about 1 % of the largest
    assert np.abs(np.cov(np.array(results).T) - expected).max() < 0.04 * np.abs(expected).max()
