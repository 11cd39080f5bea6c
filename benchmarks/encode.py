"""Measure the stages of signing, and Open3D's FPFH of the same frames in the same run."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.machine import peak_megabytes_of_signing
from sceneprint.errors import MissingDependency
from sceneprint.formats.artifact import read_geometry, write_geometry
from sceneprint.formats.dataset import Camera, write_depth_png, write_intrinsics
from sceneprint.fusion import open3d
from sceneprint.geometry.signature.fisher_vector import quantise, statistics_of_counts, whiten
from sceneprint.geometry.signature.pair_features import count_pairs
from sceneprint.geometry.signature.segmentation import hierarchy, patch_weights, segment
from sceneprint.geometry.surface.depth_image import fit_surface, inverse_depth
from sceneprint.pipeline import Signer, geometry_of, open_signer, sign
from sceneprint.signing import float_signature, see
from sceneprint.types import DepthFrame, Floats
from sceneprint_lab.evaluation.pair_run import FEATURES, NORMALS, VOXEL, Clock, points_of


def signing_stages(frame: DepthFrame, signer: Signer) -> dict[str, float]:
    """Return the milliseconds of each stage of `sign`; their sum is the time of `sign`."""
    model, p, clock = signer.model, signer.model.parameters, Clock()
    q, camera = clock.run("inverse depth", lambda: inverse_depth(frame, p.depth))
    seen = clock.run("points and normals", lambda: fit_surface(q, camera, p.normals))
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
    """Return the milliseconds of each stage of the geometry artifact, and its size in bytes."""
    clock, model = Clock(), signer.model
    seen = see(frame, model.parameters)
    geometry = clock.run("patches and descriptors", lambda: geometry_of(seen, model))
    data = clock.run("artifact to bytes", lambda: write_geometry(geometry))
    clock.run("artifact from bytes", lambda: read_geometry(data))
    return clock.stages, len(data)


def fpfh_stages(points: Floats, o3d: Any) -> dict[str, float]:
    """Return the milliseconds of each stage of FPFH."""
    clock, search = Clock(), o3d.geometry.KDTreeSearchParamHybrid
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    thin = clock.run("FPFH voxel grid", lambda: cloud.voxel_down_sample(VOXEL))
    clock.run("FPFH normals", lambda: thin.estimate_normals(search(*NORMALS)))
    clock.run(
        "FPFH features",
        lambda: o3d.pipelines.registration.compute_fpfh_feature(thin, search(*FEATURES)),
    )
    return clock.stages


def measure(frames: Sequence[DepthFrame], preset: str, warm_up: int = 3) -> list[str]:
    """Alternately sign frames and compute their FPFH; return the table.

    `warm_up`: number of frames that are signed first without timing.
    """
    signer, o3d, note = open_signer(preset), *open3d_or_note()
    p = signer.model.parameters.depth
    for frame in frames[:warm_up]:
        sign(frame, signer)
        artifact_stages(frame, signer)
    ours, theirs, artifacts = [], [], []
    for frame in frames:
        ours.append(signing_stages(frame, signer))
        artifacts.append(artifact_stages(frame, signer))
        if o3d is not None:
            theirs.append(fpfh_stages(points_of(frame, p.minimum_depth, p.maximum_depth), o3d))
    sums, other = [sum(row.values()) for row in ours], [sum(row.values()) for row in theirs]
    whole = np.add(sums, [sum(row.values()) - row["artifact from bytes"] for row, _ in artifacts])
    lines = [
        f"### Signing, `{preset}`: median of {len(frames)} frames, one thread, warm",
        "",
        "| stage | ms |",
        "|---|--:|",
        *stage_rows(ours),
        f"| **signing, sum** | **{np.median(sums):.1f}** |",
        *stage_rows([row for row, _ in artifacts]),
        *stage_rows(theirs),
        f"| FPFH | not measured: {note} |",
    ]
    if other:
        lines[-1:] = [
            f"| **FPFH, sum** | **{np.median(other):.1f}** |",
            f"| **signing / FPFH** | **{np.median(np.divide(sums, other)):.2f}** |",
            f"| **signing and geometry artifact / FPFH** | "
            f"**{np.median(np.divide(whole, other)):.2f}** |",
        ]
    with tempfile.TemporaryDirectory() as folder:
        for i, frame in enumerate(frames[:10]):
            own = Path(folder) / f"{i:02d}"
            own.mkdir()
            write_intrinsics(own, Camera(frame.intrinsics, 1000.0, along_ray=False))
            write_depth_png(own / "frame.png", frame.depth, 1000.0)
        peak = peak_megabytes_of_signing(Path(folder), preset)
    size = int(np.median([size for _, size in artifacts]))
    return [
        *lines, "", f"Geometry artifact: {size:,} bytes. Peak memory of a process that signs: "
        f"{peak:.0f} MB.", "",
    ]  # fmt: skip


def open3d_or_note() -> tuple[Any, str]:
    """Return Open3D, or None and the reason why it cannot be imported."""
    try:
        return open3d("FPFH"), ""
    except MissingDependency as error:
        return None, str(error)


def stage_rows(rows: Sequence[Mapping[str, float]], prefix: str = "") -> Iterable[str]:
    """Yield a table row with the median of each stage."""
    for stage in rows[0] if rows else ():
        yield f"| {prefix}{stage} | {np.median([row[stage] for row in rows]):.1f} |"
