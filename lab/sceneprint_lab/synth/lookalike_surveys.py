"""Laser scans of ambiguous sites: repetitive, symmetric or similar halls and streets.

kind, seed, index  --synthesise_lookalike_survey-->  LookalikeSite: scans of a map, and queries

bays      map: scans along a hall of equal bays; queries: other scans from its aisle
streets   map: scans along a street of equal blocks; queries: other scans from its carriageway
halls     map: a walk in a hall with a symmetry of 180 degrees, except for one to three details;
          queries: other scans (in half of the sites, the map covers one half of the hall and the
          queries the other, with enough details to distinguish the halves)
unmapped  map: all but one of several equal halls or, in half of the sites, of two equal streets;
          queries: scans of the omitted hall or street
absent    map: an ordinary hall and ordinary blocks; queries: other halls, storeys and blocks
sites     map: every second to fourth scan of a walk in an ordinary hall, storey or block;
          queries: other scans, every third of them some metres beside the walk

The scanner of sites 2, 5, 8, ... is a `Rosette` with a view of 60 to 80 degrees, of other sites a
`Spinning`. Odd sites have maps with drifting poses: a random walk, 1 to 5 cm and .02 to .1 degrees
per scan. The maps of sites 1, 4, 7, ... lack one stretch of a sixth of their scans, and one in ten
of the other scans.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from sceneprint.geometry.rigid import inverse
from sceneprint.types import Cloud, Floats
from sceneprint_lab.synth.furniture import (
    bush,
    cabin,
    machine,
    person,
    pile,
    pole,
    rack,
    screen,
    tank,
    tree,
    vehicle,
)
from sceneprint_lab.synth.large_scenes import (
    CELL,
    Premises,
    facade,
    hall_wall,
    make_block,
    make_hall,
    make_storey,
    roof,
    symmetric_hall,
)
from sceneprint_lab.synth.lookalikes import (
    APART,
    DISTINCT_SHARE,
    ELSEWHERE,
    Likeness,
    LookalikeSite,
    PlacedPiece,
    furnish,
)
from sceneprint_lab.synth.mesh import (
    Ceiling,
    Opening,
    SyntheticMesh,
    Wall,
    box,
    join,
    mesh_of,
    rotation_x,
    rotation_z,
    shell,
    wall_mesh,
    walls_of,
)
from sceneprint_lab.synth.rooms import Floor, Menu, PiecePose
from sceneprint_lab.synth.sensors import Caster, Rosette, Scanner, own_rosette, own_scanner, scan
from sceneprint_lab.synth.trajectories import scanner_pose, walk

SURVEYED_KINDS = ("bays", "streets", "halls", "unmapped", "absent", "sites")
#: Number of scans of a map, before some are removed.
MAP_SCANS = 30


class Stop(NamedTuple):
    """The location of a scan.

    Parameters
    ----------
    premises : scanned premises
    T : (4, 4) T_premises_sensor
    origin : (3,) origin of the premises in the world, metres
    """

    premises: Premises
    T: Floats
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def pose(self) -> Floats:
        """Return T_world_sensor (4, 4)."""
        T = self.T.copy()
        T[:3, 3] += self.origin
        return T


class SurveyPlan(NamedTuple):
    """The locations of a site's scans; those of the map are in the order of a walk."""

    map: list[Stop]
    queries: list[Stop]


