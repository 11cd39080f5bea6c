"""Rasterization of triangles and discs into the depth buffer of a pinhole camera.

    triangles or discs, camera (4,)  --draw_triangles, draw_discs-->  depth (H, W), item (H, W)

A ray through a pixel is d = ((u - cx) / fx, (v - cy) / fy, 1), so the point t d has the depth t.
Callers sort items into blocks and pass the visible blocks.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.kernel import kernel
from sceneprint.types import Floats, Floats32, Intrinsics, Ints32, Ints64

#: Minimum drawn depth, metres.
NEAREST = 1e-3
#: Maximum radius of a disc, pixels.
_WIDEST_PX = 64.0
#: Minimum radius of a disc, pixels; a smaller disc is drawn as one pixel.
_SMALLEST_PX = 0.7
#: Maximum distance along the ray between the centre of such a disc and its plane, as the radius
#: plus this many pixel widths. At larger distances, the pixel gets the depth of the centre.
_GRAZING = 3.0


def pinhole(camera: Intrinsics) -> Floats:
    """Return fx, fy, cx, cy of a camera as an array for the kernels of this module."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy])


@kernel
def _edge(ax: float, ay: float, az: float, bx: float, by: float, bz: float, out: Floats) -> None:
    """Write the normal a x b of the plane through the camera and an edge from a to b."""
    out[0], out[1], out[2] = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@kernel
def draw_triangles(
    points: Floats32, triangles: Ints32, starts: Ints64, ends: Ints64, T: Floats, camera: Floats,
    depth: Floats32, back: NDArray[np.uint8],
) -> None:  # fmt: skip
    """Draw the triangles of visible blocks.

    Edges are planes through the camera, so clipping is unnecessary. Adjacent triangles compute
    their common edge from the same numbers, so no ray passes between them.

    Parameters
    ----------
    points : (N, 3) corners
    triangles : (M, 3) indices of points, counterclockwise as seen from the front
    starts, ends : (B,) range of each visible block
    T : (4, 4) T_camera_points
    camera : result of `pinhole`
    depth : (H, W) depth of the nearest triangle, metres; inf where there is none; updated
    back : (H, W) uint8, 1 if the nearest triangle is seen from behind; updated
    """
    height, width = depth.shape
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    p, e = np.empty((3, 3)), np.empty((3, 3))
    for block in range(len(starts)):
        for m in range(starts[block], ends[block]):
            least, most = np.inf, -np.inf
            for c in range(3):
                n = triangles[m, c]
                x, y, z = points[n, 0], points[n, 1], points[n, 2]
                for a in range(3):
                    p[c, a] = T[a, 0] * x + T[a, 1] * y + T[a, 2] * z + T[a, 3]
                least, most = min(least, p[c, 2]), max(most, p[c, 2])
            if most < NEAREST:
                continue
            left, right, top, bottom = 0.0, width - 1.0, 0.0, height - 1.0
            if least > NEAREST:
                left, right, top, bottom = np.inf, -np.inf, np.inf, -np.inf
                for c in range(3):
                    u, v = p[c, 0] / p[c, 2] * fx + cx, p[c, 1] / p[c, 2] * fy + cy
                    left, right = min(left, u), max(right, u)
                    top, bottom = min(top, v), max(bottom, v)
                left, right = max(np.ceil(left), 0.0), min(np.floor(right), width - 1.0)
                top, bottom = max(np.ceil(top), 0.0), min(np.floor(bottom), height - 1.0)
            if left > right or top > bottom:
                continue
            for c in range(3):
                f, g = (c + 1) % 3, (c + 2) % 3
                _edge(p[f, 0], p[f, 1], p[f, 2], p[g, 0], p[g, 1], p[g, 2], e[c])
            volume = p[0, 0] * e[0, 0] + p[0, 1] * e[0, 1] + p[0, 2] * e[0, 2]
            if volume == 0.0:
                continue
            sign = 1.0 if volume > 0 else -1.0
            for v in range(int(top), int(bottom) + 1):
                dy = (v - cy) / fy
                for u in range(int(left), int(right) + 1):
                    dx = (u - cx) / fx
                    first = sign * (e[0, 0] * dx + e[0, 1] * dy + e[0, 2])
                    second = sign * (e[1, 0] * dx + e[1, 1] * dy + e[1, 2])
                    third = sign * (e[2, 0] * dx + e[2, 1] * dy + e[2, 2])
                    if first < 0 or second < 0 or third < 0:
                        continue
                    t = sign * volume / (first + second + third)
                    if NEAREST < t < depth[v, u]:
                        depth[v, u] = t
                        back[v, u] = 1 if volume > 0 else 0


@kernel
def draw_discs(
    points: Floats32, normals: Floats32, radii: Floats32, starts: Ints64, ends: Ints64, T: Floats,
    camera: Floats, depth: Floats32, item: Ints32,
) -> None:  # fmt: skip
    """Draw the discs of visible blocks.

    Parameters
    ----------
    points : (N, 3) centres
    normals : (N, 3) normals of either sign; a disc with the normal 0 faces the camera
    radii : (N,) metres
    starts, ends, T, camera, depth : arguments of `draw_triangles`
    item : (H, W) index of the visible disc; -1 for pixels without a disc
    """
    height, width = depth.shape
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    for block in range(len(starts)):
        for i in range(starts[block], ends[block]):
            px, py, pz = points[i, 0], points[i, 1], points[i, 2]
            z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
            if not z > NEAREST:
                continue
            x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
            y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
            u, v = x / z * fx + cx, y / z * fy + cy
            radius = float(radii[i])
            half = min(radius / z * max(fx, fy), _WIDEST_PX)
            if not (-half <= u < width + half and -half <= v < height + half):
                continue
            a, b, c = normals[i, 0], normals[i, 1], normals[i, 2]
            plain = a * a + b * b + c * c < 0.5
            nx = T[0, 0] * a + T[0, 1] * b + T[0, 2] * c
            ny = T[1, 0] * a + T[1, 1] * b + T[1, 2] * c
            nz = T[2, 0] * a + T[2, 1] * b + T[2, 2] * c
            off, reach = nx * x + ny * y + nz * z, radius * radius
            if half < _SMALLEST_PX:
                line, column = int(np.rint(v)), int(np.rint(u))
                if not (0 <= line < height and 0 <= column < width):
                    continue
                slope = nx * (column - cx) / fx + ny * (line - cy) / fy + nz
                t = off / slope if slope * off > 0.0 else z
                if not abs(t - z) < radius + _GRAZING * z / fx:
                    t = z
                if t < depth[line, column]:
                    depth[line, column], item[line, column] = t, i
                continue
            for line in range(max(int(np.ceil(v - half)), 0), min(int(v + half) + 1, height)):
                dy = (line - cy) / fy
                for column in range(max(int(np.ceil(u - half)), 0), min(int(u + half) + 1, width)):
                    dx = (column - cx) / fx
                    t = z
                    if not plain:
                        slope = nx * dx + ny * dy + nz
                        if slope * off <= 0.0:
                            continue
                        t = off / slope
                    qx, qy, qz = dx * t - x, dy * t - y, t - z
                    if qx * qx + qy * qy + qz * qz <= reach and NEAREST < t < depth[line, column]:
                        depth[line, column], item[line, column] = t, i
