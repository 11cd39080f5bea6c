"""Fusion of the frames of a map into a surface, and views of this surface.

frames  --join_frames-->  ReferenceSurface  --render_views-->  views, frames with poses
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sceneprint.fusion import FusionParameters, fuse
from sceneprint.geometry.rigid import transform_points
from sceneprint.geometry.views import Renderer, ViewParameters, ViewPlan, choose_views
from sceneprint.types import AnyFrame, Cloud, DepthFrame, Floats, Intrinsics, ReferenceSurface

#: Parameters of the fusion; lengths in metres.
_FUSION = FusionParameters(most_blocks=400_000, farthest_m=4.0)


def join_frames(frames: Sequence[AnyFrame], voxel_m: float, up: Floats) -> ReferenceSurface:
    """Return the surface fused from frames with poses.

    Parameters
    ----------
    frames : clouds, which give a cloud with one point per voxel, or depth images, which give a mesh
    voxel_m : side of the voxels, metres
    up : (3,) unit vector in the parent frame

    Raises
    ------
    MissingDependency, UselessFrame, InvalidRequest : See `fuse`
    """
    clouds = [(frame.points, frame.pose) for frame in frames if isinstance(frame, Cloud)]
    if not clouds:
        depth = [frame for frame in frames if isinstance(frame, DepthFrame)]
        mesh, _ = fuse(depth, replace(_FUSION, voxel_m=voxel_m))
        return ReferenceSurface(mesh.points.astype(np.float32), mesh.triangles, np.zeros(3), up)
    points = np.concatenate(
        [transform_points(T, points.astype(np.float64)) for points, T in clouds if T is not None]
    )
    _, cell, counts = np.unique(
        np.floor(points / voxel_m).astype(np.int64), axis=0,
        return_inverse=True, return_counts=True,
    )  # fmt: skip
    sums = np.stack([np.bincount(cell.ravel(), points[:, k]) for k in range(3)], axis=1)
    means = (sums / counts[:, None]).astype(np.float32)
    return ReferenceSurface(means, None, np.zeros(3), up)


def render_views(
    surface: ReferenceSurface, p: ViewParameters
) -> tuple[ViewPlan, list[AnyFrame]]:  # fmt: skip
    """Select viewpoints of a surface (see `choose_views`); return the plan and views as frames."""
    plan, renderer = choose_views(surface, p), Renderer(surface, p)
    frames: list[AnyFrame] = []
    for number, pose in enumerate(plan.poses):
        seen, name = renderer.view(pose), f"view-{number:06d}"
        frames.append(
            DepthFrame(seen, p.camera, name, pose)
            if isinstance(p.camera, Intrinsics)
            else Cloud(seen, name=name, pose=pose)
        )
    return plan, frames