def synthesise_lookalike_survey(
    kind: str, seed: int, index: int, *, queries: int = 12, perfect: bool = False
) -> LookalikeSite[Cloud]:
    """Generate an ambiguous site, and return its map and queries, which are scans.

    The result depends only on the arguments. If the poses of the map drift, the pose of a query
    drifts like that of the nearest scan of the map.

    Parameters
    ----------
    kind : one of SURVEYED_KINDS
    seed, index : seed of the collection, and index of the site among those of its kind
    queries : number of queries
    perfect : whether to disable errors and losses of the scanner, and drift

    Raises
    ------
    MissingDependency : If Embree cannot be imported
    ValueError : If the kind does not exist
    """
    if kind not in SURVEYED_KINDS:
        kinds = ", ".join(SURVEYED_KINDS)
        raise ValueError(f"There is no kind {kind!r} of look-alike surveys. Choose from {kinds}.")
    own = SURVEYED_KINDS.index(kind)
    rng = np.random.default_rng(np.random.SeedSequence((seed, index, 32 + own)))
    sensor: Scanner = own_rosette(rng) if index % 3 == 2 else own_scanner(rng)
    planned = _PLANS[kind](rng, index, queries, sensor)
    of_map = _thinned(planned.map, rng) if index % 3 == 1 else planned.map
    true = np.stack([stop.pose for stop in of_map])
    recorded = with_drift(true, rng) if index % 2 and not perfect else true
    query_poses = [stop.pose for stop in planned.queries]
    if kind not in APART:
        query_poses = [_drifted_pose(T, true, recorded) for T in query_poses]
    if perfect:
        sensor = sensor.perfect()
    name = f"{kind}-{index:03d}"

    def clouds(part: str, stops: Sequence[Stop], poses: Sequence[Floats]) -> tuple[Cloud, ...]:
        return tuple(
            Cloud(
                scan(stop.premises.caster, stop.T, sensor, rng),
                name=f"{name}/{part}/scan-{number:06d}",
                pose=T,
            )
            for number, (stop, T) in enumerate(zip(stops, poses, strict=True))
        )

    return LookalikeSite(
        name, kind, seed, index, clouds("map", of_map, list(recorded)),
        clouds("queries", planned.queries, query_poses), kind not in ELSEWHERE,
    )  # fmt: skip


def _thinned(stops: list[Stop], rng: np.random.Generator) -> list[Stop]:
    """Return the stops without one stretch of a sixth of them, and one in ten of the others."""
    gap = len(stops) // 6
    start = int(rng.integers(1, len(stops) - gap))
    return [
        stop
        for k, stop in enumerate(stops)
        if not start <= k < start + gap and (k == 0 or rng.random() > 0.1)
    ]


def with_drift(poses: Floats, rng: np.random.Generator) -> Floats:
    """Return the poses (n, 4, 4) of a walk with a drift like that of odometry.

    The first pose is exact. Each step has a random error, whose standard deviation, 1 to 5 cm and
    .02 to .1 degrees, is constant during the walk.
    """
    metres, radians = rng.uniform(0.01, 0.05), math.radians(rng.uniform(0.02, 0.1))
    drifted = [poses[0]]
    for before, after in pairwise(poses):
        error = np.eye(4)
        about = rng.normal(0, radians, 2)
        error[:3, :3] = rotation_z(float(about[0])) @ rotation_x(float(about[1]))
        error[:3, 3] = rng.normal(0, metres, 3)
        drifted.append(drifted[-1] @ inverse(before) @ after @ error)
    return np.stack(drifted)


def _drifted_pose(T: Floats, true: Floats, recorded: Floats) -> Floats:
    """Return the pose `T` with the drift of the nearest scan, from `true` to `recorded`."""
    nearest = int(np.linalg.norm(true[:, :3, 3] - T[:3, 3], axis=1).argmin())
    placed: Floats = recorded[nearest] @ inverse(true[nearest]) @ T
    return placed


