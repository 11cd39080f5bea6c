"""Check of depth samples for plausibility, by their smoothness along the rows.

samples (H, W), stored units per metre  --check_depth-->  nothing, or UnreadableFrame

Neighbouring samples of depth are similar, unlike those of images with swapped bytes or rotated
bits, or of noisy infrared images. These ranges were measured on 1,622 real depth images (redkitchen
of 7-Scenes, fr1_rpy of TUM, studyroom2 of SUN3D, a RealSense) and 60 images of synthetic rooms:

    share of differing neighbours that are closer with their bytes swapped: rejected above .9
        depth 0 to .009, at an eighth of the size to .023; with swapped bytes .991 to 1
    median bend (`_bend`): rejected above .05
        depth .0002 to .0103, at an eighth of the size to .014; with 2 % of noise .035
        rotated right by 3 bits .25 to 6.8, infrared (synthetic) .087 to .090
    the same over a fortieth of the width: rejected above .05 and twice the bend of neighbours, if
    98 % of the samples are valid, as in infrared images but in no depth image (.962 at most)
        depth .003 to .023, with filled holes to .031; with 2 % of noise .057, 1.7 times
        infrared (synthetic, with texture) .03 to .5
    share of multiples of 8: rejected above .8
        depth .13; rotated left by 3 bits .8 to 1

Infrared images of surfaces without texture are as smooth as depth, and are accepted unless they
have 8 bits or are overexposed. They have no holes, but neither has filled or simulated depth. Of
200 computed images of plain walls, 53 were refused, and the range of 78 was doubtful.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import InvalidIntrinsics, UnreadableFrame
from sceneprint.types import Intrinsics

_ROWS = 40  #: number of checked rows
_PAIRS, _BENDS = 500, 4000  #: minimum number of pairs, and of triples, for a decision
_LEAST_SHARE = 0.1  #: minimum share of samples with two valid neighbours
_LEAST_VARYING = 0.25  #: minimum share of varying triples; with fewer, edges would dominate
_SWAPPED = 0.9  #: maximum share of differing neighbours that are closer with their bytes swapped
_ROUGH, _SMOOTH = 0.05, 0.025  #: maximum median bend of depth, and of depth with restored bits
_DENSE = 0.98  # share of valid samples above which an image counts as free of holes
_SATURATED = 0.02  #: maximum share of samples with the maximum of a number of bits
_STEEPEST = 20.0  #: maximum tangent of the angle between a ray and the optical axis
_SHIFTED = 0.8  #: maximum share of multiples of 8; in depth images, it is about one eighth

_TRUST = "If the samples are correct, use --trust-depth, or `trust_depth` in the metadata."

Rows = NDArray[Any]


def check_camera(intrinsics: Intrinsics) -> None:
    """Check that the rays of all pixels are at most 87 degrees from the optical axis.

    Raise InvalidIntrinsics if they are not, as for a focal length in another unit than pixels.
    """
    for size, f, c in (
        (intrinsics.width, intrinsics.fx, intrinsics.cx),
        (intrinsics.height, intrinsics.fy, intrinsics.cy),
    ):
        if max(abs(c), abs(size - 1 - c)) > _STEEPEST * f:
            raise InvalidIntrinsics(
                f"A focal length of {f:g} and a principal point of {c:g} are implausible for "
                f"{size} pixels: rays would be more than 87 degrees from the optical axis. Specify "
                "both in pixels of this image, as in the sensor's calibration."
            )


def check_depth(samples: NDArray[Any], depth_scale: float) -> None:
    """Check that samples are depth, without swapped bytes or rotated bits.

    The check takes 0.6 ms for 640 x 480 samples. Callers skip it if the user sets `trust_depth`.

    Parameters
    ----------
    samples : (H, W) uint16 in stored units, or floating-point metres
    depth_scale : stored units per metre

    Raises
    ------
    UnreadableFrame : If the samples are not; the message contains the remedy.
    """
    rows = samples[:: max(1, len(samples) // _ROWS)]
    is_whole = rows.dtype == np.uint16
    if is_whole and depth_scale < 8000 and _is_shifted(rows):
        raise UnreadableFrame(
            "The samples are multiples of 8, so their bits seem to be rotated left by 3, as in "
            "SUN3D and SUN RGB-D. Write d >> 3 | d << 13 for each uint16 sample d, or set "
            f"depth_scale to {8 * depth_scale:g}. {_TRUST}"
        )
    if is_whole and depth_scale >= 1000 and _is_of_bytes(rows):
        raise UnreadableFrame(
            "The samples are 255 at most, so the image seems to have had 8 bits, as infrared and "
            f"confidence images have. Send the depth image of the sensor. {_TRUST}"
        )
    if is_whole and (limit := _saturation(rows)) is not None:
        raise UnreadableFrame(
            f"Many samples are {limit}, the maximum of {limit.bit_length()} bits: in depth images, "
            f"they are missing, so write 0; in infrared images, they are overexposed. {_TRUST}"
        )
    bend = _bend(rows)
    is_rough = bend > _ROUGH
    if is_rough or (is_whole and _is_swapped(rows)):
        bits = _find_rotation(rows) if is_whole else None
        if bits == 8 or (bits is None and not is_rough):
            raise UnreadableFrame(
                "The samples seem to have the wrong byte order, because neighbours are similar "
                "only with swapped bytes. PNG stores the high byte first. Write "
                f"samples.byteswap(). {_TRUST}"
            )
        if bits is not None:
            raise UnreadableFrame(
                "The bits of the samples seem to be rotated, because neighbours are similar only "
                f"after a rotation. Write d << {bits} | d >> {16 - bits} for each uint16 sample d. "
                f"{_TRUST}"
            )
    if is_rough or _is_textured(rows, bend):
        raise UnreadableFrame(
            "The samples do not seem to be depth: neighbours differ as in infrared or confidence "
            f"images. Send the depth image of the sensor. {_TRUST}"
        )


def _find_rotation(rows: Rows) -> int | None:
    """Return the left rotation, in bits, that makes the samples smooth; None if there is none.

    Further rotations double the depth and may be smooth too, so the smallest depth is chosen.
    """
    turned = [(bits, rows << bits | rows >> 16 - bits) for bits in range(1, 16)]
    smooth = [
        (float(samples.mean()), bits) for bits, samples in turned if 0.0 < _bend(samples) < _SMOOTH
    ]
    return min(smooth)[1] if smooth else None


def _is_swapped(rows: Rows) -> bool:
    """Return whether most differing neighbours are closer with their bytes swapped."""
    a, b = rows[:, :-1], rows[:, 1:]
    differ = _valid(a) & _valid(b) & (a != b)
    a, b = a[differ], b[differ]
    if len(a) < _PAIRS or not (a & 255).any():  # too few, or 8-bit depth in the high bytes
        return False
    nearer = np.abs(_signed(a.byteswap()) - _signed(b.byteswap())) < np.abs(_signed(a) - _signed(b))
    return float(nearer.mean()) > _SWAPPED


def _is_shifted(rows: Rows) -> bool:
    """Return whether most samples are multiples of 8, but not most of them multiples of 16."""
    valid = rows[_valid(rows)]
    if len(valid) < _PAIRS or float((valid & 7 == 0).mean()) < _SHIFTED:
        return False
    return len(np.unique(valid)) > 64 and 0.25 < float((valid & 8 != 0).mean()) < 0.75


def _is_of_bytes(rows: Rows) -> bool:
    """Return whether all valid samples are at most 255."""
    valid = rows[_valid(rows)]
    return len(valid) >= _PAIRS and int(valid.max()) <= 255


def _saturation(rows: Rows) -> int | None:
    """Return the largest sample if it occurs often and is the maximum of 10 to 15 bits, or None."""
    valid = rows[_valid(rows)]
    limit = int(valid.max(initial=0))
    is_limit = 10 <= limit.bit_length() <= 15 and limit & (limit + 1) == 0
    return limit if is_limit and float((valid == limit).mean()) > _SATURATED else None


def _is_textured(rows: Rows, bend: float) -> bool:
    """Return whether an image has almost no holes, and is rougher over many columns than surfaces
    are, and than noise is whose roughness between neighbours is `bend`.
    """
    step = max(1, rows.shape[1] // 40)
    return float(_valid(rows).mean()) > _DENSE and _bend(rows, step) > max(_ROUGH, 2.0 * bend)


def _bend(rows: Rows, step: int = 1) -> float:
    """Return the median of |a - 2 b + c| / min(a, b, c) over triples of differing samples that are
    `step` columns apart; 0 if there are too few triples for a decision.
    """
    valid = _valid(rows)
    whole = valid[:, : -2 * step] & valid[:, step:-step] & valid[:, 2 * step :]
    with np.errstate(all="ignore"):  # damaged floats may overflow
        a, b, c = (
            rows[:, k * step : (k - 2) * step or None][whole].astype(np.float32) for k in range(3)
        )
        varying = (a != b) | (b != c)
        a, b, c = a[varying], b[varying], c[varying]
        enough = len(a) >= max(_BENDS, _LEAST_VARYING * len(varying))
        if not enough or len(varying) < _LEAST_SHARE * whole.size:
            return 0.0
        return float(np.median(np.abs(a - 2.0 * b + c) / np.minimum(np.minimum(a, b), c)))


def _valid(rows: Rows) -> NDArray[np.bool_]:
    if rows.dtype == np.uint16:
        return (rows > 0) & (rows < 65_535)
    with np.errstate(invalid="ignore"):
        return np.isfinite(rows) & (rows > 0.0)


def _signed(samples: Rows) -> NDArray[np.int32]:
    return samples.astype(np.int32)
