"""Manual results of validation on small scenes; each check takes the module under test."""

import math
from dataclasses import replace
from itertools import product

import numpy as np

from sceneprint.types import Intrinsics, Sphere, Surface, camera_of

#: Pixels are a degree wide; the ray of pixel (20, 15) is the optical axis.
CAMERA = Intrinsics(41, 31, 57.0, 57.0, 20.0, 15.0)
CENTRE = (20, 15)
TOWARDS = np.array([0.0, 0.0, -1.0])


def wall(depth, normal=TOWARDS):
    """A surface of this depth, 0 where missing, whose normals are all the same."""
    z = np.broadcast_to(depth, (CAMERA.height, CAMERA.width))
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = np.dstack([(x - CAMERA.cx) / CAMERA.fx, (y - CAMERA.cy) / CAMERA.fy, np.ones(z.shape)])
    valid = z > 0
    normals = np.where(valid[..., None], normal, 0.0).astype(np.float32)
    points = (rays * z[..., None]).astype(np.float32)
    return Surface(points, normals, valid, np.ones(z.shape, np.float32), CAMERA)


def seen_at(pixel, z, normal=TOWARDS):
    """One point of `sampled`, at that depth in that pixel."""
    x, y = (pixel[0] - CAMERA.cx) / CAMERA.fx * z, (pixel[1] - CAMERA.cy) / CAMERA.fy * z
    return np.array([[x, y, z, *normal]], np.float32)


#: Pixels ten degrees wide about an axis; column 0 looks just past -180 degrees.
TEN = math.radians(10.0)
BALL = Sphere(36, 17, TEN, -math.pi + TEN / 2, math.radians(80.0))


def ray(azimuth, elevation, pole=2):
    """The direction, given in degrees."""
    a, e = math.radians(azimuth), math.radians(elevation)
    return np.roll([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)], pole - 2)


def ball(ranges, camera=BALL):
    """A sphere about the viewpoint of this range, 0 where missing, seen from inside."""
    r = np.broadcast_to(ranges, (camera.height, camera.width))
    azimuths = np.degrees(camera.left + camera.step * np.arange(camera.width))
    elevations = np.degrees(camera.top - camera.step * np.arange(camera.height))
    rays = np.array([[ray(a, e, camera.pole) for a in azimuths] for e in elevations])
    valid = r > 0
    normals = np.where(valid[..., None], -rays, 0.0).astype(np.float32)
    points = (rays * r[..., None]).astype(np.float32)
    return Surface(points, normals, valid, np.ones(r.shape, np.float32), camera)


def faced(azimuth, elevation, r):
    """One point of `sampled`, in that direction, that faces the viewpoint."""
    u = ray(azimuth, elevation)
    return np.array([[*(u * r), *-u]], np.float32)


def in_no_order(points, normals):
    """Points of a cloud without a viewpoint."""
    n = (1, len(points))
    return Surface(
        np.array(points, np.float32)[None], np.array(normals, np.float32)[None],
        np.ones(n, np.bool_), np.ones(n, np.float32), None,
    )  # fmt: skip


def quarter(axis, shift=(0.0, 0.0, 0.0)):
    """A turn by 90 degrees about an axis, then a shift."""
    a, b = (axis + 1) % 3, (axis + 2) % 3
    T = np.eye(4)
    T[a, a] = T[b, b] = 0.0
    T[b, a], T[a, b] = 1.0, -1.0
    T[:3, 3] = shift
    return T


