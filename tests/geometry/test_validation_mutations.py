"""The checks of validation by hand catch a wrong line: one mutation at a time, uncompiled."""

from __future__ import annotations

import inspect
import re
from types import ModuleType

import numpy as np
import pytest

from sceneprint import types
from sceneprint.geometry import rigid
from sceneprint.geometry.registration import alignment, icp, overlap
from sceneprint.geometry.surface import camera

RIGID = [
    ("-T[:3, :3].T @ T[:3, 3]", "T[:3, :3].T @ T[:3, 3]"),
    ("result[:3, :3] = T[:3, :3].T\n", "result[:3, :3] = T[:3, :3]\n"),
    ("points @ T[:3, :3].T + T[:3, 3]", "points @ T[:3, :3] + T[:3, 3]"),
    ("R[2, 2] - 1.0)", "R[2, 2] - 3.0)"),
    ("(R[0, 2] - R[2, 0]) ** 2", "(R[0, 2] + R[2, 0]) ** 2"),
    ("a[:3, 3] - b[:3, 3]", "a[:3, 3] + b[:3, 3]"),
    ("result: Floats = u @ fix @ vt", "result: Floats = u @ vt"),
    ("N[0, 2] = H[0, 2] - H[2, 0]", "N[0, 2] = H[2, 0] - H[0, 2]"),
    ("N[2, 3] = H[2, 1] + H[1, 2]", "N[2, 3] = H[2, 1] - H[1, 2]"),
    ("if N[i, i] > N[best, best]:", "if N[i, i] < N[best, best]:"),
    ("R[1, 0], R[1, 1], R[1, 2] = 2 * (x * y + w * z)", "R[1, 0], R[1, 1], R[1, 2] = 2 * (x * y)"),
    ("K[0, 1], K[0, 2], K[1, 2] = -omega[2], omega[1]", "K[0, 1], K[0, 2], K[1, 2] = -omega[2], 0"),
    ("(1.0 - np.cos(angle)) / (angle * angle)", "(1.0 - np.cos(angle)) / angle"),
    ("total += E[i, k] * R[k, j]", "total += R[i, k] * E[k, j]"),
    ("if not diagonal > 1e-12:", "if not diagonal > -1e-12:"),
    ("diagonal -= A[j, k] * A[j, k]", "diagonal -= A[j, k]"),
    ("total -= A[k, i] * x[k]", "total -= A[i, k] * x[k]"),
]

PROJECTING = [
    ("if not z > camera[1]:", "if not z > -9.0:"),
    ("+ camera[4] + 0.5,", "+ camera[4],"),
    ("+ camera[5] + 0.5,", "+ camera[5],"),
    ("y / z * camera[3]", "y / z * camera[2]"),
    ("if not depth > camera[1]:", "if not depth >= 0:"),
    ("a, b, c = z, x, y", "a, b, c = x, z, y"),
    ("a, b, c = y, z, x", "a, b, c = z, x, y"),
    ("np.arctan2(c, np.sqrt(a * a + b * b))", "np.arctan2(c, a)"),
    ("column -= np.floor(column / turn) * turn", "pass"),
    ("/ camera[2] + 0.5\n", "/ camera[2]\n"),
    ("if column >= camera[6] > 0:", "if column >= camera[6]:"),
    ("if column >= camera[6] > 0:", "if False:"),
    ("(camera[4] - elevation)", "(elevation - camera[4])"),
    ("if power == 2:", "if power >= 1:"),
    ("return max(1.0, ratio * ratio)", "return ratio * ratio"),
    ("return max(1.0, ratio) if", "return ratio if"),
    ("return float(np.sqrt(x * x + y * y + z * z))", "return z"),
]

CAMERAS = [
    ("closed = camera.width if camera.is_closed else 0", "closed = camera.width"),
    ("camera.fx, camera.fy, camera.cx, camera.cy, 0.0]", "camera.fy, camera.fx, camera.cx, 0, 0]"),
    ("[NOWHERE, nearest, 0.0,", "[NOWHERE, 0.0, nearest,"),
    ("camera.left, camera.top, camera.pole, closed]", "camera.top, camera.left, camera.pole, 0]"),
]