def distinct_fraction(here: Stop, other: Premises, T: Floats, sensor: Scanner) -> float:
    """Return the share of a scan's ranges that differ from those of a scan in another place.

    About a thousand rays within 40 m are compared; ranges differ if they are 30 cm + 2 % apart.

    Parameters
    ----------
    here : location of the scan
    other, T : the other place, and the pose (4, 4) of its scan
    sensor : scanner
    """
    rays = sensor.rays(np.random.default_rng(0))
    rays = rays[:: max(1, len(rays) // 1000)]

    def ranges(caster: Caster, pose: Floats) -> Floats:
        turned = rays @ pose[:3, :3].T.astype(np.float32)
        origins = np.broadcast_to(pose[:3, 3].astype(np.float32), turned.shape)
        return np.minimum(caster.cast(origins, turned).distance, 40.0).astype(np.float64)

    a, b = ranges(here.premises.caster, here.T), ranges(other.caster, T)
    return float(np.mean(np.abs(a - b) > 0.3 + 0.02 * np.minimum(a, b)))


def _most_different(
    stops: Sequence[Stop], rivals: Callable[[Stop], list[tuple[Premises, Floats]]], n: int,
    sensor: Scanner,
) -> tuple[list[Stop], float]:  # fmt: skip
    """Return n stops that differ from all rivals by DISTINCT_SHARE, or those that differ most.

    Returns
    -------
    stops : n stops
    least : smallest share by which one of them differs from a rival
    """
    shares = [
        min(distinct_fraction(stop, *rival, sensor) for rival in rivals(stop)) for stop in stops
    ]
    fair = [k for k, share in enumerate(shares) if share >= DISTINCT_SHARE]
    if len(fair) < n:
        fair = sorted(range(len(stops)), key=lambda k: -shares[k])
    return [stops[k] for k in sorted(fair[:n])], min(shares[k] for k in fair[:n])


# Repeated units: a bay of a hall, a block of a street.
#
# rng  --bay, block-->  Unit        Unit, count, Likeness, rng  --row_of-->  Premises

#: Objects in the bays of a store, a factory and a car park, with weights.
_BAYS: tuple[Menu, ...] = (
    {rack: 4, pile: 3, screen: 1, cabin: 1},
    {machine: 4, tank: 2, rack: 1, pile: 1, screen: 1},
    {vehicle: 6, pole: 1, person: 1},
)
#: Objects in front of the houses of a street, with weights.
_FRONTS: Menu = {vehicle: 4, tree: 3, pole: 2, bush: 2, screen: 1}
#: Objects that people or the wind move.
_LOOSE = (vehicle, pile, person)


@dataclass(frozen=True, eq=False)
class Unit:
    """A unit that is repeated along +x, with a clear path along y = 0.

    Parameters
    ----------
    kind : "hall" or "block", as in Premises
    pitch : length of a copy along x, metres
    half_way : half the width of the path, metres
    built : surfaces that all copies share; x is from 0 to `pitch`
    things : objects that each copy has, with differences
    around : function that returns the floor and the outer walls for a number of copies
    """

    kind: str
    pitch: float
    half_way: float
    built: SyntheticMesh
    things: list[PlacedPiece]
    around: Callable[[int], SyntheticMesh]


def bay(rng: np.random.Generator) -> Unit:
    """Return a random bay of a hall with pillars, a girder and racks, machines or cars."""
    pitch, half_way, side = rng.uniform((4.5, 1.5, 4.0), (10.0, 3.5, 12.0)).tolist()
    half, size = half_way + side, float(rng.uniform(0.25, 0.8))
    top = Ceiling(float(rng.uniform(3.0, 9.0)), np.zeros(2))
    deep = float(rng.uniform(0.2, 0.7))
    parts = [box(0.4, 2 * half, deep, (0.0, 0.0, top.height - deep))]
    divided = rng.random() < 0.5
    across = float(rng.uniform(0.3, 1.0)) * side if divided else 0.0
    for s in (-1, 1):
        parts.append(box(size, size, top.height, (0.0, s * (half_way + size / 2), 0.0)))
        if divided:
            parts.append(box(0.2, across, top.height, (0.0, s * (half - across / 2), 0.0)))
    menu = _BAYS[int(rng.integers(0, len(_BAYS)))]
    sides = [_strip(0.2, pitch - 0.2, s, half_way + size, half - 0.1) for s in (-1, 1)]
    things = [
        piece for outline in sides for piece in stand_about(menu, Floor(outline, CELL), rng, 12)
    ]
    # Openings of the four outer walls, in the order of `walls_of`; those of the long walls repeat.
    with_openings = [
        hall_wall(Wall(np.zeros(2), np.array([1.0, 0.0]), length), top, rng).openings
        for length in (pitch, 2 * half, pitch, 2 * half)
    ]

    def around(count: int) -> SyntheticMesh:
        outline = _rectangle(0.0, count * pitch, -half, half)
        walls = []
        for k, (wall, openings) in enumerate(zip(walls_of(outline), with_openings, strict=True)):
            copies = range(1 if k % 2 else count)
            walls.append(replace(wall, openings=_repeated(openings, pitch, copies)))
        return shell(outline, walls, top)

    return Unit("hall", pitch, half_way, join(parts), things, around)


def block(rng: np.random.Generator) -> Unit:
    """Return houses on both sides of a street, with objects in front of them."""
    pitch, half_way, front, deep = rng.uniform((9.0, 2.5, 2.5, 8.0), (20.0, 5.0, 6.0, 14.0))
    gap = 0.0 if rng.random() < 0.5 else float(rng.uniform(1.5, 5.0))
    half, parts, things = half_way + front + deep, [], []
    for s in (-1, 1):
        house = _house(pitch - gap, deep, rng).moved(yaw=math.pi * (s < 0))
        parts.append(house.moved((pitch / 2, s * (half - deep / 2), 0.0)))
        if rng.random() < 0.4:
            long, high = float(rng.uniform(0.3, 0.8)) * pitch, float(rng.uniform(0.5, 1.6))
            parts.append(box(long, 0.25, high, (long / 2, s * (half_way + front - 1.5), 0.0)))
        strip = Floor(_strip(0.2, pitch - 0.2, s, half_way, half_way + front - 0.2), CELL)
        things += stand_about(_FRONTS, strip, rng, 8)
    last = _house(2 * half, deep, rng).moved(yaw=math.pi / 2) if rng.random() < 0.5 else None

    def around(count: int) -> SyntheticMesh:
        outline = _rectangle(-60.0, count * pitch + 60.0, -half - 40.0, half + 40.0)
        ground = mesh_of(np.c_[outline, np.zeros(4)], [(0, 1, 2), (0, 2, 3)])
        if last is None:
            return ground
        return join([ground, last.moved((count * pitch + deep / 2 + 6.0, 0.0, 0.0))])

    return Unit("block", float(pitch), float(half_way), join(parts), things, around)


def _house(w: float, d: float, rng: np.random.Generator) -> SyntheticMesh:
    """Return a house around the origin; its front, with steps or porches, faces -y."""
    h, rise, deep = rng.uniform((4.0, 2.7, 0.1), (14.0, 3.8, 0.4)).tolist()
    corners = np.array([(-w, -d), (-w, d), (w, d), (w, -d)]) / 2  # clockwise, so walls face outward
    top = Ceiling(h, np.zeros(2))
    walls = [wall_mesh(facade(wall, h, rise, deep, rng), top) for wall in walls_of(corners)]
    parts = [*walls, roof(w, d, h, rng)]
    for _ in range(int(rng.integers(1, 4))):
        a, b, c = rng.uniform((0.8, 0.4, 0.3), (3.0, 1.4, 3.0))
        parts.append(box(a, b, c, (rng.uniform(-0.5, 0.5) * (w - a), -(d + b) / 2, 0.0)))
    return join(parts)


def stand_about(
    menu: Menu, floor: Floor, rng: np.random.Generator, tries: int
) -> list[PlacedPiece]:
    """Return pieces at free places, nearly aligned with the axes, after at most `tries` tries."""
    makers, weights = list(menu), np.array(list(menu.values()), float)
    placed = []
    for _ in range(tries):
        spots = floor.points[~floor.claimed]
        if not len(spots):
            break
        maker = makers[int(rng.choice(len(makers), p=weights / weights.sum()))]
        piece = maker(rng)
        x, y = spots[int(rng.integers(0, len(spots)))].tolist()
        yaw = int(rng.integers(0, 4)) * math.pi / 2 + float(rng.normal(0, 0.04))
        place = PiecePose(x, y, yaw)
        if floor.claim(place, piece.width, piece.depth):
            placed.append(PlacedPiece(piece, place, loose=maker in _LOOSE))
    return placed


def row_of(unit: Unit, count: int, likeness: Likeness, rng: np.random.Generator) -> Premises:
    """Return `count` copies of a unit along +x from the origin; their path is walkable floor."""
    parts = [unit.around(count)]
    for k in range(count):
        things = furnish(unit.things, 0, likeness, rng)
        parts.append(join([unit.built, things]).moved((k * unit.pitch, 0.0, 0.0)))
    way = _rectangle(0.5, count * unit.pitch - 0.5, -unit.half_way, unit.half_way)
    return Premises(unit.kind, join(parts), Floor(way, CELL))


def _repeated(openings: Sequence[Opening], pitch: float, copies: range) -> tuple[Opening, ...]:
    """Return the openings of all copies, shifted by multiples of the pitch."""
    return tuple(
        replace(o, start=o.start + k * pitch, end=o.end + k * pitch)
        for k in copies
        for o in openings
    )


def _rectangle(x0: float, x1: float, y0: float, y1: float) -> Floats:
    return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], float)


