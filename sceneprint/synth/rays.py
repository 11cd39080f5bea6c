"""Ray casting: a mesh and a camera to a depth image.

    Mesh, T_world_camera (4, 4), Intrinsics  --cast_depth-->  depth (H, W), cosine (H, W)

The tree over the triangles is Embree's; it is built once a mesh, in `Caster`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from sceneprint.errors import MissingDependency
from sceneprint.synth.mesh import Mesh
from sceneprint.types import Floats, Floats32, Intrinsics, Ints32


@dataclass(frozen=True, eq=False)
class Hits:
    """What rays met first.

    Parameters
    ----------
    distance : (R,) float32, in units of the ray's direction; inf where nothing was met
    face : (R,) int32, index of the face; -1 where nothing was met
    normal : (R, 3) float32, unit normals of the faces, outward; 0 where nothing was met
    """

    distance: Floats32
    face: Ints32
    normal: Floats32


class Caster:
    """A mesh made ready for rays; build it once and cast often."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self._scene = _embree_scene(mesh)
        v = mesh.vertices.astype(np.float32)
        a, b, c = (v[mesh.faces[:, k]] for k in range(3))
        normals = np.cross(b - a, c - a)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
        self._normals = np.concatenate([normals, np.zeros((1, 3))]).astype(np.float32)

    def cast(self, origins: Floats32, directions: Floats32) -> Hits:
        """The first face that each ray meets.

        Parameters
        ----------
        origins, directions : (R, 3) float32, metres; directions of any length
        """
        found = self._scene.run(
            np.ascontiguousarray(origins, np.float32),
            np.ascontiguousarray(directions, np.float32),
            output=True,
        )
        face = np.asarray(found["primID"], np.int32)
        distance = np.where(face >= 0, found["tfar"], np.float32(np.inf)).astype(np.float32)
        return Hits(distance, face, self._normals[face])  # face -1 is the zero row


def cast_depth(
    caster: Caster, T_world_camera: Floats, intrinsics: Intrinsics
) -> tuple[Floats32, Floats32]:
    """An ideal depth image and how steeply each sample is met.

    Parameters
    ----------
    caster : the scene, metres
    T_world_camera : (4, 4) pose of the optical frame
    intrinsics : a camera without distortion

    Returns
    -------
    depth : (H, W) float32, metres along the optical axis; 0 where nothing is met
    cosine : (H, W) float32, |cos| between ray and normal, [0, 1]; 0 where nothing is met

    Raises
    ------
    MissingDependency : Embree cannot be imported.
    """
    depth, cosine, _ = cast_faces(caster, T_world_camera, intrinsics)
    return depth, cosine


def cast_faces(
    caster: Caster, T_world_camera: Floats, intrinsics: Intrinsics
) -> tuple[Floats32, Floats32, Ints32]:
    """As `cast_depth`, and the index of the face seen: (H, W) int32, -1 for none."""
    shape = (intrinsics.height, intrinsics.width)
    rays = pixel_rays(intrinsics) @ T_world_camera[:3, :3].T.astype(np.float32)
    origins = np.broadcast_to(T_world_camera[:3, 3].astype(np.float32), rays.shape)
    hits = caster.cast(origins, rays)
    # rays have z = 1 in the camera's frame, so distance along them is depth
    depth = np.where(hits.face >= 0, hits.distance, np.float32(0))
    cosine = np.abs(np.einsum("ij,ij->i", rays, hits.normal))
    cosine /= np.sqrt(np.einsum("ij,ij->i", rays, rays))
    return depth.reshape(shape), cosine.reshape(shape), hits.face.reshape(shape)


def pixel_rays(intrinsics: Intrinsics) -> Floats32:
    """(H W, 3) float32 rays through the pixel centres, row by row, with z = 1."""
    x = (np.arange(intrinsics.width) - intrinsics.cx) / intrinsics.fx
    y = (np.arange(intrinsics.height) - intrinsics.cy) / intrinsics.fy
    rays = np.ones((intrinsics.height, intrinsics.width, 3), np.float32)
    rays[..., 0] = x
    rays[..., 1] = y[:, None]
    return rays.reshape(-1, 3)


def _embree_scene(mesh: Mesh) -> Any:
    try:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene
    except ImportError as error:
        raise MissingDependency(
            "Synthetic scenes are ray-traced with Embree, and the package embreex cannot be "
            f"imported ({error}). Install it: pip install 'embreex>=4.4,<5' (x86_64 only)."
        ) from error
    scene = EmbreeScene()
    TriangleMesh(scene, mesh.vertices.astype(np.float32), np.ascontiguousarray(mesh.faces))
    return scene