def check_projecting(module):
    def seen(camera, at):
        result = module.project(camera_of(camera, 0.1), *map(float, at))
        return tuple(round(value, 9) for value in result)

    assert seen(CAMERA, (0, 0, 2)) == (20.5, 15.5, 2.0)
    assert seen(CAMERA, (0.2, 0.1, 2)) == (26.2, 18.35, 2.0)
    assert seen(Intrinsics(9, 9, 10.0, 20.0, 1.0, 2.0), (1, 1, 1)) == (11.5, 22.5, 1.0)
    for z in (0.1, 0.09, 0.0, -2.0, math.nan):
        assert seen(CAMERA, (0, 0, z))[:2] == (-1.0, -1.0)
    # azimuth 0 and elevation 0 lie between columns 17 and 18, in row 8
    for pole in range(3):
        camera = replace(BALL, pole=pole)
        for azimuth, elevation, column, line in (
            (0, 0, 18.0, 8.5), (30, 0, 21.0, 8.5), (-175, 20, 0.5, 6.5), (-179, -70, 0.1, 15.5),
            (179.5, 0, 35.95, 8.5), (-180, 0, 0.0, 8.5), (90, 80, 27.0, 0.5), (7, 89, 18.7, -0.4),
        ):  # fmt: skip
            for r in (0.2, 3.0):
                result = seen(camera, ray(azimuth, elevation, pole) * r)
                np.testing.assert_allclose(result[1:], (line, r), atol=1e-6)
                around = (result[0] - column) % 36
                assert min(around, 36 - around) < 1e-6, (azimuth, result)
        assert seen(camera, ray(20, 0, pole) * 0.09)[:2] == (-1.0, -1.0)
        assert seen(camera, (0, 0, 0)) == (-1.0, -1.0, 0.0)
    # of an image that is no full turn the far side is beyond the last column
    some = replace(BALL, width=10)
    assert seen(some, ray(-175, 0))[0] == 0.5
    assert seen(some, ray(175, 0))[0] == 35.5
    # a turn may be a fraction of a pixel more than the image: that is of its first column
    wide = replace(BALL, step=2 * math.pi / 36.3, left=0.0)
    assert seen(wide, ray(360 * 35.4 / 36.3, 0))[0] == 35.9
    assert seen(wide, ray(360 * 35.6 / 36.3, 0))[0] == 0.0
    assert seen(replace(wide, width=30), ray(360 * 35.6 / 36.3, 0))[0] == 36.1
    for kind, depth in ((0, 3.0), (1, 7.0), (2, 0.0)):
        assert module.depth_of(kind, 2.0, 6.0, 3.0) == depth
    points = np.zeros((3, 4, 3), np.float32)
    points[1, 2] = 2.0, 6.0, 3.0
    for camera, depth in ((CAMERA, 3.0), (BALL, 7.0)):
        array = camera_of(camera, 0.0)
        assert module.depth_at(array, points, 1, 2) == depth
        assert module.depth_at(array, points, 2, 1) == 0.0
    for power, grown in ((0, 1.0), (1, 1.5), (2, 2.25)):
        assert module.growth_at(3.0, 2.0, power) == grown
        assert module.growth_at(1.0, 2.0, power) == 1.0


