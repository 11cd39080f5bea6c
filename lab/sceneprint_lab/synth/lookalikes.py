"""Depth frames of ambiguous places: symmetric objects and repeated rooms.

kind, seed, index  --synthesise_lookalike-->  LookalikeSite: frames of a map, and queries

object    map: every fourth view of a circle around a symmetric object on a bare floor;
          queries: other views of the circle
offices   map: all rooms of a row of equal rooms (odd numbers: all bays of a hall);
          queries: other views of them
unmapped  map: all rooms of such a row except one; queries: views of the omitted room
kitchens  map: one kitchen; queries: another kitchen with the same furniture in the same order
opposite  map: furniture in a room, from one side; queries: from the other side
absent    map: rooms and an object; queries: other rooms and another object

and, for comparison, ordinary places:

rooms     map: a few different rooms; queries: other views of them
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np

from sceneprint.types import AnyFrame, DepthFrame, Floats, Intrinsics
from sceneprint_lab.synth.dataset import KINECT, own_sensor, render, take
from sceneprint_lab.synth.furniture import (
    Piece,
    chair,
    counter,
    cupboard,
    desk,
    fittings,
    floor_thing,
    fridge,
    kitchen_row,
    overhead,
    rack,
    scatter,
    shelf,
    swivel_chair,
    table,
    wall_yaw,
    with_openings,
)
from sceneprint_lab.synth.mesh import (
    Ceiling,
    SyntheticMesh,
    Wall,
    blob,
    box,
    cylinder,
    ellipsoid,
    join,
    mesh_of,
    shell,
    tube,
    walls_of,
)
from sceneprint_lab.synth.rooms import Floor, Maker, PiecePose, Room, make_room
from sceneprint_lab.synth.sensors import KINECT_V1, KinectNoise
from sceneprint_lab.synth.trajectories import orbit, scattered_poses

KINDS = ("object", "offices", "unmapped", "kitchens", "opposite", "absent")
#: Kinds of sites without similar places.
ORDINARY = ("rooms",)
#: Kinds of sites whose maps do not contain the places of the queries.
ELSEWHERE = ("unmapped", "kitchens", "absent")
#: Kinds of ELSEWHERE whose queries have their own parent frame.
APART = ("kitchens", "absent")


#: Type of the frames of a site: DepthFrame or Cloud.
F_co = TypeVar("F_co", bound=AnyFrame, covariant=True)


@dataclass(frozen=True, eq=False)
class LookalikeSite(Generic[F_co]):
    """A map, and queries that are ambiguous.

    Parameters
    ----------
    name : name such as "object-000"
    kind : one of KINDS, or of `lookalike_surveys.SURVEYED_KINDS`
    seed, index : arguments from which the site was generated
    map, queries : depth frames with T_world_camera, or clouds with T_world_sensor
    present : whether the queries show places of the map
    """

    name: str
    kind: str
    seed: int
    index: int
    map: tuple[F_co, ...]
    queries: tuple[F_co, ...]
    present: bool

    @property
    def same_frame(self) -> bool:
        """Return whether map and queries have one parent frame, so that poses are comparable."""
        return self.kind not in APART


@dataclass(frozen=True, eq=False)
class FramePlan:
    """The scenes and poses of a site's frames, and the offset of each scene in the world."""

    map: Sequence[tuple[Room, Floats]]
    queries: Sequence[tuple[Room, Floats]]
    shift: Callable[[Room], Floats] = lambda _: np.zeros(3)