TARGETS = [
    ("cube - 0.5))\n    j0", "cube))\n    j0"),
    ("range(k0, k0 + 2)", "range(k0, k0 + 1)"),
    ("if square < least or", "if square > least or"),
    ("if cosine > least_cosine:", "if True:"),
    ("found, least = -1, reach * reach", "found, least = -1, 9 * reach * reach"),
    ("n = chain[n]", "n = -1"),
    ("kept = one_of_each(points, reach / FINENESS)", "kept = one_of_each(points, reach)"),
    ("cube *= max(", "cube *= 9 * max("),
    ("chain[n] = heads[slot]", "chain[n] = -1"),
]

AGREEMENT = [
    ("beside = column % width", "continue"),
    ("if camera[0] == 0 or camera[6] == 0:", "if camera[0] == 0:"),
    ("seen, depth = depth_of(kind, a, b, c), moved[3, i]", "seen, depth = c, moved[3, i]"),
    ("if abs(plane) < tolerances[0]:", "if plane < tolerances[0]:"),
    ("facing[a] += T[a, b] * source[i, 3 + b]", "facing[a] += T[b, a] * source[i, 3 + b]"),
    ("at[a] += T[a, b] * source[i, b]", "at[a] += T[b, a] * source[i, b]"),
    ("round(violations) if known else None", "round(violations)"),
    ("stride = round(stride * max(more, 1.0) ** 0.5)", "pass"),
    ("max(more, 1.0)", "more"),
    ("Sphere) and stride > 1:", "Sphere):"),
    ("(0, stride * stride)", "(0, stride)"),
    ("0.0, width, 0.0, height, places", "0.0, width - 1, 0.0, height, places"),
    ("0.0, width, 0.0, height, places", "1.0, width, 2.0, height, places"),
    ("plane = abs(dx * mx + dy * my + dz * mz)", "plane = abs(dz)"),
    ("grow = grown(depth, reference, power)", "grow = 1.0"),
    ("grow = grown(depth, reference, power)", "grow = grown(depth, reference, 1.0)"),
    ("plane < on_surface * grow", "plane < on_surface"),
    ("gate = on_point * grow", "gate = 9 * on_point * grow"),
    ("& (cosine > least_cosine)", "& (abs(cosine) > least_cosine)"),
    ("dx * dx + dy * dy + dz * dz < gate * gate", "dx * dx + dy * dy < gate * gate"),
    ("inliers += weights[i]", "inliers += 1.0"),
    ("violations += weights[i]", "violations += 1.0"),
    ("before = (depth - seen < -margin", "before = (depth - seen > -margin"),
    ("& (plane > margin * grow)", "& (plane > 0)"),
    ("nearest = min(nearest, there)", "nearest = there"),
    ("if there > 0:", "if there > 1.5:"),
    ("return depth < nearest - margin", "return depth < nearest"),
    ("(xx * nx + xy * ny + xz * nz) * mx", "nx * mx"),
    ("(stride // 2, stride)", "(0, stride)"),
    ("out[k, 0] = inliers", "out[k, 1] = inliers"),
    ("chain, transforms[k], tolerances", "chain, transforms[0], tolerances"),
    ("Overlap(len(source), round(inliers)", "Overlap(round(inliers), round(inliers)"),
]

