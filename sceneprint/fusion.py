"""Views of one place to one surface: a truncated signed distance, averaged; and its picture.

views (V)  --fuse-->  Mesh, voxel     by Open3D, which this file alone loads
Mesh, views  --rendered-->  (h, w, 3) uint8  --reconstruction_picture-->  PNG

A picture is shaded by normals, coloured by view, with the cameras. It is drawn by a depth buffer of
our own: Open3D's renderers want a graphics library and a display. Open3D is loaded when asked for,
and refused by name where it is missing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import InvalidRequest, MissingDependency, UselessFrame
from sceneprint.geometry.kernel import kernel
from sceneprint.geometry.rigid import inverse, levelling, moved
from sceneprint.geometry.surface.coverage import TriangleMesh
from sceneprint.geometry.surface.depth_image import halved
from sceneprint.types import Bytes, DepthFrame, Floats, Floats32, Ints32

#: Debian packages with the system libraries that Open3D loads.
PACKAGES = "libgl1 libegl1 libx11-6 libusb-1.0-0 libgomp1"


def open3d(what: str) -> Any:
    """The open3d module, to work in one thread.

    Parameters
    ----------
    what : needs it, as a message begins

    Raises
    ------
    MissingDependency : it, or a system library it needs, is absent.
    """
    try:
        import open3d as module
    except (ImportError, OSError) as error:
        raise MissingDependency(
            f"{what} needs Open3D, which cannot be imported here ({error}). Install it "
            f"(pip install open3d), and on Debian or Ubuntu: apt-get install {PACKAGES}"
        ) from error
    module.utility.set_max_threads(1)  # one process, one processor; and one order of sums
    module.utility.set_verbosity_level(module.utility.VerbosityLevel.Error)
    return module


#: Voxels along the edge of a block: space is kept in blocks, where a surface is.
_SIDE = 8
#: Voxels before and behind a surface, along the ray, in which its distance is kept: where a ray
#: meets it at less than asin(1 / 6), 10 degrees, there are holes; more would melt thin things.
BAND = 6.0


@dataclass(frozen=True)
class FusionParameters:
    """The numbers of a fusion."""

    voxel_m: float | None = None  #: edge of a voxel; None: as fine as the views and blocks allow
    nearest_m: float = 0.3  #: nearer samples are not fused
    farthest_m: float = 6.0  #: farther samples are too uncertain to be fused
    finest_m: float = 0.01  #: least edge that is chosen: below it sensors see noise
    #: A block of 512 voxels has 4 KiB, and some 50 points of surface: so many take 64 MiB, and
    #: their mesh is a file of about 50 MB.
    most_blocks: int = 16_384
    most_samples: int = 640 * 480  #: of a view; a larger image is thinned


def fuse(
    views: Sequence[DepthFrame], p: FusionParameters | None = None
) -> tuple[TriangleMesh, float]:
    """One surface of several views; the same one for the same views.

    Parameters
    ----------
    views : each with pose T_parent_view, in one parent frame
    p : see FusionParameters

    Returns
    -------
    mesh : in the parent frame, points in rising order of x, then y, then z
    voxel : edge of the voxels it was made of, metres

    Raises
    ------
    MissingDependency : Open3D, or a system library it needs, is absent.
    UselessFrame : no sample of any view lies within the range.
    InvalidRequest : voxels of the wanted size take more blocks than there may be.
    """
    p = p or FusionParameters()
    o3d = open3d("A reconstruction")
    kept = [within(view, p) for view in views]
    points = [_points(view) for view in kept]
    if not sum(map(len, points)):
        raise UselessFrame(
            f"No sample of the {len(views)} views lies between {p.nearest_m:g} and "
            f"{p.farthest_m:g} m, so there is no surface to fuse. Choose other frames."
        )
    voxel = _chosen_voxel(kept, points, p)
    return _meshed(o3d, kept, points, voxel, p), voxel


def within(view: DepthFrame, p: FusionParameters) -> DepthFrame:
    """A view as it is fused: thinned to `most_samples`, and without what lies out of range.

    Thinned by leaving samples out: a mean over an edge would be a surface that is not there.
    """
    depth, camera = np.asarray(view.depth, np.float32), view.intrinsics
    while depth.size > p.most_samples:
        camera = halved(camera)
        # of each 2 x 2 samples the first; its ray is half a (new) quarter pixel up and left
        depth = depth[: 2 * camera.height : 2, : 2 * camera.width : 2]
        camera = replace(camera, cx=camera.cx + 0.25, cy=camera.cy + 0.25)
    with np.errstate(invalid="ignore"):
        good = (depth >= p.nearest_m) & (depth <= p.farthest_m)  # false for NaN as well
    kept: Floats32 = np.ascontiguousarray(np.where(good, depth, np.float32(0)))
    return replace(view, depth=kept, intrinsics=camera)


def _points(view: DepthFrame) -> Floats:
    """(N, 3) samples of a view in its own frame."""
    k = view.intrinsics
    y, x = np.nonzero(view.depth)
    z = view.depth[y, x].astype(np.float64)
    return np.stack([(x - k.cx) / k.fx * z, (y - k.cy) / k.fy * z, z], axis=1)


def _chosen_voxel(
    views: Sequence[DepthFrame], points: Sequence[Floats], p: FusionParameters
) -> float:
    """The wanted edge, or the least at which pixels leave no gaps and blocks suffice."""
    if p.voxel_m is not None:
        count = _count(views, points, p.voxel_m)
        if count > p.most_blocks:
            # blocks are of surfaces: their number falls with the square of the edge
            enough = p.voxel_m * math.sqrt(count / p.most_blocks) * 1.05
            raise InvalidRequest(
                f"Voxels of {p.voxel_m:g} m take {count} blocks of memory, and there may be "
                f"{p.most_blocks}. Ask for {enough:.3f} m or more, or for fewer views.",
                (("voxel_m", "is too small for the extent of the views"),),
            )
        return p.voxel_m
    pixels = [
        float(np.median(own[:, 2])) / min(view.intrinsics.fx, view.intrinsics.fy)
        for view, own in zip(views, points, strict=True)
        if len(own)
    ]
    voxel = max(p.finest_m, round(2 * float(np.median(pixels)), 3))
    while _count(views, points, voxel) > p.most_blocks:
        voxel = round(voxel * 1.25, 4)
    return voxel


def _count(views: Sequence[DepthFrame], points: Sequence[Floats], voxel: float) -> int:
    """How many blocks the surfaces of all views touch."""
    blocks = [_blocks(_pose(v), own, voxel) for v, own in zip(views, points, strict=True)]
    return len(np.unique(np.concatenate(blocks), axis=0))


def _blocks(T: Floats, points: Floats, voxel: float) -> NDArray[np.int32]:
    """(B, 3) the blocks within the band along the rays of a view, by T_parent_view."""
    if not len(points):
        return np.zeros((0, 3), np.int32)
    band, edge = BAND * voxel, _SIDE * voxel
    z = points[:, 2:]
    keys = []
    for offset in np.linspace(-band, band, 5):  # at a slant too, steps are less than a block
        cells = np.floor(moved(T, points * np.maximum((z + offset) / z, 0.0)) / edge)
        packed = (cells.astype(np.int64) + (1 << 20)) @ np.array([1 << 42, 1 << 21, 1])
        keys.append(np.unique(packed))
    packed = np.unique(np.concatenate(keys))
    cells = np.stack([packed >> 42, (packed >> 21) & 0x1FFFFF, packed & 0x1FFFFF], axis=1)
    return (cells - (1 << 20)).astype(np.int32)


def _meshed(
    o3d: Any,
    views: Sequence[DepthFrame],
    points: Sequence[Floats],
    voxel: float,
    p: FusionParameters,
) -> TriangleMesh:
    core, geometry = o3d.core, o3d.t.geometry
    grid = geometry.VoxelBlockGrid(
        ("tsdf", "weight"), (core.float32, core.float32), ((1,), (1,)), voxel_size=voxel,
        block_resolution=_SIDE, block_count=2048, device=core.Device("CPU:0"),
    )  # fmt: skip
    for view, own in zip(views, points, strict=True):
        T = _pose(view)
        blocks, k = _blocks(T, own, voxel), view.intrinsics
        if not len(blocks):
            continue
        camera = np.array([[k.fx, 0, k.cx], [0, k.fy, k.cy], [0, 0, 1.0]])
        grid.integrate(
            core.Tensor(blocks), geometry.Image(core.Tensor(view.depth)), core.Tensor(camera),
            core.Tensor(inverse(T)), 1.0, p.farthest_m, BAND,
        )  # fmt: skip
    try:
        made = grid.extract_triangle_mesh(0.5)  # what one view saw counts
    except RuntimeError as error:  # Open3D's word for a mesh without any point
        raise UselessFrame(
            f"The {len(views)} views make no surface of voxels of {voxel:g} m. Ask for smaller "
            "ones, or choose other frames."
        ) from error
    return _in_order(
        made.vertex.positions.numpy().astype(np.float64),
        made.vertex.normals.numpy().astype(np.float64),
        made.triangle.indices.numpy().astype(np.int32),
    )


def _in_order(points: Floats, normals: Floats, triangles: NDArray[np.int32]) -> TriangleMesh:
    """A mesh whose order does not depend on that of a hash table."""
    order = np.lexsort(points.T[::-1])
    place = np.empty(len(order), np.int32)
    place[order] = np.arange(len(order), dtype=np.int32)
    triangles = place[triangles].reshape(-1, 3)
    start = triangles.argmin(axis=1) if len(triangles) else np.zeros(0, np.intp)
    turned = (start[:, None] + np.arange(3)) % 3  # its least index first; the winding stays
    triangles = np.take_along_axis(triangles, turned, axis=1)
    triangles = triangles[np.lexsort(triangles.T[::-1])]
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return TriangleMesh(points[order], (normals / np.maximum(length, 1e-12))[order], triangles)


def _pose(view: DepthFrame) -> Floats:
    if view.pose is None:
        raise ValueError(f"view {view.name!r} has no pose")
    return view.pose


# A fused surface as a picture.

#: One for each view in order, then again; the query's grey first.
PALETTE = np.array(
    [
        (150, 154, 160), (49, 112, 184), (222, 126, 46), (52, 160, 105), (158, 84, 172),
        (205, 168, 50), (70, 172, 190), (196, 72, 82), (128, 110, 76), (110, 120, 200),
    ],
    np.uint8,
)  # fmt: skip
#: Samples along each edge of a pixel; half the angle of the picture, radians.
_FINER, _HALF_ANGLE = 2, math.radians(19.0)
#: How far the viewer is turned from the query's direction, and how steeply he looks down.
_AZIMUTH, _ELEVATION = math.radians(24.0), math.radians(38.0)
#: Length of a drawn camera's view cone, metres.
_CONE = 0.18


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """Whence a picture is taken: x right, y down, z away from the viewer.

    Parameters
    ----------
    T_viewer_query : (4, 4)
    focal : pixels
    width, height : pixels
    """

    T_viewer_query: Floats
    focal: float
    width: int
    height: int

    def pixels(self, points: Floats) -> Floats:
        """(N, 3) of points (N, 3): x and y in pixels, depth in metres."""
        seen = moved(self.T_viewer_query, points)
        z = np.maximum(seen[:, 2], 1e-3)
        middle = ((self.width - 1) / 2, (self.height - 1) / 2)
        return np.column_stack([self.focal * seen[:, :2] / z[:, None] + middle, seen[:, 2]])


def viewpoint(mesh: TriangleMesh, cameras: Floats, width: int, height: int) -> Viewpoint:
    """From behind and above the query, so that all is in view: floors level, and nothing between.

    Parameters
    ----------
    mesh : to be seen, in the query's camera frame
    cameras : (V, 3) that should be in view too
    width, height : of the picture, pixels
    """
    level = levelling(mesh.normals)
    forward = level @ (0.0, 0.0, 1.0)
    azimuth = math.atan2(forward[0], forward[2]) + _AZIMUTH
    turned = _about_x(_ELEVATION) @ _about_y(-azimuth) @ level
    points = mesh.points @ turned.T
    if len(points):  # a few stray points must not make all else small
        low, high = np.percentile(points, (0.05, 99.95), axis=0)
        points = points[((points >= low) & (points <= high)).all(axis=1)]
    points = np.concatenate([points, cameras @ turned.T])
    slope = np.array([math.tan(_HALF_ANGLE), math.tan(_HALF_ANGLE) * height / width])
    # the cone of view that just holds all points: four planes, each pushed out to the last point
    right, left = (points[:, :2] * sign - points[:, 2:] * slope for sign in (1.0, -1.0))
    middle = (right.max(axis=0) - left.max(axis=0)) / 2
    away = ((right.max(axis=0) + left.max(axis=0)) / 2 / slope).max() * 1.06 + 1e-3
    T = np.eye(4)
    T[:3, :3] = turned
    T[:3, 3] = (-middle[0], -middle[1], away)
    return Viewpoint(T, width / 2 / math.tan(_HALF_ANGLE), width, height)


@kernel
def _fill(
    corners: Floats, triangles: Ints32, colours: Floats32, depth: Floats32, picture: Floats32
) -> None:
    """Triangles that face the viewer, nearest in front; corners (N, 3) pixels and metres."""
    height, width = depth.shape
    for t in range(len(triangles)):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        ax, ay, az = corners[a, 0], corners[a, 1], corners[a, 2]
        bx, by, bz = corners[b, 0], corners[b, 1], corners[b, 2]
        cx, cy, cz = corners[c, 0], corners[c, 1], corners[c, 2]
        if min(az, bz, cz) < 1e-2:
            continue
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if not area < 0:  # y points down: what faces the viewer turns the other way
            continue
        x0, x1 = max(int(np.ceil(min(ax, bx, cx))), 0), min(int(max(ax, bx, cx)), width - 1)
        y0, y1 = max(int(np.ceil(min(ay, by, cy))), 0), min(int(max(ay, by, cy)), height - 1)
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                u = ((bx - x) * (cy - y) - (by - y) * (cx - x)) / area
                v = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) / area
                w = 1.0 - u - v
                if u < 0 or v < 0 or w < 0:
                    continue
                z = np.float32(u * az + v * bz + w * cz)
                if z < depth[y, x]:
                    depth[y, x] = z
                    for i in range(3):
                        picture[y, x, i] = u * colours[a, i] + v * colours[b, i] + w * colours[c, i]


def rendered(
    mesh: TriangleMesh, first: Ints32, cameras: Sequence[DepthFrame], view: Viewpoint
) -> Bytes:
    """A mesh as a picture, without what faces away: a room is looked into from above.

    Parameters
    ----------
    mesh : in the query's frame
    first : (N,) which view a point is coloured by
    cameras : the views, drawn as small cones; their poses are T_query_view
    view : see `viewpoint`

    Returns
    -------
    (height, width, 3) uint8, white where there is nothing
    """
    fine = Viewpoint(
        view.T_viewer_query, view.focal * _FINER, view.width * _FINER, view.height * _FINER
    )
    normals = mesh.normals @ view.T_viewer_query[:3, :3].T
    # most light from above, on what lies level; some from the viewer, on what stands
    above, ahead = normals @ (0.30, -0.85, -0.43), normals @ (-0.45, 0.0, -0.89)
    shade = 0.46 + 0.34 * np.clip(above, 0, 1) + 0.34 * np.clip(ahead, 0, 1)
    colours = np.minimum(PALETTE[first % len(PALETTE)] * shade[:, None], 255).astype(np.float32)
    depth = np.full((fine.height, fine.width), np.inf, np.float32)
    picture = np.full((fine.height, fine.width, 3), 255, np.float32)
    _fill(fine.pixels(mesh.points), mesh.triangles, colours, depth, picture)
    picture *= _crevices(depth)[..., None]
    small = picture.reshape(view.height, _FINER, view.width, _FINER, 3).mean(axis=(1, 3))
    drawn = np.clip(np.rint(small), 0, 255).astype(np.uint8)
    return _with_cameras(drawn, cameras, view)


def _crevices(depth: Floats32) -> Floats32:
    """(h, w) factor below 1 where what is around lies nearer to the viewer: edges stand out."""
    far = np.where(np.isfinite(depth), depth, np.float32(np.nan))
    logs = np.log(far)
    darker = np.zeros_like(depth)
    for step in (2, 5):
        for axis in (0, 1):
            for way in (step, -step):
                # np.roll wraps around the edge, where there is nothing to be seen
                darker += np.nan_to_num(np.clip(logs - np.roll(logs, way, axis), 0, 0.03))
    factor: Floats32 = np.exp(-4.0 * darker).astype(np.float32)
    return factor


def _with_cameras(picture: Bytes, cameras: Sequence[DepthFrame], view: Viewpoint) -> Bytes:
    """View cones drawn over a picture; the query's comes last."""
    from PIL import Image, ImageDraw

    image = Image.fromarray(picture).resize((view.width * 2, view.height * 2))
    draw = ImageDraw.Draw(image, "RGBA")
    for i in reversed(range(len(cameras))):
        camera = cameras[i]
        k, T = camera.intrinsics, camera.pose
        if T is None:
            continue
        corners = np.array(
            [
                ((x - k.cx) / k.fx, (y - k.cy) / k.fy, 1.0)
                for x, y in ((0, 0), (k.width, 0), (k.width, k.height), (0, k.height))
            ]
        )
        tip, *base = view.pixels(moved(T, np.vstack([np.zeros(3), corners * _CONE])))[:, :2] * 2
        colour = tuple(int(c * 0.75) for c in PALETTE[i % len(PALETTE)])
        outline = [tuple(p) for p in base]
        draw.polygon(outline, fill=(*colour, 70))
        for line in ([*outline, outline[0]], *([tuple(tip), corner] for corner in outline)):
            draw.line(line, fill=(*colour, 255), width=4, joint="curve")
    return np.asarray(image.resize((view.width, view.height), Image.Resampling.BOX))


