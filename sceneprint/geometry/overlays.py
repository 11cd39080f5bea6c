"""Two frames laid on each other, to see how well they fit.

Surface, Surface, T  --overlay-->  points, normals, colours, in the target's frame
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.agreement import AgreementParameters, sampled
from sceneprint.geometry.rigid import inverse, moved
from sceneprint.geometry.traces import OUTSIDE, TOLERANCE, residuals
from sceneprint.types import Bytes, Floats, Surface

Colour = Literal["source", "normal", "residual"]

#: Of the source's points, and of the target's.
SOURCE, TARGET = (217, 119, 43), (43, 108, 176)
#: Distances from the other's surface, of `TOLERANCE` of what validation allows, and the colours of
#: the points that keep them; then of those that lie beside it or where it did not look, and of
#: violations.
STEPS = (50, 100, TOLERANCE)
STEP_COLOURS = np.array(
    [(38, 130, 60), (140, 190, 70), (240, 200, 60), (150, 155, 160), (200, 40, 40)], np.uint8
)


def overlay(
    source: Surface, target: Surface, T_target_source: Floats, colour: Colour = "source",
    p: AgreementParameters | None = None,
) -> tuple[Floats, Floats, Bytes]:  # fmt: skip
    """Both surfaces as one coloured cloud, the source's points first.

    Parameters
    ----------
    source, target : every valid pixel of both
    T_target_source : (4, 4)
    colour : "source" tells the frames apart, "normal" the directions of the surfaces (x, y, z in
        the target's frame from -1 to 1 as red, green, blue from 0 to 255), "residual" how far a
        point is from the other's surface (`STEPS`)
    p : when points agree and when they violate free space

    Returns
    -------
    points, normals : (N, 3), in the target's frame
    colours : (N, 3)
    """
    T = T_target_source
    ours, theirs = sampled(source, 1), sampled(target, 1)
    points = np.concatenate([moved(T, ours[:, :3].astype(float)), theirs[:, :3].astype(float)])
    turned = ours[:, 3:].astype(float) @ T[:3, :3].T
    normals = np.concatenate([turned, theirs[:, 3:].astype(float)])
    if colour == "normal":
        shade = np.clip(np.rint((normals + 1.0) * 127.5), 0, 255)
        return points, normals, shade.astype(np.uint8)
    if colour == "source":
        of = np.repeat(np.array([SOURCE, TARGET], np.uint8), [len(ours), len(theirs)], axis=0)
        return points, normals, of
    p = p or AgreementParameters()
    steps: NDArray[np.intp] = np.searchsorted(
        (*STEPS, OUTSIDE),
        np.concatenate([residuals(ours, target, T, p), residuals(theirs, source, inverse(T), p)]),
    )
    return points, normals, STEP_COLOURS[steps]