def _strip(x0: float, x1: float, side: int, near: float, far: float) -> Floats:
    """Return a rectangle (4, 2) on one side of the x axis, from `near` to `far` off the axis."""
    return _rectangle(x0, x1, *sorted((side * near, side * far)))


# Locations of the scans.
#
# rng, index, queries, Scanner  --_PLANS[kind]-->  SurveyPlan


def _likeness(rng: np.random.Generator) -> Likeness:
    """Return random parameters of differences: shifts of centimetres, and missing objects."""
    shift, missing = rng.uniform((0.0, 0.0), (0.1, 0.2)).tolist()
    return Likeness(shift, 0.02, float(rng.uniform(0.1, 0.6)), missing=missing)


class _Carrier:
    """Generates poses of a scanner along a row, with constant height and mounting."""

    def __init__(self, unit: Unit, count: int, sensor: Scanner, rng: np.random.Generator) -> None:
        self.length, self.rng = unit.pitch * count, rng
        self.reach = unit.half_way - 0.5  # distance from the centre line of the path
        self.height = float(rng.uniform(0.5, 1.9))
        self.sees_back = not isinstance(sensor, Rosette)
        # A scanner that sees all around may have any heading; a Rosette looks ahead.
        self.mounted = float(
            rng.uniform(-math.pi, math.pi) if self.sees_back else rng.normal(0, 0.3)
        )

    def along(self, n: int) -> list[Floats]:
        """Return n poses from end to end along a slightly winding path."""
        x = np.linspace(1.5, self.length - 1.5, n)
        phase, waves = self.rng.uniform(0, 2 * math.pi), self.rng.uniform(0.5, 3.0)
        y = 0.5 * self.reach * np.sin(phase + 2 * math.pi * waves * x / self.length)
        yaw = self.mounted + self.rng.normal(0, 0.05, n)
        return [
            scanner_pose(at_x, at_y, self.height, turn, self.rng)
            for at_x, at_y, turn in np.column_stack([x, y, yaw]).tolist()
        ]

    def anywhere(self, n: int) -> list[Floats]:
        """Return n poses anywhere on the path; some scanners that see all around face backwards."""
        rng = self.rng
        x = rng.uniform(1.5, self.length - 1.5, n)
        y = rng.uniform(-self.reach, self.reach, n)
        yaw = self.mounted + rng.normal(0, 0.12, n)
        if self.sees_back:
            yaw = yaw + math.pi * (rng.random(n) < 0.3)
        z = self.height + rng.normal(0, 0.1, n)
        return [
            scanner_pose(at_x, at_y, at_z, turn, rng)
            for at_x, at_y, at_z, turn in np.column_stack([x, y, z, yaw]).tolist()
        ]