def reconstruction_picture(
    mesh: TriangleMesh,
    first: Ints32,
    views: Sequence[DepthFrame],
    added: Sequence[float],
    title: str,
) -> bytes:
    """The picture of a reconstruction as PNG: the surface, and what each view adds to it.

    Parameters
    ----------
    mesh : in the query's frame
    first : (N,) which view a point is coloured by
    views : in order, with names and poses T_query_view
    added : (V,) square metres that each view adds
    title : over the picture
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    centres = np.array([v.pose[:3, 3] for v in views if v.pose is not None]).reshape(-1, 3)
    drawn = rendered(mesh, first, views, viewpoint(mesh, centres, 1080, 860))
    figure = Figure(figsize=(14.4, 9.2), dpi=100, facecolor="white")
    FigureCanvasAgg(figure)
    figure.text(0.015, 0.965, title, fontsize=15, va="center", parse_math=False)
    figure.figimage(drawn, xo=8, yo=12)
    tall = min(0.055 * len(views) + 0.02, 0.78)
    _added(figure.add_axes((0.835, 0.88 - tall, 0.115, tall)), views, added)
    buffer = BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def _added(axes: Any, views: Sequence[DepthFrame], added: Sequence[float]) -> None:
    """Bars from above in the order of the views, each beginning where the last one ended."""
    total, place = np.cumsum([0.0, *added]), np.arange(len(views))
    colours = PALETTE[place % len(PALETTE)] / 255
    axes.barh(place, added, left=total[:-1], color=colours, height=0.7)
    axes.set_ylim(len(views) - 0.4, -0.6)
    axes.set_yticks(place, [view.name[:12] for view in views], parse_math=False, fontsize=9)
    axes.set_title("surface by view, m²", loc="left", fontsize=11)
    for i, area in enumerate(added):
        axes.annotate(f"+{area:.2f}", (total[i + 1], i), (3, 0), textcoords="offset points",
                      va="center", fontsize=9, annotation_clip=False)  # fmt: skip
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="x", color="#e8eaee", lw=0.8)
    axes.set_axisbelow(True)


def _about_x(angle: float) -> Floats:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def _about_y(angle: float) -> Floats:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