def check_targets(module):
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (300, 3))
    normals = np.where(rng.random((300, 1)) < 0.5, [0, 0, 1.0], [0, 0.8, 0.6])
    whole = in_no_order(points, normals)
    t = module.lookup_target(whole, 0.1, 0.4)
    # the first in each small cube, here of 8 cm, in the order given
    small = np.floor(whole.points[0] / 0.08)
    first = [i for i in range(300) if not (small[:i] == small[i]).all(axis=1).any()]
    assert 200 < len(first) < 300
    np.testing.assert_array_equal(t.points[0], whole.points[0, first])
    np.testing.assert_array_equal(t.normals[0], whole.normals[0, first])
    none = 0
    for at in np.concatenate([rng.uniform(-1.3, 1.3, (60, 3)), [[0.39, 0.0, 9.0]]]):
        result = module.nearest_alike(
            t.points, t.normals, t.camera, t.heads, t.chain, at, np.array([0, 0.0, 1]), 0.7
        )
        away = np.linalg.norm(t.points[0] - at, axis=1)
        away[t.normals[0, :, 2] <= 0.7] = np.inf
        best = int(away.argmin())
        if away[best] < 0.4:
            assert result[0] == best
            np.testing.assert_allclose(result[1], away[best] ** 2, rtol=1e-5)
        else:
            assert result[0] == -1
            none += 1
    assert 5 < none < 50
    # of two as far off the first, whichever is walked to first
    for order in ([0, 1, 2], [2, 0, 1], [1, 2, 0]):
        pair = np.array([[0.25, 0, 0], [-0.25, 0, 0], [0, 0.25, 0]])[order]
        t = module.lookup_target(in_no_order(pair, np.tile([0, 0, 1.0], (3, 1))), 0.1, 0.4)
        result = module.nearest_alike(
            t.points, t.normals, t.camera, t.heads, t.chain, np.zeros(3), np.array([0, 0, 1.0]), 0.7
        )
        assert result == (0, 0.0625)
    # a pinhole's and a sphere's maps are looked up as they are
    for seen in (wall(2.0), ball(2.0)):
        t = module.lookup_target(seen, 0.1, 0.4)
        assert t.points is seen.points
        assert len(t.heads) == len(t.chain) == 0
    # at most so many, spread over all that is shown
    few = module.thin_points(whole, 50)
    assert 25 < few.valid.sum() <= 50
    assert few.camera is None
    gap = np.linalg.norm(whole.points[0][:, None] - few.points[0], axis=2)
    assert gap.min(axis=1).max() < 1.0
    where = gap.argmin(axis=0)
    np.testing.assert_array_equal(whole.points[0, where], few.points[0])
    np.testing.assert_array_equal(whole.normals[0, where], few.normals[0])
    same = module.thin_points(whole, 300)
    np.testing.assert_array_equal(same.points, whole.points)
    assert module.thin_points(in_no_order(np.ones((9, 3)), np.ones((9, 3))), 4).points.shape == (
        1,
        1,
        3,
    )


