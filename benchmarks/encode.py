"""What signing costs, stage by stage, beside Open3D's FPFH of the same frames in the same run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from sceneprint.errors import MissingDependency
from sceneprint.formats.artifact import read_geometry, write_geometry
from sceneprint.fusion import open3d
from sceneprint.geometry.signature.fisher_vector import quantise, statistics_of_counts, whiten
from sceneprint.geometry.signature.pair_features import count_pairs
from sceneprint.geometry.signature.segmentation import hierarchy, patch_weights, segment
from sceneprint.geometry.surface.depth_image import inverse_depth, surface
from sceneprint.pipeline import Signer, geometry_of, sign
from sceneprint.signing import float_signature, see
from sceneprint.types import DepthFrame, Floats
from sceneprint_lab.evaluation.pair_run import FEATURES, NORMALS, VOXEL, Clock, points_of

__all__ = ["Clock", "measure", "open3d", "points_of", "signing_stages"]


def signing_stages(frame: DepthFrame, signer: Signer) -> dict[str, float]:
    """Milliseconds of each stage of `sign`; their sum is the time of `sign` itself."""
    model, p, clock = signer.model, signer.model.parameters, Clock()
    q, camera = clock.run("inverse depth", lambda: inverse_depth(frame, p.depth))
    seen = clock.run("points and normals", lambda: surface(q, camera, p.normals))
    finest = clock.run("segmentation", lambda: segment(seen, p.segmentation))
    every = clock.run("hierarchy", lambda: hierarchy(seen, finest, p.hierarchy)).levels
    levels = [every[level] for level in model.levels]
    counted = clock.run(
        "pairs",
        lambda: [
            count_pairs(x.means, x.normals, patch_weights(x, p.weights), p.table, p.properties)
            for x in levels
        ],
    )
    sums = clock.run(
        "statistics",
        lambda: [statistics_of_counts(c, signer.table, len(model.mixture)) for c in counted],
    )
    psi, own = clock.run("Fisher vector", lambda: float_signature(sums, model)), model.whitening
    if own is None:
        clock.run("bytes", lambda: quantise(psi, model.quantiser_step))
    else:
        clock.run("whitening", lambda: whiten(psi, own))
    return clock.stages


def artifact_stages(frame: DepthFrame, signer: Signer) -> tuple[dict[str, float], int]:
    """Milliseconds of each stage of the geometry artifact beside `sign`, and its bytes."""
    clock, model = Clock(), signer.model
    seen = see(frame, model.parameters)
    geometry = clock.run("patches and descriptors", lambda: geometry_of(seen, model))
    data = clock.run("artifact to bytes", lambda: write_geometry(geometry))
    clock.run("artifact from bytes", lambda: read_geometry(data))
    return clock.stages, len(data)


def fpfh_stages(points: Floats, o3d: Any) -> dict[str, float]:
    """Milliseconds of each stage of FPFH."""
    clock, search = Clock(), o3d.geometry.KDTreeSearchParamHybrid
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    thin = clock.run("FPFH voxel grid", lambda: cloud.voxel_down_sample(VOXEL))
    clock.run("FPFH normals", lambda: thin.estimate_normals(search(*NORMALS)))
    clock.run(
        "FPFH features",
        lambda: o3d.pipelines.registration.compute_fpfh_feature(thin, search(*FEATURES)),
    )
    return clock.stages


@dataclass(frozen=True)
class EncodeFigures:
    """Medians over all frames, milliseconds; `ratio` is the median of each frame's own.

    `ratio_with_artifact` has the geometry artifact made and written beside the signature.
    """

    frames: int
    stages: dict[str, float]
    signing: float
    artifact_stages: dict[str, float]
    artifact_bytes: int
    fpfh_stages: dict[str, float]
    fpfh: float | None
    ratio: float | None
    ratio_with_artifact: float | None
    note: str


def measure(frames: list[DepthFrame], signer: Signer, warm_up: int = 3) -> EncodeFigures:
    """Sign every frame and, in turn, compute its FPFH, on the processor we are pinned to."""
    p, note, o3d = signer.model.parameters.depth, "", None
    try:
        o3d = open3d("FPFH")
    except MissingDependency as error:
        note = str(error)
    for frame in frames[:warm_up]:
        sign(frame, signer)
        artifact_stages(frame, signer)
    ours, theirs, artifacts = [], [], []
    for frame in frames:
        ours.append(signing_stages(frame, signer))
        artifacts.append(artifact_stages(frame, signer))
        if o3d is not None:
            theirs.append(fpfh_stages(points_of(frame, p.minimum_depth, p.maximum_depth), o3d))
    sums, other = [sum(s.values()) for s in ours], [sum(s.values()) for s in theirs]
    made = [sum(s.values()) - s["artifact from bytes"] for s, _ in artifacts]
    ratios = [a / b for a, b in zip(sums, other, strict=False)]
    with_artifact = [(a + m) / b for a, m, b in zip(sums, made, other, strict=False)]
    return EncodeFigures(
        frames=len(frames),
        stages=_medians(ours),
        signing=float(np.median(sums)),
        artifact_stages=_medians([stages for stages, _ in artifacts]),
        artifact_bytes=int(np.median([size for _, size in artifacts])),
        fpfh_stages=_medians(theirs),
        fpfh=float(np.median(other)) if other else None,
        ratio=float(np.median(ratios)) if ratios else None,
        ratio_with_artifact=float(np.median(with_artifact)) if with_artifact else None,
        note=note,
    )


def _medians(rows: list[dict[str, float]]) -> dict[str, float]:
    return {s: float(np.median([row[s] for row in rows])) for s in rows[0]} if rows else {}