def synthesise_lookalike(
    kind: str, seed: int, index: int, *, queries: int = 12, noise: KinectNoise | None = KINECT_V1,
    intrinsics: Intrinsics = KINECT,
) -> LookalikeSite[DepthFrame]:  # fmt: skip
    """Generate an ambiguous site, and return its map and queries, which are depth frames.

    The result depends only on the arguments.

    Parameters
    ----------
    kind : one of KINDS or ORDINARY
    seed, index : seed of the collection, and index of the site among those of its kind
    queries : number of queries
    noise : sensor noise; None for ideal depth
    intrinsics : camera

    Raises
    ------
    MissingDependency : If Embree cannot be imported
    ValueError : If the kind does not exist
    """
    kinds = KINDS + ORDINARY
    if kind not in kinds:
        raise ValueError(
            f"There is no kind {kind!r} of look-alikes. Choose from {', '.join(kinds)}."
        )
    rng = np.random.default_rng(np.random.SeedSequence((seed, index, 16 + kinds.index(kind))))
    shoot = _SHOOTS[kind](rng, index, queries)
    sensor = own_sensor(noise, intrinsics, rng) if noise else None
    if sensor is not None and kind == "object":
        sensor = worse_sensor(sensor, rng)
    name = f"{kind}-{index:03d}"

    def shots(part: str, views: Sequence[tuple[Room, Floats]]) -> tuple[DepthFrame, ...]:
        frames = []
        for number, (room, T) in enumerate(views):
            depth = (
                take(room, T, intrinsics, rng, sensor) if sensor else render(room, T, intrinsics)
            )
            placed = T.copy()
            placed[:3, 3] += shoot.shift(room)
            frames.append(
                DepthFrame(depth, intrinsics, f"{name}/{part}/frame-{number:06d}", placed)
            )
        return tuple(frames)

    return LookalikeSite(
        name, kind, seed, index, shots("map", shoot.map), shots("queries", shoot.queries),
        kind not in ELSEWHERE,
    )  # fmt: skip


def worse_sensor(sensor: KinectNoise, rng: np.random.Generator) -> KinectNoise:
    """Return a sensor with more noise and a shorter range."""
    s = float(rng.uniform(1.0, 2.0))
    return replace(
        sensor, disparity_sigma=sensor.disparity_sigma * s, warp=sensor.warp * s * 1.5,
        grazing_start=sensor.grazing_start - math.radians(rng.uniform(0.0, 8.0)),
        farthest=float(rng.uniform(3.0, 5.5)),
    )  # fmt: skip


# Objects that are symmetric apart from details.
#
# rng  --symmetric_object-->  SymmetricObject


@dataclass(frozen=True, eq=False)
class SymmetricObject:
    """A symmetric object that stands on z = 0 around the z axis.

    Parameters
    ----------
    body : mesh that is invariant to rotations by 2 pi / order about z
    details : small parts that break the symmetry
    order : order of the symmetry
    """

    body: SyntheticMesh
    details: SyntheticMesh
    order: int

    @property
    def mesh(self) -> SyntheticMesh:
        """Return body and details as a single mesh."""
        return join([self.body, self.details])


def cabinet(rng: np.random.Generator) -> SymmetricObject:
    """Return a cabinet that has the same doors on both long sides, and details on one side.

    It stands on a plinth or on legs; 70 % of the cabinets have a narrower upper part.
    """
    w, d, h = rng.uniform((0.6, 0.35, 0.5), (1.3, 0.65, 1.1))
    foot, over = rng.uniform(0.03, 0.16), rng.uniform(0.0, 0.03)
    n, t = int(rng.integers(1, 4)), float(rng.uniform(0.008, 0.025))
    doors = [
        box(w / n - 0.012, t, h - foot - 0.05, ((k + 0.5) * w / n - w / 2, -d / 2 - t / 2, foot))
        for k in range(n)
    ]
    half = join([box(w, d / 2, h - foot, (0, -d / 4, foot)), *doors])
    parts = [half, half.moved(yaw=math.pi)]
    parts.append(box(w + 2 * over, d + 2 * over + 2 * t, 0.025, (0, 0, h)))
    if foot > 0.09:
        x, y = w / 2 - 0.04, d / 2 - 0.04
        parts += [box(0.05, 0.05, foot, (a * x, b * y, 0)) for a in (-1, 1) for b in (-1, 1)]
    else:
        parts.append(box(w * 0.96, d * 0.9, foot))
    if rng.random() < 0.7:
        a, b, c = rng.uniform((0.4, 0.4, 0.15), (0.8, 0.85, 0.5)) * (w, d, 1.0)
        parts.append(box(a, b, c, (0, 0, h + 0.02)))
        if rng.random() < 0.5:  # a board on it
            parts.append(box(a + 0.12, b + 0.08, 0.03, (0, 0, h + c + 0.02)))
    return SymmetricObject(join(parts), _details(rng, w, d + 2 * t, h), 2)