def check_agreement_of_clouds(module):
    p = module.OverlapParameters(
        surface_tolerance=0.05, point_tolerance=0.15, normal_cosine=0.7, free_space_margin=0.1,
        reference_depth=2.0, nearest=0.3, edge_px=1,
    )  # fmt: skip

    def agreement_of(source, target, T=None):
        result = module.overlap_counts(source, target, np.eye(4) if T is None else T, p)
        return result.inliers, result.violations

    on, through, nothing = (1, 0), (0, 1), (0, 0)
    # a sphere of 2 m about the viewpoint, looked at every way, its seam and below it too
    whole = ball(2.0)
    for azimuth, elevation in ((0, 0), (100, 30), (-135, -60), (179.9, 0), (-179.9, 10), (5, -80)):
        for r, expected in (
            (2.0, on), (1.96, on), (1.94, nothing), (1.91, nothing), (1.89, through),
            (0.31, through), (0.29, nothing), (2.05, on), (2.10, nothing), (9.0, nothing),
        ):  # fmt: skip
            at = round((azimuth + 175) / 10) * 10 - 175, round(elevation / 10) * 10
            assert agreement_of(faced(*at, r), whole) == expected, (at, r)
    # at four metres everything is four times as wide, and twice where lengths grow linearly
    p = replace(p, point_tolerance=0.5)
    for r, square, linear in ((4.19, on, nothing), (4.09, on, on), (4.21, nothing, through)):
        p = replace(p, growth=2)
        assert agreement_of(faced(5, 0, 4.0), ball(r)) == square
        p = replace(p, growth=1)
        assert agreement_of(faced(5, 0, 4.0), ball(r)) == linear
    p = replace(p, growth=2, point_tolerance=0.15)
    # 10 cm before the far side, which lies beyond a surface just across the seam
    r = np.full((17, 36), 2.0)
    r[:, 35] = 1.0
    for azimuth, expected in ((-175, nothing), (-165, through), (175, on)):
        assert agreement_of(faced(azimuth, 0, 1.0), ball(r)) == expected
    r = np.full((17, 36), 2.0)
    r[:, 0] = 1.0
    assert agreement_of(faced(175, 0, 1.0), ball(r)) == nothing
    # in an image that is no full turn nothing is across it
    some = replace(BALL, width=18)
    assert agreement_of(faced(-175, 0, 1.0), ball(2.0, some)) == through
    assert agreement_of(faced(175, 0, 1.0), ball(2.0, some)) == nothing
    r = np.full((17, 18), 2.0)
    r[:, 17] = 1.0
    assert agreement_of(faced(-175, 0, 1.0), ball(r, some)) == through
    # transforms act on points and normals
    T = quarter(0, (0.0, 1.0, 0.0))
    there = faced(-175, 10, 2.0)
    before = np.concatenate([(there[0, :3] - T[:3, 3]) @ T[:3, :3], there[0, 3:] @ T[:3, :3]])
    assert agreement_of(before[None].astype(np.float32), whole, T) == on
    # points in no order: a floor of points 2 cm apart; nothing is known of free space
    xy = np.array(list(product(np.arange(-10, 11) * 0.02, repeat=2))) + np.array([0.1, 0.0])
    floor = in_no_order(np.c_[xy, np.zeros(len(xy))], np.broadcast_to([0.0, 0, 1], (len(xy), 3)))
    up, side = (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)
    for at, facing, inliers in (
        ((0.0, 0.0, 0.04), up, 1), ((0.0, 0.0, 0.06), up, 0), ((0.11, 0.05, -0.04), up, 1),
        ((0.0, 0.0, 0.04), side, 0), ((0.42, 0.0, 0.0), up, 1), ((0.46, 0.0, 0.0), up, 0),
        ((0.0, -0.36, 0.0), up, 0), ((0.0, -0.33, 0.01), up, 1), ((0.0, 0.0, -1.0), up, 0),
        ((0.0, 0.0, -0.06), up, 0),
    ):  # fmt: skip
        source = np.array([[*at, *facing]], np.float32)
        assert agreement_of(source, floor) == (inliers, None), at
        # and carried elsewhere and back
        T = quarter(1, (3.0, -2.0, 7.0))
        away = in_no_order(floor.points[0] @ T[:3, :3].T + T[:3, 3], floor.normals[0] @ T[:3, :3].T)
        assert agreement_of(source, away, T) == (inliers, None), at
    both = np.array([[0, 0, 0, *up], [0.1, 0, 0, *up], [0, 0, 1, *up]], np.float32)
    weights = np.array([0.5, 0.25, 4.0], np.float32)
    assert module.agreements(both, floor, np.eye(4)[None], p, weights).tolist() == [[0.75, 0.0]]
    # of a thousand points in one place one is kept
    assert (
        len(module.overlap_target(in_no_order(np.zeros((1000, 3)), np.ones((1000, 3))), p).chain)
        == 1
    )
    # of points in no order as many are taken as of pixels: one of 25
    assert len(module.sample_points(floor, 5)) == 18
    # of a sphere of four times as many pixels as a depth image every tenth row and column
    large = Sphere(480, 160, 0.01, 0.0, 1.0)
    assert module.sample_points(ball(2.0, large), 5).shape == (48 * 16, 6)
    assert module.sample_points(whole, 5).shape == (7 * 3, 6)
    assert len(module.sample_points(ball(2.0, large), 1)) == 480 * 160