def _row(
    make: Callable[[np.random.Generator], Unit], counts: tuple[int, int], rng: np.random.Generator,
    queries: int, sensor: Scanner,
) -> SurveyPlan:  # fmt: skip
    unit, count = make(rng), int(rng.integers(*counts))
    row = row_of(unit, count, _likeness(rng), rng)
    carrier = _Carrier(unit, count, sensor, rng)
    stops = [Stop(row, T) for T in carrier.along(MAP_SCANS)]
    return SurveyPlan(stops, [Stop(row, T) for T in carrier.anywhere(queries)])


def _bays(rng: np.random.Generator, index: int, queries: int, sensor: Scanner) -> SurveyPlan:  # noqa: ARG001
    return _row(bay, (5, 13), rng, queries, sensor)


def _streets(rng: np.random.Generator, index: int, queries: int, sensor: Scanner) -> SurveyPlan:  # noqa: ARG001
    return _row(block, (5, 9), rng, queries, sensor)


def _is_second_variant(index: int) -> bool:
    """Return whether a site has the second variant of its kind."""
    return index % 4 in (1, 2)


def _unmapped(rng: np.random.Generator, index: int, queries: int, sensor: Scanner) -> SurveyPlan:
    """Return a plan that maps all but the last of several similar rows, and queries the last.

    Queries are selected from three times as many stops; see `_most_different`.
    """
    street = _is_second_variant(index)
    unit = block(rng) if street else bay(rng)
    rows, count = (2, int(rng.integers(4, 7))) if street else (3, int(rng.integers(2, 4)))
    likeness = replace(_likeness(rng), missing=float(rng.uniform(0.15, 0.5)))
    *mapped, last = (row_of(unit, count, likeness, rng) for _ in range(rows))
    carrier = _Carrier(unit, count, sensor, rng)
    origins = [(0.0, 120.0 * k, 0.0) for k in range(rows)]
    per_row = MAP_SCANS // len(mapped)
    stops = [
        Stop(row, T, origin)
        for row, origin in zip(mapped, origins, strict=False)
        for T in carrier.along(per_row)
    ]

    def rivals(stop: Stop) -> list[tuple[Premises, Floats]]:
        similar = []
        for k in range(1 - count, count):
            T = stop.T.copy()
            T[0, 3] += k * unit.pitch
            if 0.0 < T[0, 3] < carrier.length:
                similar += [(row, T) for row in mapped]
        return similar

    query_stops = [Stop(last, T, origins[-1]) for T in carrier.anywhere(3 * queries)]
    return SurveyPlan(stops, _most_different(query_stops, rivals, queries, sensor)[0])