def four_legs(rng: np.random.Generator) -> SymmetricObject:
    """Return a table with four legs; a cable duct and sometimes a book break its symmetry."""
    w, h = rng.uniform(0.6, 1.3), rng.uniform(0.45, 0.78)
    d = w if rng.random() < 0.5 else w * rng.uniform(0.5, 0.8)
    t, inset = rng.uniform(0.04, 0.09), rng.uniform(0.0, 0.05)
    x, y = (w - t) / 2 - inset, (d - t) / 2 - inset
    parts = [box(t, t, h - 0.03, (a * x, b * y, 0)) for a in (-1, 1) for b in (-1, 1)]
    parts += [box(w, d, 0.03, (0, 0, h - 0.03)), box(2 * x, 2 * y, 0.07, (0, 0, h - 0.1))]
    details = [box(0.02, 0.02, h - 0.05, (x + t / 2, y, 0.0))]  # a cable duct along one leg
    if rng.random() < 0.5:
        at = rng.uniform(-0.3, 0.3, 2) * (w, d)
        details.append(small_flat(rng).moved((*at, h), rng.uniform(0, 3)))
    return SymmetricObject(join(parts), join(details), 4 if d == w else 2)


def column(rng: np.random.Generator) -> SymmetricObject:
    """Return a round or square column on a wider foot, with a duct and a socket."""
    size, h, foot = rng.uniform(0.3, 0.65), 2.6, rng.uniform(0.05, 0.3)
    is_round, wider = rng.random() < 0.4, rng.uniform(0.02, 0.08)
    if is_round:
        parts = [cylinder(size / 2, h, 36), cylinder(size / 2 + wider, foot, 36)]
    else:
        parts = [box(size, size, h), box(size + 2 * wider, size + 2 * wider, foot)]
    a = size / 2
    x = rng.uniform(-0.3, 0.3) * size * (not is_round)
    details = [box(0.04, 0.025, h - foot, (x, -a, foot))]
    details += [box(0.08, 0.02, 0.08, (0.3 * a, a - 0.01 * is_round, rng.uniform(0.4, 1.2)))]
    return SymmetricObject(join(parts), join(details), 36 if is_round else 4)


def double_sofa(rng: np.random.Generator) -> SymmetricObject:
    """Return seats on both sides of a common back, with a blanket or cushion on one side."""
    w, d, h = rng.uniform((0.9, 0.9, 0.36), (1.8, 1.3, 0.46))
    arm, rise, soft = rng.uniform(0.1, 0.2), rng.uniform(0.25, 0.45), rng.uniform(0.15, 0.4)
    seat = ellipsoid(((w - 2 * arm) / 2, d / 4, 0.09), soft, 20).moved((0, -d / 4, h - 0.14))
    parts = [seat, seat.moved(yaw=math.pi), box(w, d, h - 0.08, (0, 0, 0.04))]
    parts.append(ellipsoid((w / 2, 0.1, (h + rise) / 2), soft, 20))
    parts += [box(arm, d, h + 0.15, (a * (w - arm) / 2, 0, 0)) for a in (-1, 1)]
    at = (rng.uniform(-0.3, 0.3) * w, -0.55 * d / 2, h + 0.03)
    blanket = box(rng.uniform(0.2, 0.5), rng.uniform(0.2, 0.35), rng.uniform(0.01, 0.03))
    if rng.random() < 0.25:
        blanket = blob(rng, rng.uniform((0.14, 0.1, 0.04), (0.2, 0.16, 0.08)), 0.05)
    return SymmetricObject(join(parts), blanket.moved(at, rng.normal(0, 0.2)), 2)


def small_flat(rng: np.random.Generator) -> SyntheticMesh:
    """Return a flat object, such as a book, a tablet or a stack of paper."""
    return box(rng.uniform(0.12, 0.3), rng.uniform(0.1, 0.22), rng.uniform(0.008, 0.03))


