"""Input of Sec. III: a depth image to a reduced map of inverse depth.

    depth (H, W)  --inverse_depth-->  1/z (h, w), with the intrinsics of the reduced map

The work is done in inverse depth throughout: the image of a plane is linear there, and the
noise of a structured-light sensor has the same size everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sceneprint.errors import UselessFrame
from sceneprint.geometry.kernel import kernel
from sceneprint.types import Floats32, Frame, Intrinsics


@dataclass(frozen=True)
class DepthParameters:
    """The numbers of the reduction."""

    minimum_depth: float = 0.3  #: nearer samples are missing, metres
    maximum_depth: float = 9.0  #: the sensor's range; farther samples are missing, metres
    same_surface: float = 0.03  #: samples within this share of the nearest are averaged
    focal_length_px: float = 146.0  #: the image is halved until f is nearest to this
    maximum_pixels: int = 160 * 120 * 4  #: and on, until the map is no larger than this
    minimum_valid: int = 64  #: fewer valid pixels of the map hold no geometry
    minimum_side: int = 8  #: an image with fewer rows or columns shows no surface, pixels


@kernel
def _in_range(depth: Floats32, minimum: float, maximum: float) -> Floats32:
    height, width = depth.shape
    q = np.zeros((height, width), np.float32)
    for y in range(height):
        for x in range(width):
            z = depth[y, x]
            if z >= minimum and z <= maximum:  # false for NaN as well
                q[y, x] = np.float32(1.0) / z
    return q


@kernel
def _halve(q: Floats32, same_surface: float) -> Floats32:
    height, width = q.shape[0] // 2, q.shape[1] // 2
    half = np.zeros((height, width), np.float32)
    keep = np.float32(1.0 / (1.0 + same_surface))
    zero, one = np.float32(0.0), np.float32(1.0)
    for y in range(height):
        for x in range(width):
            a, b = q[2 * y, 2 * x], q[2 * y, 2 * x + 1]
            c, d = q[2 * y + 1, 2 * x], q[2 * y + 1, 2 * x + 1]
            nearest = max(a, b, c, d)
            least = nearest * keep
            wa = one if a >= least else zero
            wb = one if b >= least else zero
            wc = one if c >= least else zero
            wd = one if d >= least else zero
            # where all four are missing, least = 0 and the mean is 0: missing
            half[y, x] = (wa * a + wb * b + wc * c + wd * d) / (wa + wb + wc + wd)
    return half


def halved(intrinsics: Intrinsics) -> Intrinsics:
    """The camera of an image reduced 2 x 2 (pixel centres at integers; odd edges fall off)."""
    return replace(
        intrinsics,
        width=intrinsics.width // 2,
        height=intrinsics.height // 2,
        fx=intrinsics.fx / 2,
        fy=intrinsics.fy / 2,
        cx=(intrinsics.cx - 0.5) / 2,
        cy=(intrinsics.cy - 0.5) / 2,
    )


def halvings(intrinsics: Intrinsics, p: DepthParameters) -> int:
    """How often to halve an image so that a pixel covers the same angle for every sensor."""
    times, camera = 0, intrinsics
    while min(camera.width, camera.height) >= 4 and (
        camera.fx > p.focal_length_px * 2**0.5 or camera.width * camera.height > p.maximum_pixels
    ):
        camera, times = halved(camera), times + 1
    return times


def inverse_depth(frame: Frame, p: DepthParameters) -> tuple[Floats32, Intrinsics]:
    """Mask, reduce and invert a depth image.

    Missing samples and those out of range go first; then each halving averages, of every
    2 x 2 samples, those that lie on the nearest surface, so that no point is invented
    between an edge and its background.

    Parameters
    ----------
    frame : depth (H, W) in metres
    p : see DepthParameters

    Returns
    -------
    q : (h, w) float32, 1/z in 1/metres; 0 where missing
    intrinsics : of the reduced map

    Raises
    ------
    UselessFrame : fewer than `minimum_valid` pixels lie within the range, or the image has
        fewer than `minimum_side` rows or columns.
    ValueError : the depth is not (H, W) as the intrinsics say.
    """
    camera = frame.intrinsics
    if frame.depth.shape != (camera.height, camera.width):
        raise ValueError(f"depth {frame.depth.shape} is not {camera.height, camera.width}")
    if min(frame.depth.shape) < p.minimum_side:
        raise UselessFrame(
            f"{frame.name or 'The frame'}: {camera.width} x {camera.height} samples show no "
            f"surface. Send an image of at least {p.minimum_side} rows and columns."
        )
    q = _in_range(np.ascontiguousarray(frame.depth, np.float32), p.minimum_depth, p.maximum_depth)
    for _ in range(halvings(camera, p)):
        q, camera = _halve(q, p.same_surface), halved(camera)
    n_valid = int(np.count_nonzero(q))
    if n_valid < p.minimum_valid:
        raise UselessFrame(_why_useless(frame, p))
    return q, camera


def _why_useless(frame: Frame, p: DepthParameters) -> str:
    given = frame.depth[np.isfinite(frame.depth) & (frame.depth > 0)]
    name = f"{frame.name}: " if frame.name else ""
    if not given.size:
        return f"{name}every depth sample is missing. Check the sensor, or send another frame."
    within = (given >= p.minimum_depth) & (given <= p.maximum_depth)
    counted = f"{within.sum()} of its {given.size} valid depth samples lie within"
    span = f"the model's range of {p.minimum_depth:g} to {p.maximum_depth:g} m"
    if within.mean() > 0.5:
        return (
            f"{name}only {counted} {span}, too few for a surface at this focal length. "
            "Check fx and fy, or send a frame that sees more of the scene."
        )
    return (
        f"{name}{counted} {span}; their median is {np.median(given):.3g} m. "
        "Check the depth scale (stored units per metre), or use a model made for this range."
    )