REGISTRATION = [
    ("nearer = (square < least)", "nearer = (square > least)"),
    ("& ((c != 0) | (a != 0) | (b != 0))", "& (c == c)"),
    ("in (first, second, third):", "in (second, second, second):"),
    ("count, edge, width - edge, 1.0,", "count, 0.0, width - edge, 0.0,"),
    ("width - edge, 1.0, height - 1.0,", "width, 1.0, height,"),
    ("limit = gate * grown(depth[i], reference, power)", "limit = gate"),
    ("limit = gate * grown(depth[i], reference, power)", "limit = gate * depth[i] / reference"),
    ("edge = 0.0 if camera[0] == 1 and camera[6] > 0 else 1.0", "edge = 1.0"),
    ("edge = 0.0 if camera[0] == 1 and camera[6] > 0 else 1.0", "edge = 1.0 - camera[0]"),
    ("(middle + 1 if middle < width - 1 else 0)", "min(middle + 1, width - 1)"),
    ("if abs(residual) > gate:", "if residual > gate:"),
    ("(0.25 + near**4 * 0.25)", "0.25"),
    ("numbers_of(p, kind)", "numbers_of(p, 0)"),
    ("return target_of(surface, p.nearest, p.reach)", "return target_of(surface, p.nearest, 9.0)"),
    ("| (abs(residual) > limit)", "| (residual > limit)"),
    ("(nearest[i] > 9.0 * limit * limit)", "(nearest[i] > 1e9)"),
    ("(cosine < least_cosine)", "(abs(cosine) < least_cosine)"),
    ("1.0 - (residual / limit) ** 2", "1.0 - abs(residual / limit)"),
    ("1.0 - (residual / gate) ** 2", "1.0 - abs(residual / gate)"),
    ("weight = tukey * tukey / (0.25 + (", "weight = tukey / (0.25 + ("),
    ("(0.25 + (near**4 + far**4) * 0.125)", "(0.25 + (far**4 + far**4) * 0.125)"),
    ("(0.25 + (near**4 + far**4) * 0.125)", "(0.25 + (near**2 + far**2) * 0.125)"),
    ("1.0 / p.weight_depth", "1.0"),
    ("y * mz - z * my, z * mx - x * mz", "z * my - y * mz, z * mx - x * mz"),
    ("y * mz - z * my, z * mx - x * mz", "y * mz - z * my, x * mz - z * mx"),
    ("g[a] -= wa * residual", "g[a] += wa * residual"),
    ("g[a] = -sums[21 + a]", "g[a] = sums[21 + a]"),
    ("rows[0, i] = y[i] * mz - z[i] * my", "rows[0, i] = z[i] * my - y[i] * mz"),
    ("ba, bb, gb = ba + w * a,", "ba, bb, gb = ba + w * b,"),
    ("fe + w * e\n", "fe + w * d\n"),
    ("A[b, a] = A[a, b]", "A[b, a] = 0.0"),
    ("share = iteration / max(iterations - 1, 1)", "share = 0.0"),
    ("share = iteration / max(iterations - 1, 1)", "share = 1.0"),
    ("if used * each < minimum:", "if used < 1:"),
    ("if used * each < minimum:", "if used < minimum:"),
    ("if iteration < thinned else 1", "if iteration > 9 else 1"),
    ("thinned = iterations - int(numbers[10])", "thinned = iterations"),
    ("information[a, b] = A[a, b] / used", "information[a, b] = A[b, a]  / 2 * used"),
    ("+ step[3 + a]", "- step[3 + a]"),
    ("turned(before, step[:3], turn)", "turned(before, -step[:3], turn)"),
    ("if used else None", "if used > 1 else None"),
]

CONSENSUS = [
    ("(abs(da - db) <= tolerance)", "(da - db <= tolerance)"),
    ("& (da >= minimum)", ""),
    ("& (db >= minimum)", ""),
    ("& (abs(ha - hb) <= tolerance)", ""),
    ("& (abs(ga - gb) <= tolerance)", ""),
    ("or _alike_angles(cosines[0, j], cosines[1, j], angle)", "or True"),
    ("abs(ta - tb) <= 2 * tolerance", "abs(abs(ta) - abs(tb)) <= 2 * tolerance"),
    ("bits[j, i >> 6] |= np.uint64(1) << np.uint64(i & 63)", "pass"),
    ("if used < 3:", "if used < 1:"),
    ("a0 / total", "a0 / used"),
    ("b[r] - (R[r, 0] * a[0]", "b[r] + (R[r, 0] * a[0]"),
    ("(u * u if u > 0 else 0.0) if c > cosine", "(u if u > 0 else 0.0) if c > cosine"),
    ("(u * u if u > 0 else 0.0) if c > cosine", "u * u if c > cosine"),
    ("(u * u if u > 0 else 0.0) if c > cosine", "(u * u if u > 0 else 0.0) if u > 0"),
]