def check_agreement(module):
    p = module.OverlapParameters(
        surface_tolerance=0.05,
        point_tolerance=0.15,
        normal_cosine=0.7,
        free_space_margin=0.1,
        reference_depth=2.0,
    )

    def found(source, target, T=None):
        result = module.overlap_counts(source, target, np.eye(4) if T is None else T, p)
        assert result.points == len(source)
        return result.inliers, result.violations

    on, through, nothing = (1.0, 0.0), (0.0, 1.0), (0.0, 0.0)
    # a wall at 2 m, where tolerances have not begun to grow
    flat = wall(2.0)
    for z, expected in (
        (2.0, on), (1.96, on), (1.94, nothing), (1.91, nothing), (1.89, through), (0.5, through),
        (0.11, through), (0.09, nothing), (-2.0, nothing),
    ):  # fmt: skip
        assert found(seen_at(CENTRE, z), flat) == expected, z
    # behind the wall tolerances grow with z^2, and nothing is violated: 4.41 / 4 of 5 cm is 5.5 cm
    for z, expected in ((2.05, on), (2.10, nothing), (9.0, nothing)):
        assert found(seen_at(CENTRE, z), flat) == expected, z
    # normals 45 degrees apart agree, 46 do not: 0.7 is the cosine of 45.6; neither violates
    for degrees, expected in ((45, on), (46, nothing), (180, nothing)):
        a = math.radians(degrees)
        leaning = np.array([math.sin(a), 0.0, -math.cos(a)])
        assert found(seen_at(CENTRE, 2.0, leaning), flat) == expected
        assert found(seen_at(CENTRE, 1.0, leaning), flat) == through
    # the edge of the image is half a pixel past the last pixel's centre
    for pixel, expected in (
        ((-0.4, 15.0), on), ((-0.6, 15.0), nothing), ((40.4, 15.0), on), ((40.6, 15.0), nothing),
        ((20.0, -0.4), on), ((20.0, -0.6), nothing), ((20.0, 30.4), on), ((20.0, 30.6), nothing),
    ):  # fmt: skip
        assert found(seen_at(pixel, 2.0), flat) == expected, pixel
    # what the target did not see says nothing
    hole = np.full((31, 41), 2.0)
    hole[15, 20] = 0.0
    for z in (1.0, 2.0, 3.0):
        assert found(seen_at(CENTRE, z), wall(hole)) == nothing
        assert found(seen_at((22.0, 15.0), z), wall(hole)) == found(seen_at(CENTRE, z), flat)
    # at twice the reference depth everything is four times as wide
    for depth, expected in (
        (4.0, on), (4.19, on), (4.21, nothing), (4.39, nothing), (4.41, through), (3.61, nothing),
        (3.81, on), (3.79, nothing), (2.0, nothing),
    ):  # fmt: skip
        assert found(seen_at(CENTRE, 4.0), wall(depth)) == expected, depth
    # a floor seen at 6 degrees: 1 cm off its plane is 10 cm along the ray, 2 cm are 20 cm
    grazing = np.array([math.sqrt(1 - 0.1**2), 0.0, -0.1])
    for z, expected in ((1.9, on), (1.8, nothing)):
        assert found(seen_at(CENTRE, z, grazing), wall(2.0, grazing)) == expected
    # and 20 cm off its plane are 2 m along the ray
    assert found(seen_at(CENTRE, 1.1, grazing), wall(2.0, grazing)) == nothing
    assert found(seen_at(CENTRE, 0.9, grazing), wall(2.0, grazing)) == through
    # near an edge a pixel near by may be the one: left of column 20, above row 15 it is 1 m
    left, above = np.full((31, 41), 2.0), np.full((31, 41), 2.0)
    left[:, :20], above[:15] = 1.0, 1.0
    for edge in (1, 2):
        p = replace(p, edge_px=edge)
        for off, z, expected in (
            (edge - 1, 1.0, nothing), (edge, 1.0, through), (edge - 1, 0.91, nothing),
            (edge - 1, 0.89, through), (-1, 1.0, on), (0, 2.0, on),
        ):  # fmt: skip
            assert found(seen_at((20 + off, 15), z), wall(left)) == expected
            assert found(seen_at((20, 15 + off), z), wall(above)) == expected
    # at the border of the image there are fewer neighbours
    assert found(seen_at((40, 30), 1.0), wall(left)) == through
    assert found(seen_at((0, 0), 0.5), wall(left)) == through
    # transforms act on points and on normals: the source looks along x, and 1 m lower
    T = quarter(1, (0.0, 1.0, 0.0))  # about y: z goes to x, x to -z
    point = np.array([[-2.0, -1.0, 0.0, 1.0, 0.0, 0.0]], np.float32)
    assert found(point, flat, T) == on
    assert found(point, flat) == nothing
    # and a leaning wall's normal, from a source that lies on its side
    leaning = np.array([0.6, 0.0, -0.8])
    point = seen_at(CENTRE, 2.0, np.array([0.0, -0.6, -0.8]))
    assert found(point, wall(2.0, leaning), quarter(2)) == on
    # several transforms at once, weights in the place of numbers: 0.5 on, 0.25 through, 4 behind
    both = np.concatenate([seen_at(CENTRE, 2.0), seen_at(CENTRE, 1.0), seen_at(CENTRE, 3.0)])
    weights = np.array([0.5, 0.25, 4.0], np.float32)
    nearer, away = np.eye(4), np.eye(4)
    nearer[2, 3], away[0, 3] = -1.0, 50.0
    transforms = np.array([np.eye(4), nearer, away])
    result = module.agreements(both, flat, transforms, p, weights)
    assert result.tolist() == [[0.5, 0.25], [4.0, 0.5], [0.0, 0.0]]
    assert module.agreements(both, flat, transforms, p).tolist() == [[1, 1], [1, 1], [0, 0]]
    assert module.agreements(both, flat, transforms[:0], p).shape == (0, 2)


