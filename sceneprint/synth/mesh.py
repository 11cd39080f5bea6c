"""Triangle meshes: the one record that all builders of a synthetic scene pass on.

    solids (n)  --join-->  one mesh (V, 3), (F, 3)

Lengths are metres, z points up. The faces of a solid turn counter-clockwise when seen
from outside, so that a ray which meets a back face has started inside a solid.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sceneprint.types import Floats, Floats32, Ints32


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with outward normals.

    Parameters
    ----------
    vertices : (V, 3) float64, metres, z up
    faces : (F, 3) int32, indices into vertices, counter-clockwise from outside
    loss : (F,) float32, share of samples on the face from which a depth camera gets no
        answer (dark, shiny or transparent surfaces), [0, 1]
    """

    vertices: Floats
    faces: Ints32
    loss: Floats32

    def moved(self, offset: ArrayLike = (0.0, 0.0, 0.0), yaw: float = 0.0) -> Mesh:
        """The mesh turned about z by yaw (radians), then shifted by offset (3, metres)."""
        return self.turned(rotation_z(yaw), offset) if yaw else self._shifted(offset)

    def turned(self, rotation: Floats, offset: ArrayLike = (0.0, 0.0, 0.0)) -> Mesh:
        """The mesh after x -> rotation x + offset; rotation (3, 3), offset (3,) metres."""
        return replace(self, vertices=self.vertices @ rotation.T + np.asarray(offset, float))

    def with_loss(self, share: float) -> Mesh:
        """The same mesh with one loss on all faces."""
        return replace(self, loss=np.full(len(self.faces), share, np.float32))

    def _shifted(self, offset: ArrayLike) -> Mesh:
        return replace(self, vertices=self.vertices + np.asarray(offset, float))


def mesh_of(vertices: ArrayLike, faces: ArrayLike) -> Mesh:
    """A mesh without loss, its faces of no area left out."""
    v = np.asarray(vertices, np.float64).reshape(-1, 3)
    f: NDArray[np.int32] = np.asarray(faces, np.int32).reshape(-1, 3)
    a, b, c = v[f[:, 0]], v[f[:, 1]], v[f[:, 2]]
    e, g = b - a, c - a
    normal = np.stack(
        [
            e[:, 1] * g[:, 2] - e[:, 2] * g[:, 1],
            e[:, 2] * g[:, 0] - e[:, 0] * g[:, 2],
            e[:, 0] * g[:, 1] - e[:, 1] * g[:, 0],
        ],
        axis=1,
    )
    f = f[(normal * normal).sum(axis=1) > 1e-20]
    return Mesh(v, f, np.zeros(len(f), np.float32))


def join(meshes: Iterable[Mesh]) -> Mesh:
    """All meshes as one; an empty iterable gives the empty mesh."""
    parts = list(meshes)
    if not parts:
        return Mesh(np.empty((0, 3)), np.empty((0, 3), np.int32), np.empty(0, np.float32))
    starts = np.cumsum([0] + [len(m.vertices) for m in parts[:-1]])
    return Mesh(
        np.concatenate([m.vertices for m in parts]),
        np.concatenate([m.faces + s for m, s in zip(parts, starts, strict=True)]).astype(np.int32),
        np.concatenate([m.loss for m in parts]),
    )


def rotation_z(yaw: float) -> Floats:
    """(3, 3) rotation about z by yaw radians."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rotation_x(angle: float) -> Floats:
    """(3, 3) rotation about x by angle radians."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def face_normals(mesh: Mesh) -> Floats:
    """(F, 3) normals of the faces, each as long as twice the area of its face, m^2."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return np.asarray(np.cross(b - a, c - a))


def area(mesh: Mesh) -> float:
    """Area of all faces, m^2."""
    return float(np.linalg.norm(face_normals(mesh), axis=1).sum() / 2)


def volume(mesh: Mesh) -> float:
    """Enclosed volume, m^3, by the divergence theorem; negative where normals face inward."""
    return float((mesh.vertices[mesh.faces[:, 0]] * face_normals(mesh)).sum() / 6)