AVERAGING = [
    ("agree_m: float = 0.15", "agree_m: float = 0.2"),
    ("agree_rad: float = math.radians(10.0)", "agree_rad: float = math.radians(15.0)"),
    ("(apart[..., 0] <= p.agree_m) & (", "(apart[..., 0] <= p.agree_m) | ("),
    ("-int(near[i].sum())", "int(near[i].sum())"),
    ("float(cost[i]), i)", "-float(cost[i]), i)"),
    ("float(cost[i]), i)", "float(cost[i]), -i)"),
    ("members = poses[near[medoid]]", "members = poses"),
    ("members = poses[near[medoid]]", "members = poses[[medoid]]"),
    ("nearest_rotation(members[:, :3, :3].sum(axis=0))", "members[0, :3, :3]"),
    ("members[:, :3, 3].mean(axis=0)", "members[0, :3, 3]"),
    ("members[:, :3, 3].mean(axis=0)", "np.median(members[:, :3, 3], axis=0)"),
    ("np.sqrt((left**2).mean(axis=0))", "left.mean(axis=0)"),
    ("metres, radians, len(members), len(poses)", "metres, radians, len(poses), len(poses)"),
]

CHECKS = {
    rigid: ("check_rigid", "check_averaging"),
    types: ("check_cameras",),
    camera: ("check_projecting",),
    overlap: ("check_targets", "check_agreement", "check_sampling", "check_agreement_of_clouds"),
    icp: ("check_registration", "check_registration_of_clouds"),
    alignment: ("check_consensus",),
}
CASES = [
    (module, line, wrong)
    for module, mutations in (
        (rigid, RIGID + AVERAGING),
        (types, CAMERAS),
        (camera, PROJECTING),
        (overlap, TARGETS + AGREEMENT),
        (icp, REGISTRATION),
        (alignment, CONSENSUS),
    )
    for line, wrong in mutations
]
#: Uncompiled, a pixel beyond the image is an IndexError; no answer where one is due, the other.
CAUGHT = (AssertionError, IndexError, AttributeError)
COMPILE = re.compile(r"from sceneprint.geometry.kernel import .*\n")
PLAIN = "kernel = disjoint_kernel = lambda function: function\n"


def uncompiled(module: ModuleType, line: str = "", wrong: str = "") -> ModuleType:
    """A fresh copy of a module with one expression replaced, its kernels plain Python."""
    source = inspect.getsource(module)
    if line:
        assert source.count(line) == 1, f"{line!r}: {source.count(line)} in {module.__name__}"
    source = COMPILE.sub(lambda found: found.group() + PLAIN, source).replace(line, wrong)
    copy = ModuleType(module.__name__)  # dataclasses look their module up by this name
    exec(compile(source, str(module.__file__), "exec"), copy.__dict__)
    return copy


def check(goldens: ModuleType, module: ModuleType, copy: ModuleType) -> None:
    with np.errstate(all="ignore"):  # a wrong line may divide by nought; that is not the catch
        for name in CHECKS[module]:
            getattr(goldens, name)(copy)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("module", "line", "wrong"),
    CASES,
    ids=[f"{m.__name__.rpartition('.')[2]}-{i}" for i, (m, _, _) in enumerate(CASES)],
)
def test_goldens_catch_a_wrong_line(
    validation_goldens: ModuleType, module: ModuleType, line: str, wrong: str
) -> None:
    copy = uncompiled(module, line, wrong)
    with pytest.raises(CAUGHT):
        check(validation_goldens, module, copy)


@pytest.mark.parametrize("module", CHECKS)
def test_unchanged_copies_pass(validation_goldens: ModuleType, module: ModuleType) -> None:
    # so that the cases above fail for their mutation, not for being copies
    copy = uncompiled(module)
    check(validation_goldens, module, copy)
    # and so that they are: of its own kernels none is compiled
    own = [v for v in vars(copy).values() if getattr(v, "__module__", "") == module.__name__]
    assert len(own) >= 2
    assert not any(hasattr(value, "py_func") for value in own)