def check_sampling(module):
    seen = wall(np.arange(31 * 41).reshape(31, 41) + 1.0)
    seen.valid[7, 12] = False
    rows = module.sample_points(seen, 5)  # the middle of every full five
    assert (rows.shape, rows.dtype) == ((6 * 8 - 1, 6), np.float32)
    z = [y * 41 + x + 1 for y in range(2, 31, 5) for x in range(2, 41, 5) if (y, x) != (7, 12)]
    assert rows[:, 2].tolist() == z
    np.testing.assert_array_equal(rows[:, 3:], np.broadcast_to(TOWARDS, (47, 3)))
    assert len(module.sample_points(seen, 1)) == 31 * 41 - 1


def check_registration(module):
    def once(source, target, gate=0.1, T=None):
        p = module.RefinementParameters(
            1, 1, gate, gate, normal_cosine=0.7, reference_depth=2.0, minimum_points=1
        )
        return module.refine(source, target, np.eye(4) if T is None else T, p)

    # one point, 3 cm behind a wall: n = -z and p = (.2, .1, 2), so p x n = (-.1, .2, 0)
    at = (CAMERA.cx + 0.1 * 57, CAMERA.cy + 0.05 * 57)
    point = seen_at(at, 2.0)
    np.testing.assert_allclose(point[0, :3], [0.2, 0.1, 2.0], atol=1e-6)
    result = once(point, wall(1.97))
    # Tukey's weight (1 - .3^2)^2; both depths are 2: over .25 + (16 + 16) / 8
    row = np.array([-0.1, 0.2, 0.0, 0.0, 0.0, -1.0])
    weight = (1 - 0.3**2) ** 2 / 4.25
    np.testing.assert_allclose(result.information, weight * np.outer(row, row), atol=1e-6)
    assert result.points == 1
    # the shortest step that brings it onto the wall: residual -3 cm, |row|^2 = 1.05
    step = 0.03 / 1.05 * row
    np.testing.assert_allclose(result.T[:3, 3], step[3:], atol=1e-5)
    np.testing.assert_allclose(
        [result.T[2, 1], result.T[0, 2], result.T[1, 0]], [step[0], step[1], 0.0], atol=1e-5
    )
    # a point counts by its depth in both frames: 1 m before the source, 2 m before the target
    forward = np.eye(4)
    forward[2, 3] = 1.0
    result = once(seen_at(CENTRE, 1.0), wall(2.0), T=forward)
    np.testing.assert_allclose(result.information[5, 5], 1 / (0.25 + 17 / 8), rtol=1e-6)
    # beyond the gate, which grows with z^2, a point is forgotten
    for z, gap, takes_part in (
        (2.0, 0.09, True), (2.0, 0.11, False), (2.0, -0.11, False), (4.0, 0.39, True),
        (4.0, 0.41, False), (1.0, 0.09, True), (1.0, 0.11, False),
    ):  # fmt: skip
        assert (once(seen_at(CENTRE, z), wall(z + gap)) is not None) == takes_part, (z, gap)
    # and one whose normal is more than 45.6 degrees off
    for degrees, takes_part in ((45, True), (46, False), (180, False)):
        a = math.radians(degrees)
        leaning = np.array([math.sin(a), 0.0, -math.cos(a)])
        assert (once(seen_at(CENTRE, 2.0, leaning), wall(2.0)) is not None) == takes_part
    # on a plane seen at 6 degrees: 2 cm off the plane are 20 cm along the ray, 4 cm are 40 cm,
    # more than three gates
    grazing = np.array([math.sqrt(1 - 0.1**2), 0.0, -0.1])
    for z, takes_part in ((1.8, True), (1.6, False)):
        assert (once(seen_at(CENTRE, z, grazing), wall(2.0, grazing)) is not None) == takes_part
    # of the nine pixels the nearest point: in column 20 alone it is 1 m to the wall
    step_ = np.full((31, 41), 2.0)
    step_[:, 20] = 1.0
    for column, z, takes_part in (
        (20, 1.0, True), (21, 1.0, True), (19, 1.0, True), (22, 1.0, False),
        (21, 2.0, True), (20, 2.0, True), (20, 1.5, False),
    ):  # fmt: skip
        assert (once(seen_at((column, 15), z), wall(step_)) is not None) == takes_part
    # the outermost pixels have no nine
    for pixel, takes_part in (
        ((1.0, 15.0), True), ((0.0, 15.0), False), ((39.0, 15.0), True), ((40.0, 15.0), False),
        ((20.0, 1.0), True), ((20.0, 0.0), False), ((20.0, 29.0), True), ((20.0, 30.0), False),
    ):  # fmt: skip
        assert (once(seen_at(pixel, 2.0), wall(2.0)) is not None) == takes_part, pixel
    # what shows nothing is not near, though it be nearer to the sensor
    hole = np.zeros((31, 41))
    hole[15, 20] = 2.2
    assert once(seen_at(CENTRE, 1.0), wall(hole), gate=1.5) is not None
    assert once(seen_at(CENTRE, 2.0), wall(0.0)) is None
    assert once(seen_at(CENTRE, -2.0), wall(2.0)) is None
    assert once(np.empty((0, 6), np.float32), wall(2.0)) is None
    # gates narrow from the first to the last: at 9 cm a point takes part at first only, and
    # weighs little
    ring = [(10, 10), (20, 10), (30, 10), (10, 20), (20, 20), (30, 20)]
    some = np.concatenate([seen_at(pixel, 2.0) for pixel in ring] + [seen_at(CENTRE, 1.91)])
    for iterations, least, points in ((1, 7, 7), (2, 6, 6), (2, 7, None), (4, 6, 6)):
        p = module.RefinementParameters(
            1, iterations, 0.1, 0.02, reference_depth=2.0, minimum_points=least
        )
        result = module.refine(some, wall(2.0), np.eye(4), p)
        assert (result and result.points) == points
        assert result is None or np.abs(result.T - np.eye(4)).max() < 2e-3
    # at first only every second point takes part, at last all do
    for iterations, last, points in ((1, 0, 3), (1, 1, 6), (3, 1, 6), (3, 0, 3)):
        p = module.RefinementParameters(
            1, iterations, 0.1, 0.1, minimum_points=5, thinning=2, last_iterations=last
        )
        result = module.refine(some[:6], wall(2.0), np.eye(4), p)
        assert result.points == points
    # of points 1 and 3, which alone are off by 6 cm, the first steps know nothing
    uneven = np.concatenate(
        [seen_at(pixel, 1.94 if i % 2 else 2.0) for i, pixel in enumerate(ring)]
    )
    for thinning, moved in ((2, False), (1, True)):
        p = module.RefinementParameters(
            1, 3, 0.1, 0.1, minimum_points=1, thinning=thinning, last_iterations=0
        )
        result = module.refine(uneven, wall(2.0), np.eye(4), p)
        assert (abs(result.T[2, 3]) + np.abs(result.T[:3, :3] - np.eye(3)).max() > 1e-3) == moved


