"""Sec. III-E, evidence by planes: what agrees, every plane counting as much as another.

    Geometry  --plane_view-->  PlaneView        transforms  --explained-->  Explained

That a floor lies on a floor says little, wherever on it one stands, and a floor may be half of
what a sensor sees. So patches that lie in one plane share one weight.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sceneprint.geometry.agreement import AgreementParameters, agreements
from sceneprint.geometry.kernel import kernel
from sceneprint.geometry.rigid import inverses
from sceneprint.types import Floats, Floats32, Geometry, Ints32, Patches, Surface


@dataclass(frozen=True)
class PlaneParameters:
    """Which patches lie in one plane."""

    coplanar: float = math.radians(15.0)  #: normals this near may be of one plane
    same_plane: float = 0.06  #: offsets this near are one plane, metres


@dataclass(frozen=True, eq=False)
class PlaneView:
    """A frame as its planes are weighed.

    Parameters
    ----------
    surface, patches : of the frame
    points : (P, 6) float32, means and normals of the patches
    weights : (P,) float32, of which those of one plane add up to 1
    """

    surface: Surface
    patches: Patches
    points: Floats32
    weights: Floats32


@dataclass(frozen=True, eq=False)
class Explained:
    """How far transforms explain two frames, every plane counting the same.

    Parameters
    ----------
    share : (n,) of both frames that agrees, 0 to 1
    violations : (n,) of free space, as a share of what agrees or violates, 0 to 1
    """

    share: Floats
    violations: Floats


@kernel
def _count(means: Floats, normals: Floats, cosine: float, apart: float, out: Ints32) -> None:
    """How many patches lie in the plane of each, itself among them."""
    for i in range(len(means)):
        x, y, z = means[i, 0], means[i, 1], means[i, 2]
        a, b, c = normals[i, 0], normals[i, 1], normals[i, 2]
        count = 0
        for j in range(len(means)):
            offset = (means[j, 0] - x) * a + (means[j, 1] - y) * b + (means[j, 2] - z) * c
            alike = normals[j, 0] * a + normals[j, 1] * b + normals[j, 2] * c > cosine
            if j == i or (alike and abs(offset) < apart):
                count += 1
        out[i] = count


def plane_weights(patches: Patches, p: PlaneParameters) -> Floats32:
    """Weights of patches: 1 over the number of patches that lie in the plane of each, (P,)."""
    counts = np.zeros(len(patches), np.int32)
    _count(patches.means, patches.normals, math.cos(p.coplanar), p.same_plane, counts)
    weights: Floats32 = (1.0 / counts).astype(np.float32)
    return weights


def plane_view(geometry: Geometry, p: PlaneParameters) -> PlaneView:
    """A frame made ready for `explained`."""
    patches = geometry.patches
    points = np.concatenate([patches.means, patches.normals], axis=1).astype(np.float32)
    return PlaneView(geometry.surface, patches, points, plane_weights(patches, p))


def explained(
    query: PlaneView, match: PlaneView, transforms: Floats, p: AgreementParameters
) -> Explained:
    """How far each of some transforms (n, 4, 4), T_match_query, explains two frames."""
    of_query = agreements(query.points, match.surface, transforms, p, query.weights)
    of_match = agreements(match.points, query.surface, inverses(transforms), p, match.weights)
    both = of_query + of_match
    everything = float(query.weights.sum(dtype=float) + match.weights.sum(dtype=float))
    return Explained(both[:, 0] / everything, both[:, 1] / np.maximum(both.sum(axis=1), 1e-9))