def _details(rng: np.random.Generator, w: float, d: float, h: float) -> SyntheticMesh:
    """Return one to three details on the side y = -d / 2 or the top of a cabinet."""
    makers: list[Callable[[], SyntheticMesh]] = [
        lambda: box(0.14, 0.025, 0.02, (rng.uniform(-0.4, 0.4) * w, -d / 2, h * 0.6)),
        lambda: box(0.02, 0.006, h * 0.8, (rng.uniform(-0.4, 0.4) * w, -d / 2, h * 0.1)),
        lambda: _cable(rng, w, d, h),
        lambda: _bump(rng, w, d, h),
        lambda: small_flat(rng).moved((rng.uniform(-0.25, 0.25) * w, 0, h + 0.025), 0.3),
    ]
    chosen = rng.choice(len(makers), int(rng.integers(1, 4)), replace=False)
    return join(makers[int(k)]() for k in chosen)


def _cable(rng: np.random.Generator, w: float, d: float, h: float) -> SyntheticMesh:
    r, x, y = rng.uniform(0.004, 0.009), w * rng.uniform(-0.4, 0.4), -d / 2
    out = rng.uniform(0.2, 0.6)
    return tube([(x, y - r, h * 0.5), (x, y - r, r), (x + 0.2, y - out, r)], float(r), 6)


def _bump(rng: np.random.Generator, w: float, d: float, h: float) -> SyntheticMesh:
    """Return a bump of 4 to 10 mm in sheet metal."""
    out = rng.uniform(0.004, 0.01)
    cap = ellipsoid((rng.uniform(0.03, 0.1), out, rng.uniform(0.03, 0.1)), 1.0, 12)
    return cap.moved((rng.uniform(-0.3, 0.3) * w, -d / 2, h * rng.uniform(0.2, 0.7)))


OBJECTS = (cabinet, four_legs, column, double_sofa)
_FREQUENCIES = (0.5, 0.15, 0.1, 0.25)


def symmetric_object(rng: np.random.Generator) -> SymmetricObject:
    """Return a cabinet, table, column or sofa; half of them are cabinets."""
    return OBJECTS[int(rng.choice(len(OBJECTS), p=_FREQUENCIES))](rng)


def bare_floor(thing: SyntheticMesh, rng: np.random.Generator, half: float = 8.0) -> Room:
    """Return an object in the middle of an empty floor; the floor loses up to 20 % of samples."""
    outline = np.array([(-half, -half), (half, -half), (half, half), (-half, half)])
    floor = mesh_of(np.c_[outline, np.zeros(4)], [(0, 1, 2), (0, 2, 3)])
    mesh = join([floor.with_loss(float(rng.uniform(0.0, 0.2))), thing])
    return Room(mesh, outline, Ceiling(4.0, np.zeros(2)))


def _circled_object(rng: np.random.Generator, index: int, queries: int) -> FramePlan:  # noqa: ARG001
    thing = symmetric_object(rng).mesh
    dull = thing.with_loss(float(rng.choice((0.0, rng.uniform(0.02, 0.2)))))
    room = bare_floor(dull, rng)
    reach = float(np.linalg.norm(thing.vertices[:, :2], axis=1).max())
    radius = max(float(rng.uniform(1.2, 2.2)), reach + 0.55)
    top = min(float(thing.vertices[:, 2].max()), 1.2)
    poses = orbit((0.0, 0.0, 0.45 * top), radius, int(rng.integers(60, 117)), rng)
    return _every_fourth(room, poses, queries, rng)


def _every_fourth(
    room: Room, poses: Sequence[Floats], queries: int, rng: np.random.Generator
) -> FramePlan:
    """Return a plan with every fourth pose in the map, and `queries` of the others as queries."""
    others = [k for k in range(len(poses)) if k % 4]
    chosen = sorted(rng.choice(others, min(queries, len(others)), replace=False).tolist())
    return FramePlan([(room, T) for T in poses[::4]], [(room, poses[k]) for k in chosen])


# Rooms with the same furniture in almost the same places.
#
# rng, Likeness  --equal_offices | equal_bays-->  rooms


@dataclass(frozen=True, eq=False)
class PlacedPiece:
    """A piece at a place; a `loose` piece is at a different place in each copy of a room."""

    piece: Piece
    place: PiecePose
    loose: bool = False


@dataclass(frozen=True)
class Likeness:
    """Parameters of the differences between the copies of a room.

    Parameters
    ----------
    shift, turn : standard deviations of position and yaw of pieces, metres and radians
    loose_shift : standard deviation of the position of loose pieces, metres
    same_load : probability that a piece carries the same objects as in other copies
    missing : probability that a piece is missing
    """

    shift: float = 0.0
    turn: float = 0.0
    loose_shift: float = 0.2
    same_load: float = 0.6
    missing: float = 0.0


