"""Transforms of a recorded walk beside its odometry: pairs, and what validation says of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from sceneprint.geometry.rigid import inverse, rotation_angle
from sceneprint.geometry.validation import Validation, ValidationParameters
from sceneprint.pipeline import validate
from sceneprint.types import Cloud, Floats, Geometry

PAIRS_WITHIN_M = 10.0  #: pairs that are validated
RIGHT_M, RIGHT_RAD = 0.3, math.radians(3.0)  #: a transform that odometry confirms


@dataclass(frozen=True)
class Believed:
    """What validation said of pairs."""

    pairs: int
    accepted: int
    right: int  #: of the accepted, those that odometry confirms
    recall_of: int  #: pairs whose transform is right, accepted or not


def believed(
    walk: Sequence[Cloud],
    geometries: Sequence[Geometry],
    pairs: Sequence[tuple[int, int]],
    p: ValidationParameters,
) -> tuple[Believed, list[dict[str, object]]]:
    """Pairs (query, match) validated, and each of them for those who want to see."""
    rows: list[dict[str, object]] = []
    for i, j in tqdm(pairs, desc="validate", unit="pair", disable=None):
        v = validate(geometries[i], geometries[j], p=p)
        off, turn = _off(walk, i, j, v)
        right = confirmed(walk, i, j, v)
        rows.append(
            {
                "query": i, "match": j, "apart": _apart(walk, i, j),
                "status": v.status, "strength": v.strength, "reason": v.reason, "right": right,
                "off_m": off, "off_deg": math.degrees(turn), "overlap": v.overlap,
                "plane_overlap": v.plane_overlap, "violations": v.violations,
                "residual_m": v.residual_m, "ambiguity": v.ambiguity,
            }
        )  # fmt: skip
    accepted = [row for row in rows if row["status"] == "accepted"]
    return (
        Believed(
            len(rows), len(accepted), sum(bool(row["right"]) for row in accepted),
            sum(bool(row["right"]) for row in rows),
        ),
        rows,
    )  # fmt: skip


def candidates(rows: Floats, allowed: NDArray[np.bool_], k: int) -> list[tuple[int, int]]:
    """Each query with its nearest `k` of the allowed."""
    ranked = np.argsort(np.where(allowed, rows, np.inf), axis=1, kind="stable")[:, :k]
    return [(i, int(j)) for i, row in enumerate(ranked) for j in row if allowed[i, j]]


def pairs_within(at: Floats, allowed: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Pairs that `allowed` (n, n) names and that lie within PAIRS_WITHIN_M."""
    near = np.linalg.norm(at[:, None] - at[None, :], axis=2) < PAIRS_WITHIN_M
    return [(int(i), int(j)) for i, j in np.argwhere(near & allowed) if i > j]


def confirmed(walk: Sequence[Cloud], i: int, j: int, v: Validation) -> bool:
    """Whether odometry confirms the transform between two scans."""
    off, turn = _off(walk, i, j, v)
    return off <= RIGHT_M and turn <= RIGHT_RAD


def pose_of(cloud: Cloud) -> Floats:
    """T_parent_sensor of a scan of a walk, which has one."""
    assert cloud.pose is not None
    return cloud.pose


def _truth(walk: Sequence[Cloud], i: int, j: int) -> Floats:
    return inverse(pose_of(walk[j])) @ pose_of(walk[i])


def _apart(walk: Sequence[Cloud], i: int, j: int) -> float:
    return float(np.linalg.norm(_truth(walk, i, j)[:3, 3]))


def _off(walk: Sequence[Cloud], i: int, j: int, v: Validation) -> tuple[float, float]:
    """Metres and radians between a transform and what odometry says; infinite without one."""
    if v.T_match_query is None:
        return math.inf, math.inf
    wrong = inverse(_truth(walk, i, j)) @ v.T_match_query
    return float(np.linalg.norm(wrong[:3, 3])), rotation_angle(wrong[:3, :3])