def _halls(rng: np.random.Generator, index: int, queries: int, sensor: Scanner) -> SurveyPlan:
    """Return a plan that maps a hall with some details, or one half of a hall with more details."""
    hall = _with_details(symmetric_hall(rng), rng)
    if not _is_second_variant(index):
        return _plan_walk(hall, rng, queries)
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])

    def in_half(poses: list[Floats], side: int) -> list[Stop]:
        return [Stop(hall, T if T[0, 3] * side > 0 else half_turn @ T) for T in poses]

    def rivals(stop: Stop) -> list[tuple[Premises, Floats]]:
        return [(hall, half_turn @ stop.T)]

    for _ in range(10):
        query_stops, least = _most_different(
            in_half(walk(hall, 3 * queries, rng), -1), rivals, queries, sensor
        )
        if least >= DISTINCT_SHARE:
            break
        hall = _with_details(hall, rng)
    return SurveyPlan(in_half(walk(hall, MAP_SCANS, rng), 1), query_stops)


def _with_details(hall: Premises, rng: np.random.Generator) -> Premises:
    """Return a hall with up to three more objects, whose places are claimed in both halves."""
    menu: Menu = {pile: 2, person: 1, cabin: 2, screen: 2, tank: 1, machine: 1}
    things = furnish(stand_about(menu, hall.floor, rng, 3), 0, Likeness(), rng)
    # A walkable place must also be walkable after half a turn.
    hall.floor.claimed[:] |= hall.floor.claimed[::-1, ::-1]
    return Premises("hall", join([hall.mesh, things]), hall.floor)


def _plan_walk(premises: Premises, rng: np.random.Generator, queries: int) -> SurveyPlan:
    """Return a plan that maps every second to fourth scan of a walk, and queries other scans."""
    step = int(rng.integers(2, 5))
    poses = walk(premises, step * MAP_SCANS, rng)
    others = [k for k in range(len(poses)) if k % step]
    chosen = sorted(rng.choice(others, queries, replace=queries > len(others)).tolist())
    query_stops = []
    for number, k in enumerate(chosen):
        beside = _pose_beside(premises, poses[k], rng) if number % 3 == 2 else poses[k]
        query_stops.append(Stop(premises, beside))
    return SurveyPlan([Stop(premises, T) for T in poses[::step]], query_stops)


def _pose_beside(premises: Premises, T: Floats, rng: np.random.Generator) -> Floats:
    """Return a walkable pose 1 to 4 m from another pose, rotated by up to about 20 degrees."""
    spots = premises.floor.points[premises.walkable]
    away = np.linalg.norm(spots - T[:2, 3], axis=1)
    spots = spots[(away > 1.0) & (away < 4.0)]
    moved = T.copy()
    if len(spots):
        moved[:2, 3] = spots[int(rng.integers(0, len(spots)))]
    moved[:3, :3] = rotation_z(float(rng.normal(0, 0.17))) @ T[:3, :3]
    return moved


def _sites(rng: np.random.Generator, index: int, queries: int, sensor: Scanner) -> SurveyPlan:  # noqa: ARG001
    makers = (make_hall, make_block, make_block, make_hall, make_storey)
    return _plan_walk(makers[index % len(makers)](rng), rng, queries)


def _absent(rng: np.random.Generator, index: int, queries: int, sensor: Scanner) -> SurveyPlan:  # noqa: ARG001
    """Return a plan that maps a hall and a block, 200 m apart, and queries other sites."""
    places = [(make(rng), (200.0 * k, 0.0, 0.0)) for k, make in enumerate((make_hall, make_block))]
    of_map = [
        Stop(premises, T, origin)
        for premises, origin in places
        for T in walk(premises, MAP_SCANS // 2, rng, 3.0)
    ]
    makers = (make_hall, make_block, make_storey)
    others = [makers[int(rng.integers(0, 3))](rng) for _ in range(max(2, queries // 8))]
    per_site = -(-queries // len(others))
    query_stops = [Stop(site, T) for site in others for T in walk(site, per_site, rng, 4.0)]
    return SurveyPlan(of_map, query_stops[:queries])


_PLANS: dict[str, Callable[[np.random.Generator, int, int, Scanner], SurveyPlan]] = {
    "bays": _bays,
    "streets": _streets,
    "halls": _halls,
    "unmapped": _unmapped,
    "absent": _absent,
    "sites": _sites,
}