_OFFICE: tuple[Maker, ...] = (desk, desk, shelf, cupboard)
_KITCHEN: tuple[Maker, ...] = (kitchen_row, fridge, cupboard)
_BAY: tuple[Maker, ...] = (rack, cupboard, rack)


def arrange(
    walls: Sequence[Wall], floor: Floor, pieces: Sequence[Piece], middle: Piece | None,
    rng: np.random.Generator,
) -> list[PlacedPiece]:  # fmt: skip
    """Return pieces placed along walls, `middle` in the centre, and chairs and boxes anywhere.

    The walls are those of a counter-clockwise rectangle. Pieces that do not fit are omitted.
    """
    placed: list[PlacedPiece] = []
    ends = [0.15] * len(walls)
    for k, piece in enumerate(pieces):
        which = (k // 2) % len(walls)
        wall = walls[which]
        u = ends[which] + piece.width / 2
        x, y = wall.at(u, piece.depth / 2 + 0.03)
        place = PiecePose(float(x), float(y), wall_yaw(wall))
        if u + piece.width / 2 < wall.length and floor.claim(place, piece.width, piece.depth):
            placed.append(PlacedPiece(piece, place))
            ends[which] = u + piece.width / 2 + float(rng.uniform(0.03, 0.6))
            if piece.seats == 1:
                placed += _loose(swivel_chair(rng), wall.at(u, piece.depth + 0.4), place.yaw, floor)
    centre = floor.points[floor.inside].mean(axis=0)
    if middle is not None:
        place = PiecePose(float(centre[0]), float(centre[1]), 0.0)
        if floor.claim(place, middle.width, middle.depth):
            placed.append(PlacedPiece(middle, place))
            for side in (-1, 1):
                at = centre + np.array((0.0, side * (middle.depth / 2 + 0.25)))
                placed += _loose(chair(rng), at, math.pi * (side < 0), floor)
    for _ in range(int(rng.integers(1, 4))):
        spots = floor.points[~floor.claimed]
        at = spots[int(rng.integers(0, len(spots)))]
        placed += _loose(floor_thing(rng), at, float(rng.uniform(0, 6)), floor)
    return placed


def _loose(piece: Piece, at: Floats, yaw: float, floor: Floor) -> list[PlacedPiece]:
    place = PiecePose(float(at[0]), float(at[1]), yaw)
    if not floor.claim(place, piece.width, piece.depth, 0.3):
        return []
    return [PlacedPiece(piece, place, loose=True)]


def furnish(
    placed: Sequence[PlacedPiece], seed: int, likeness: Likeness, rng: np.random.Generator
) -> SyntheticMesh:
    """Return the pieces of a copy, slightly displaced and with objects on them.

    Parameters
    ----------
    placed : arrangement that all copies share
    seed : seed of the objects that the copies share
    likeness : differences between copies
    rng : generator of this copy
    """
    parts = []
    for number, item in enumerate(placed):
        if likeness.missing and rng.random() < likeness.missing:
            continue
        shift = likeness.loose_shift if item.loose else likeness.shift
        turn = 2 * likeness.loose_shift if item.loose else likeness.turn
        dx, dy = rng.normal(0, 1, 2) * shift
        own = rng if rng.random() > likeness.same_load else np.random.default_rng((seed, number))
        loads = [scatter(surface, own) for surface in item.piece.surfaces]
        mesh = join([item.piece.mesh, *loads])
        yaw = item.place.yaw + rng.normal() * turn
        parts.append(mesh.moved((item.place.x + dx, item.place.y + dy, 0.0), yaw))
    return join(parts)


def rectangle(width: float, depth: float) -> Floats:
    """Return the corners (4, 2) of a room, from the origin, counter-clockwise, metres."""
    return np.array([(0, 0), (width, 0), (width, depth), (0, depth)], float)


def _shell(outline: Floats, rng: np.random.Generator, height: float) -> tuple[SyntheticMesh, ...]:
    """Return the shell of a room, the objects on its ceiling, and the fittings of its walls."""
    top = Ceiling(height, np.zeros(2))
    walls = [with_openings(wall, rng, 0.3) for wall in walls_of(outline)]
    fitted = [fittings(wall, top, rng) for wall in walls]
    return (shell(outline, walls, top), overhead(outline, top, rng), *fitted)


def equal_offices(count: int, likeness: Likeness, rng: np.random.Generator) -> list[Room]:
    """Return rooms with the same plan and furniture, apart from the differences of `likeness`."""
    outline, height = rectangle(*rng.uniform((3.2, 3.6), (4.8, 5.2))), float(rng.uniform(2.4, 3.0))
    built = _shell(outline, rng, height)
    makers = [_OFFICE[k] for k in rng.permutation(len(_OFFICE))]
    pieces = [make(rng) for make in (*makers, *makers[: int(rng.integers(0, 3))])]
    placed = arrange(walls_of(outline), Floor(outline), pieces, None, rng)
    seed, top = int(rng.integers(2**31)), Ceiling(height, np.zeros(2))
    return [
        Room(join([*built, furnish(placed, seed, likeness, rng)]), outline, top)
        for _ in range(count)
    ]


def equal_bays(count: int, likeness: Likeness, rng: np.random.Generator) -> tuple[Room, float]:
    """Return a hall of equal bays along +x, and the width of a bay, metres."""
    pitch, wide, height = rng.uniform((3.0, 4.0, 2.8), (4.5, 6.5, 4.0)).tolist()
    bay, outline = rectangle(pitch, wide), rectangle(pitch * count, wide)
    pieces = [make(rng) for make in _BAY]
    walls = [walls_of(bay)[k] for k in (0, 2)]  # bays have no walls between them
    placed = arrange(walls, Floor(bay), pieces, table(rng), rng)
    size, seed = float(rng.uniform(0.2, 0.45)), int(rng.integers(2**31))
    top = Ceiling(height, np.zeros(2))
    parts = [shell(outline, walls_of(outline), top)]
    for k in range(count):
        parts.append(furnish(placed, seed, likeness, rng).moved((k * pitch, 0.0, 0.0)))
        parts += [box(size, size, height, (k * pitch, y, 0)) for y in (size / 2, wide - size / 2)]
    return Room(join(parts), outline, top), pitch


def _row(rng: np.random.Generator, index: int, queries: int) -> FramePlan:
    """Return a plan that maps and queries all rooms of a row or, for odd indexes, all bays."""
    likeness = Likeness(float(rng.uniform(0.0, 0.03)), float(rng.uniform(0.0, 0.02)))
    if index % 2:
        hall, _ = equal_bays(int(rng.integers(4, 7)), likeness, rng)
        poses = scattered_poses(hall, 48 + queries, rng)
        return FramePlan([(hall, T) for T in poses[:48]], [(hall, T) for T in poses[48:]])
    rooms = equal_offices(int(rng.integers(2, 4)), likeness, rng)
    map_of = [(room, T) for room in rooms for T in scattered_poses(room, 18, rng)]
    targets = [rooms[k % len(rooms)] for k in range(queries)]
    return FramePlan(map_of, [(r, scattered_poses(r, 1, rng)[0]) for r in targets], _offsets(rooms))


def _offsets(rooms: Sequence[Room]) -> Callable[[Room], Floats]:
    """Return a function that gives the offset (3,) of each room; rooms are 0.2 m apart."""

    def shift(room: Room) -> Floats:
        k = next(i for i, other in enumerate(rooms) if other is room)
        return np.array([k * (room.size[0] + 0.2), 0.0, 0.0])

    return shift


#: Two views are distinct if at least this share of pixels is within the range REACH_M and differs
#: by more than DISTINCT_M, metres.
DISTINCT_SHARE, DISTINCT_M, REACH_M = 0.10, 0.10, 3.5
_COARSE = Intrinsics(64, 48, 58.5, 58.5, 31.5, 23.5)


def difference_share(
    a: Room, b: Room, T_room_camera: Floats, T_other: Floats | None = None
) -> float:
    """Return the share of a view of room `a` that differs from a view of room `b`.

    The view of `b` has the pose `T_other`, by default the same pose.
    """
    here = render(a, T_room_camera, _COARSE)
    there = render(b, T_room_camera if T_other is None else T_other, _COARSE)
    nearer = np.minimum(here, there)
    # The noise of a depth camera grows with the square of the depth, up to its range.
    least = DISTINCT_M * np.maximum(1.0, nearer**2 / 5.0)
    return float(np.mean((np.abs(here - there) > least) & (nearer < REACH_M)))


def _unmapped_room(rng: np.random.Generator, index: int, queries: int) -> FramePlan:  # noqa: ARG001
    """Return a plan whose map has all rooms of a row except the last, which is queried.

    Queries differ from views of the mapped rooms by DISTINCT_SHARE, because no method can tell an
    equal room from a mapped room in which a chair was moved.
    """
    likeness = Likeness(float(rng.uniform(0.02, 0.08)), float(rng.uniform(0.0, 0.04)), 0.3, 0.5)
    rooms = equal_offices(int(rng.integers(2, 4)), likeness, rng)
    *mapped, last = rooms
    map_of = [(room, T) for room in mapped for T in scattered_poses(room, 20, rng)]
    query_poses: list[Floats] = []
    least = DISTINCT_SHARE
    while len(query_poses) < queries:
        for T in scattered_poses(last, queries, rng):
            difference = min(difference_share(last, room, T) for room in mapped)
            if difference >= least and len(query_poses) < queries:
                query_poses.append(T)
        least *= 0.9  # lower the limit, so that the loop ends
    return FramePlan(map_of, [(last, T) for T in query_poses], _offsets(rooms))


def _second_kitchen(rng: np.random.Generator, index: int, queries: int) -> FramePlan:  # noqa: ARG001
    """Return a plan that maps a kitchen and queries a larger one with furniture in equal order."""
    pieces = [make(rng) for make in _KITCHEN]
    pieces += [pieces[2], kitchen_row(rng)][: int(rng.integers(1, 3))]
    middle = table(rng) if rng.random() < 0.7 else counter(rng)
    small = rng.uniform((3.4, 3.2), (4.4, 4.2))
    likeness = Likeness(float(rng.uniform(0.03, 0.1)), float(rng.uniform(0.01, 0.05)), 0.3, 0.0)
    placed = arrange(walls_of(rectangle(*small)), Floor(rectangle(*small)), pieces, middle, rng)
    rooms = []
    for k in range(2):  # the second kitchen is larger, so its far walls are at other places
        outline, height = rectangle(*(small + k * rng.uniform(0.3, 1.5, 2))), rng.uniform(2.4, 3.0)
        mesh = join([*_shell(outline, rng, float(height)), furnish(placed, 0, likeness, rng)])
        rooms.append(Room(mesh, outline, Ceiling(float(height), np.zeros(2))))
    first, second = rooms
    query_views = [(second, T) for T in scattered_poses(second, queries, rng)]
    return FramePlan([(first, T) for T in scattered_poses(first, 24, rng)], query_views)


def _opposite_sides(rng: np.random.Generator, index: int, queries: int) -> FramePlan:  # noqa: ARG001
    """Return a plan that maps one of two equal pieces, back to back, and queries the other."""
    make = (desk, shelf, counter, table, cupboard)[int(rng.integers(0, 5))]
    piece = make(rng)
    w, d = piece.width, piece.depth
    halves = []
    for turn in (0.0, math.pi):
        loads = [scatter(replace(s, density=0.4 * s.density), rng) for s in piece.surfaces]
        half = join([piece.mesh, *loads]).moved((0.0, -d / 2 - 0.01, 0.0))
        seats = [swivel_chair(rng).mesh.moved((rng.normal(0, 0.1), -d - 0.35, 0), math.pi)]
        things = [  # objects on the floor of one side only
            floor_thing(rng).mesh.moved(
                (rng.uniform(-w / 2, w / 2), -d - rng.uniform(0.2, 0.45), 0.0)
            )
            for _ in range(int(rng.integers(1, 4)))
        ]
        halves.append(join([half, *(seats if piece.seats == 1 else []), *things]).moved(yaw=turn))
    size = rng.uniform((6.6, 6.6), (9.5, 9.5))
    outline = rectangle(*size) - size / 2 + rng.normal(0, 0.4, 2).clip(-0.6, 0.6)
    height = float(rng.uniform(2.5, 3.5))
    mesh = join([*_shell(outline, rng, height), *halves])
    room = Room(mesh, outline, Ceiling(height, np.zeros(2)))
    radius = float(rng.uniform(1.5, 2.0)) if w < 1.6 else float(rng.uniform(1.8, 2.2))
    middle = (0.0, 0.0, 0.5 * min(float(piece.mesh.vertices[:, 2].max()), 1.2))
    sweep = math.radians(140)
    mapped = orbit(middle, radius, 20, rng, first=-math.pi / 2 - sweep / 2, sweep=sweep)
    # Use only views in which the two sides differ, because other views have no correct answer.
    views = orbit(middle, radius, 6 * queries, rng, first=math.pi / 2 - sweep / 2, sweep=sweep)
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    differences = [difference_share(room, room, T, half_turn @ T) for T in views]
    fair = [i for i, share in enumerate(differences) if DISTINCT_SHARE <= share <= 0.5]
    if len(fair) < queries:
        fair = sorted(range(len(views)), key=lambda i: -differences[i])[:queries]
    query_poses = [views[i] for i in sorted(rng.permutation(fair)[:queries].tolist())]
    return FramePlan([(room, T) for T in mapped], [(room, T) for T in query_poses])


def _absent_places(rng: np.random.Generator, index: int, queries: int) -> FramePlan:  # noqa: ARG001
    """Return a plan whose map and queries show different rooms and objects."""

    def views(rooms: int, per_room: int, around: int) -> list[tuple[Room, Floats]]:
        poses = []
        for _ in range(rooms):
            room = make_room(rng)
            poses += [(room, T) for T in scattered_poses(room, per_room, rng)]
        if around:
            circled = _circled_object(rng, 0, around)
            poses += list(circled.map if around > len(circled.queries) else circled.queries)
        return poses

    alone = max(1, queries // 4)
    rooms = max(3, queries // 12)
    per_room = -(-(queries - alone) // rooms)
    return FramePlan(views(4, 10, 20), views(rooms, per_room, alone)[-queries:])


def _ordinary_rooms(rng: np.random.Generator, index: int, queries: int) -> FramePlan:  # noqa: ARG001
    """Return a plan with 8 to 25 views of three adjacent rooms in the map, and queries of them.

    The queries show objects that were elsewhere or absent when the map was recorded.
    """
    rooms = [make_room(rng) for _ in range(3)]
    most = int(rng.integers(0, 5))
    before = [with_things(room, int(rng.integers(0, most + 1)), rng) for room in rooms]
    after = [with_things(room, int(rng.integers(0, most + 1)), rng) for room in rooms]
    per_room = int(rng.integers(8, 26))
    map_of = [(room, T) for room in before for T in scattered_poses(room, per_room, rng)]
    targets = [after[k % len(after)] for k in range(queries)]
    starts = np.cumsum([0.0, *(room.size[0] + 0.2 for room in rooms)])

    def shift(room: Room) -> Floats:
        k = next(i for i in range(len(rooms)) if room is before[i] or room is after[i])
        return np.array([starts[k], 0.0, 0.0])

    return FramePlan(map_of, [(r, scattered_poses(r, 1, rng)[0]) for r in targets], shift)


def with_things(room: Room, count: int, rng: np.random.Generator) -> Room:
    """Return a room with `count` additional chairs, boxes and similar objects on its floor."""
    low, high = room.outline.min(axis=0), room.outline.max(axis=0)
    things = []
    for _ in range(count):
        make = (chair, swivel_chair, floor_thing)[int(rng.integers(0, 3))]
        at = rng.uniform(low + 0.4, high - 0.4)
        things.append(make(rng).mesh.moved((at[0], at[1], 0.0), float(rng.uniform(0.0, 6.3))))
    return replace(room, mesh=join([room.mesh, *things]))


_SHOOTS: dict[str, Callable[[np.random.Generator, int, int], FramePlan]] = {
    "object": _circled_object,
    "offices": _row,
    "unmapped": _unmapped_room,
    "kitchens": _second_kitchen,
    "opposite": _opposite_sides,
    "absent": _absent_places,
    "rooms": _ordinary_rooms,
}