def check_registration_of_clouds(module):
    p = module.RefinementParameters(
        1, 1, 0.1, 0.1, normal_cosine=0.7, reference_depth=2.0, minimum_points=1, reach=0.3
    )

    def once(source, target, kind, p=p):
        return module.refine(source, target, np.eye(4), p, kind)

    # one point, 3 cm before a sphere of 2 m: it faces the viewpoint, so no turn moves it
    u = ray(-125, 40)
    result = once(faced(-125, 40, 1.97), ball(2.0), 1)
    row = np.concatenate([np.zeros(3), u])
    for kind, near in ((1, 1.97), (2, 0.0), (0, 1.97 * u[2])):
        weight = (1 - 0.3**2) ** 2 / (0.25 + (near**4 + 1.97**4) / 8)
        result = once(faced(-125, 40, 1.97), ball(2.0), kind)
        np.testing.assert_allclose(result.information, weight * np.outer(row, row), atol=1e-6)
        np.testing.assert_allclose(result.T[:3, 3], 0.03 * u, atol=1e-5)
    # twice as far before weights fall: as if at half the depth
    result = once(faced(-125, 40, 1.97), ball(2.0), 1, replace(p, weight_depth=2.0))
    weight = (1 - 0.3**2) ** 2 / (0.25 + (1.97 / 2) ** 4 / 4)
    np.testing.assert_allclose(result.information, weight * np.outer(row, row), atol=1e-6)
    # gates grow with range
    for r, growth, takes_part in ((4.39, 2, True), (4.21, 1, False), (4.19, 1, True), (4.09, 0, 1)):
        q = replace(p, growth=growth)
        assert (once(faced(5, 0, 4.0), ball(r), 1, q) is not None) == bool(takes_part)
    # across the seam, either way; columns 0 and 35 are neighbours
    for column, azimuth in ((35, -175), (0, 175), (34, -175), (1, 175)):
        r = np.zeros((17, 36))
        r[:, column] = 2.0
        near = faced(azimuth + (4.9 if azimuth > 0 else -4.9), 0, 2.0)
        result = once(near, ball(r), 1, replace(p, first_gate=0.2, last_gate=0.2))
        assert (result is not None) == (column in (0, 35)), column
    # an image that is no full turn has an edge
    some = replace(BALL, width=18)
    for azimuth, takes_part in ((-175, False), (-165, True), (-15, True), (-5, False)):
        assert (once(faced(azimuth, 0, 2.0), ball(2.0, some), 1) is not None) == takes_part
    # nor are there nine pixels at the top and at the bottom
    for elevation, takes_part in ((80, False), (70, True), (-70, True), (-80, False)):
        assert (once(faced(5, elevation, 2.0), ball(2.0), 1) is not None) == takes_part
    # on points in no order, by place: the nearest that faces the same way
    target = in_no_order([[0.2, 0.1, 2.0], [0.2, 0.1, 1.99], [0.4, 0.1, 2.0]],
                         [[0, 0, -1.0], [1.0, 0, 0], [0, 0, -1.0]])  # fmt: skip
    source = np.array([[0.2, 0.1, 1.97, 0.0, 0.0, -1.0]], np.float32)
    row = np.array([-0.1, 0.2, 0.0, 0.0, 0.0, -1.0])
    for kind, near in ((0, 1.97), (1, math.sqrt(0.05 + 1.97**2)), (2, 0.0)):
        result = once(source, target, kind)
        weight = (1 - 0.3**2) ** 2 / (0.25 + near**4 / 4)
        np.testing.assert_allclose(result.information, weight * np.outer(row, row), atol=1e-6)
        assert result.points == 1
        np.testing.assert_allclose(result.T[:3, 3], -0.03 / 1.05 * row[3:], atol=1e-5)
    for z, takes_part in ((1.91, True), (1.89, False), (2.09, True), (2.11, False)):
        source[0, 2] = z
        assert (once(source, target, 0) is not None) == takes_part
    source[0, :3] = 0.2, 0.42, 2.0  # three decimetres off is out of reach
    assert once(source, target, 0) is None
    source[0, 1] = 0.38
    assert once(source, target, 0) is not None
