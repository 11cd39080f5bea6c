"""Pose graphs as the text that optimisers read.

    poses, GraphEdge, ...  --g2o-->  VERTEX_SE3:QUAT, EDGE_SE3:QUAT

Information is about the right perturbation T exp(xi), xi = (shift in metres, turn in radians) in
the axes of the edge's second vertex. g2o's error is the shift and the *vector part of the
quaternion* of Z^-1 X_i^-1 X_j, and half a small turn is what that part holds: so that its
information about a turn is four times that about radians, and twice between shift and turn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sceneprint.types import Floats
from sceneprint_client.poses import quaternion_of

#: Of radians to the vector part of a quaternion: xi = _PER_QUATERNION * (shift, vector part).
_PER_QUATERNION = np.array([1.0, 1.0, 1.0, 2.0, 2.0, 2.0])


@dataclass(frozen=True, eq=False)
class PoseEdge:
    """How one vertex lies to another.

    Parameters
    ----------
    first, second : numbers of the vertices
    T : (4, 4) T_first_second
    information : (6, 6) of T exp(xi); shift (metres) before turn (radians), in axes of `second`
    """

    first: int
    second: int
    T: Floats
    information: Floats


def g2o(poses: Sequence[Floats], edges: Sequence[PoseEdge]) -> str:
    """A graph as g2o's text: vertices numbered from 0, then edges.

    No other lines: some readers stop at a comment, or at what fixes a vertex.

    Parameters
    ----------
    poses : (4, 4) T_parent_vertex of each
    edges : between these
    """
    lines = [f"VERTEX_SE3:QUAT {i} {_pose(pose)}" for i, pose in enumerate(poses)]
    upper = np.triu_indices(6)
    for edge in edges:
        information = edge.information * np.outer(_PER_QUATERNION, _PER_QUATERNION)
        numbers = " ".join(f"{value:.9g}" for value in information[upper].tolist())
        lines.append(f"EDGE_SE3:QUAT {edge.first} {edge.second} {_pose(edge.T)} {numbers}")
    return "\n".join([*lines, ""])


def information_of(covariance: Floats, T: Floats) -> Floats:
    """The information of an edge: (6, 6) as in `GraphEdge`.

    Parameters
    ----------
    covariance : (6, 6) of T as `geometry.covariance` has it: the error is added to the translation
        and put before the rotation, both along the axes of the edge's first vertex
    T : (4, 4) T_first_second
    """
    # [exp(r) R, t + x] = T exp(xi) where x = R shift and r = R turn
    axes = np.kron(np.eye(2), T[:3, :3])
    information: Floats = axes.T @ np.linalg.inv(covariance) @ axes
    return (information + information.T) / 2.0


def _pose(T: Floats) -> str:
    numbers = [*T[:3, 3].tolist(), *quaternion_of(T[:3, :3]).tolist()]
    return " ".join(f"{value:.9f}" for value in numbers)
