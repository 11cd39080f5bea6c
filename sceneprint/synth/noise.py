"""What a Kinect v1 makes of an ideal depth image.

    depth (H, W), cosine (H, W)  --kinect_noise-->  depth (H, W), 0 missing

A pattern projector beside the camera is matched by disparity d = f b / z: errors and
steps are even in disparity, so they grow with z^2 in depth. What the projector cannot
light, what lies flat to the ray and what does not shine back is missing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, special

from sceneprint.types import Floats32, Intrinsics


@dataclass(frozen=True)
class KinectNoise:
    """The numbers of the sensor; lengths in metres, px in pixels of the image."""

    baseline: float = 0.075  #: camera to projector, m; the projector is on the right
    disparity_sigma: float = 0.052  #: px; with the steps 1.5 mm at 1 m, 13 mm at 3 m
    correlation: float = 2.2  #: px; standard deviation of the blur of that error
    warp: float = 0.06  #: px; disparity error that is smooth over the image
    disparity_step: float = 0.125  #: px; disparity is known in eighths
    edge_jitter: float = 0.9  #: px; how far a look-up strays, so that edges are ragged
    edge_block: int = 3  #: px; size of the blocks that stray together
    shadow_margin: float = 0.5  #: px; least disparity difference that casts a shadow
    shadow_growth: int = 3  #: px; width of the window that smears shadows
    grazing_start: float = math.radians(71.0)  #: rad; incidence from which samples are lost
    grazing_end: float = math.radians(84.0)  #: rad; incidence from which all are lost
    speckle: float = 0.0008  #: share of samples lost anywhere, in patches
    patch: float = 7.0  #: px; size of lost patches
    border: tuple[int, int, int, int] = (0, 0, 0, 0)  #: px; lost left, right, top, bottom
    nearest: float = 0.45  #: m; nothing is measured closer
    farthest: float = 8.0  #: m; nothing is measured farther


#: the sensor of 7-Scenes and TUM RGB-D
KINECT_V1 = KinectNoise()


def kinect_noise(
    depth: Floats32,
    cosine: Floats32,
    intrinsics: Intrinsics,
    rng: np.random.Generator,
    parameters: KinectNoise = KINECT_V1,
    loss: Floats32 | None = None,
) -> Floats32:
    """A depth image as a Kinect v1 would have given it.

    Parameters
    ----------
    depth : (H, W) metres, 0 missing; ideal
    cosine : (H, W) |cos| of incidence, [0, 1]
    intrinsics : the camera
    rng : source of all noise
    parameters : the sensor
    loss : (H, W) share of samples lost on the surface seen, [0, 1]; None is none

    Returns
    -------
    depth : (H, W) float32 metres, 0 missing
    """
    p = parameters
    rows, columns = _strayed(depth, rng, p)
    z, cos = depth[rows, columns], cosine[rows, columns]
    seen = (z >= p.nearest) & (z <= p.farthest) & _within(depth.shape, p)
    gain = np.float32(intrinsics.fx * p.baseline)
    disparity = np.divide(gain, np.where(seen, z, 1), dtype=np.float32)
    seen &= ~_shadowed(depth, gain, p)[rows, columns]
    lost = _lost_share(cos, None if loss is None else loss[rows, columns], p)
    # a threshold on one smooth field makes losses come in patches
    hole = _field(depth.shape, p.patch, rng) * np.float32(0.9)
    hole += np.float32(math.sqrt(1 - 0.81)) * rng.standard_normal(depth.shape, np.float32)
    seen &= hole > special.ndtri(lost)
    disparity += np.float32(p.disparity_sigma) * _field(depth.shape, p.correlation, rng)
    disparity += np.float32(p.warp) * _field(depth.shape, 80.0, rng)
    step = np.float32(p.disparity_step)
    z = np.divide(gain, np.maximum(np.round(disparity / step) * step, step), dtype=np.float32)
    seen &= (z >= p.nearest) & (z <= p.farthest)
    return np.where(seen, z, np.float32(0))


def _strayed(
    depth: Floats32, rng: np.random.Generator, p: KinectNoise
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns to look samples up at: near edges of depth, each block strays as one."""
    height, width = depth.shape
    small = (-(-height // p.edge_block), -(-width // p.edge_block))
    stray = np.round(rng.normal(0, p.edge_jitter, (2, *small))).astype(np.intp)
    stray = stray.repeat(p.edge_block, axis=1).repeat(p.edge_block, axis=2)[:, :height, :width]
    rows, columns = np.arange(height)[:, None], np.arange(width)
    other_rows = np.clip(stray[0] + rows, 0, height - 1)
    other_columns = np.clip(stray[1] + columns, 0, width - 1)
    edge = np.abs(depth[other_rows, other_columns] - depth) > 0.02 * depth
    return np.where(edge, other_rows, rows), np.where(edge, other_columns, columns)


def _within(shape: tuple[int, ...], p: KinectNoise) -> NDArray[np.bool_]:
    """(H, W) all but the border."""
    left, right, top, bottom = p.border
    within = np.zeros(shape, bool)
    within[top : shape[0] - bottom, left : shape[1] - right] = True
    return within


def _shadowed(depth: Floats32, gain: np.float32, p: KinectNoise) -> NDArray[np.bool_]:
    """Samples that the projector, to the right of the camera, cannot reach.

    Light leaves the projector in column u - d. Of two samples in one such column the
    nearer is lit; nearer ones come from farther right.
    """
    far = np.where(depth > 0, depth, np.float32(1e3))
    column = np.arange(depth.shape[1], dtype=np.float32) - gain / far
    nearest = np.minimum.accumulate(column[:, ::-1], axis=1)[:, ::-1]
    dark = column > nearest + np.float32(p.shadow_margin)
    return ndimage.maximum_filter1d(dark, p.shadow_growth, axis=1)


def _lost_share(cosine: Floats32, loss: Floats32 | None, p: KinectNoise) -> Floats32:
    """(H, W) chance that a sample is missing: patches anywhere, grazing rays, poor surfaces."""
    steep = (math.cos(p.grazing_start) - cosine) / (
        math.cos(p.grazing_start) - math.cos(p.grazing_end)
    )
    kept = (1 - np.float32(p.speckle)) * (1 - np.clip(steep, 0, 1, dtype=np.float32))
    if loss is not None:
        kept *= 1 - loss
    return np.asarray(1 - kept, np.float32)


def _field(shape: tuple[int, ...], size: float, rng: np.random.Generator) -> Floats32:
    """(H, W) normal noise of unit variance whose grain is about `size` pixels wide.

    Coarse grain is drawn on a coarse grid and enlarged, which costs a tenth of a blur.
    """
    step = max(1, int(size / 1.5))
    small = (shape[0] // step + 4, shape[1] // step + 4)
    noise = rng.standard_normal(small, np.float32)
    noise = ndimage.gaussian_filter(noise, size / step, mode="wrap")
    if step > 1:
        noise = _enlarged(noise, step)
    noise = noise[: shape[0], : shape[1]]
    # standard deviation of white noise after a Gaussian blur: 1 / (2 sqrt(pi) sigma)
    return np.asarray(noise * np.float32(2 * math.sqrt(math.pi) * size / step), np.float32)


def _enlarged(coarse: Floats32, step: int) -> Floats32:
    """Linear interpolation, step samples for each one."""
    share = (np.arange(step, dtype=np.float32) / step)[:, None]
    rows = coarse[:-1, None] * (1 - share) + coarse[1:, None] * share
    rows = rows.reshape(-1, coarse.shape[1])
    share = share[:, 0]
    full = rows[:, :-1, None] * (1 - share) + rows[:, 1:, None] * share
    return np.asarray(full.reshape(len(rows), -1), np.float32)
