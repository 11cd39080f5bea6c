"""Gravity: the transforms that are left of two frames where both know which way is up.

    transforms, ups  --tilts-->  angles by which they lay the one up beside the other

An IMU tells up in its sensor's coordinates to half a degree or so. A transform of two frames of one
place must then lay the up of the one on that of the other: what tilts is not unlikely but
impossible. That holds only as far as `up` is right, so the search is told of it with room to spare,
and where nothing fits with it, the surfaces are asked once without it. The method is not the
paper's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.registration.plan_search import up_of
from sceneprint.types import Floats, Geometry

#: Unit vectors (3,), up in the coordinates of source and target; None where it is not known.
Ups = tuple[Floats | None, Floats | None]
NO_UPS: Ups = (None, None)


@dataclass(frozen=True)
class GravityParameters:
    """How far transforms may tilt against `up`; the room is for its noise."""

    gate: float = math.radians(15.0)  #: of two patches that correspond, their angles to up
    proposed_tilt: float = math.radians(20.0)  #: most of a hypothesis that is yet to be refined
    refined_tilt: float = math.radians(10.0)  #: most of one that is refined: beyond, `up` is wrong
    rival_tilt: float = math.radians(20.0)  #: from which on a rival is impossible
    floor_tilt: float = math.radians(30.0)  #: within which of `up` a frame's floor is looked for
    floor_stride: int = 7  #: of the pixels that it is looked for among


def tilts(transforms: Floats, ups: Ups) -> Floats:
    """Angles between up carried over by each transform and up as the target has it: (n,) radians.

    Parameters
    ----------
    transforms : (n, 4, 4) T_target_source
    ups : of source and target; 0 for all where one is not known
    """
    source, target = ups
    if source is None or target is None:
        return np.zeros(len(transforms))
    carried = transforms[:, :3, :3] @ source
    across = np.linalg.norm(np.cross(carried, target), axis=1)
    angles: Floats = np.arctan2(across, carried @ target)  # exact near 0, as acos is not
    return angles


def tilt_of(T: Floats | None, ups: Ups) -> float | None:
    """By how much one transform tilts, radians; None where that cannot be said."""
    if T is None or ups[0] is None or ups[1] is None:
        return None
    return float(tilts(T[None], ups)[0])


def are_level(transforms: Floats, ups: Ups, most: float) -> NDArray[np.bool_]:
    """Which transforms tilt by no more than that: all of them where an up is not known."""
    level: NDArray[np.bool_] = tilts(transforms, ups) <= most
    return level


def slopes(normals: Floats, up: Floats) -> Floats:
    """Angles of normals (n, 3) to up: (n,) radians, 0 for floors and pi/2 for walls."""
    angles: Floats = np.arccos(np.clip(normals @ up, -1.0, 1.0))
    return angles


def floor_error(frame: Geometry, up: Floats, p: GravityParameters) -> float:
    """How far `up` lies from the direction near it that most of the frame's surface faces, radians.

    Floors, tables and what stands on them tell up as well as an IMU does, where they are in view.
    A floor that is not in view tells nothing, and a ramp the wrong thing: a hint, and no evidence.

    Parameters
    ----------
    frame : of which `up` (3,) was told
    p : see GravityParameters
    """
    facing = frame.surface.normals[frame.surface.valid][:: p.floor_stride].astype(float)
    if not len(facing):
        return 0.0
    cosine = float(np.clip(up_of(facing, up, p.floor_tilt) @ up, -1.0, 1.0))
    return math.acos(cosine)


def contradiction(
    tilt: float, query: Geometry, match: Geometry, ups: Ups, p: GravityParameters
) -> str:
    """What is said of surfaces that fit, but only tilted against `up`.

    Parameters
    ----------
    tilt : of the transform, radians
    query, match : the two frames
    ups : of query and match, both known
    p : see GravityParameters
    """
    wrong = [
        name
        for name, frame, up in (("query", query, ups[0]), ("match", match, ups[1]))
        if up is not None and p.refined_tilt < floor_error(frame, up, p) < 0.95 * p.floor_tilt
    ]
    whose = f" of the {wrong[0]}, whose own floor disagrees with it" if len(wrong) == 1 else ""
    return (
        f"the surfaces fit, but only tilted by {math.degrees(tilt):.0f} deg against `up`: a place "
        f"that looks alike, or a wrong `up`{whose}. Check the IMU's calibration and the axes of "
        "`up`"
    )
