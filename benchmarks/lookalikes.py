"""Pairs of frames that look alike and are not: `python -m benchmarks.lookalikes [DATA_ROOT]`.

A lone cube in an empty hall, seen from two of its sides, and a corridor with a door every two
metres, seen from two places a door or two apart: two frames cannot tell these, and an answer is
right only if it says so. Beside them, where recordings are given: frames of different rooms, and
frames of one room that overlap by half, which must stay accepted.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from tqdm import tqdm

from benchmarks.pairs import pairs_among
from sceneprint.datasets import FrameReference, find_sequences
from sceneprint.geometry.rigid import difference, inverse
from sceneprint.models import Model, read_model
from sceneprint.pipeline import geometry_of, validate
from sceneprint.signing import see
from sceneprint.synth import KINECT, Room, corridor, symmetric_box, take
from sceneprint.types import Floats, Frame, Geometry

#: A transform this near the truth is right: then the pair was told apart after all.
RIGHT_M = 0.2


def looking(eye: Floats, at: Floats) -> Floats:
    """T_room_camera (4, 4) of an upright camera at `eye` that looks at `at`."""
    z = (at - eye) / np.linalg.norm(at - eye)
    x = np.cross(z, (0.0, 0.0, 1.0))
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    pose[:3, 3] = eye
    return pose


def _taken(room: Room, pose: Floats, rng: np.random.Generator) -> Frame:
    return Frame(take(room, pose, KINECT, rng), KINECT, pose=pose)


def box_pairs(n: int, seed: int) -> Iterator[tuple[Frame, Frame]]:
    """A cube from two of its sides: azimuths a multiple of 90 degrees apart, give or take 7."""
    rng, room = np.random.default_rng((seed, 0)), symmetric_box()
    for _ in range(n):
        azimuth, distance, height = rng.uniform((0, 1.2, 0.8), (2 * np.pi, 2.5, 1.6))
        side = int(rng.integers(1, 4)) * np.pi / 2
        frames = []
        for turn in (0.0, side):
            a, d, h = np.array([azimuth + turn, distance, height]) + (turn > 0) * rng.uniform(
                (-0.12, -0.15, -0.1), (0.12, 0.15, 0.1)
            )
            eye = np.array([d * np.cos(a), d * np.sin(a), h])
            middle = rng.normal(0, 0.05, 3) + np.array([0, 0, 0.3])
            frames.append(_taken(room, looking(eye, middle), rng))
        yield frames[0], frames[1]


def corridor_pairs(n: int, seed: int) -> Iterator[tuple[Frame, Frame]]:
    """A corridor from two places one or two doors apart, in any direction of view."""
    rng, room = np.random.default_rng((seed, 1)), corridor(12, 2.0)
    for _ in range(n):
        eye = rng.uniform((6, 0.6, 1.0), (14, 1.2, 1.6))
        yaw = rng.uniform(0, 2 * np.pi)
        doors = float(rng.choice([-1, 1]) * rng.integers(1, 3) * 2.0)
        frames = []
        for shift in (0.0, doors):
            at = eye + (shift, 0, 0) + (shift != 0) * rng.uniform(-0.1, 0.1, 3)
            turned = yaw + (shift != 0) * rng.uniform(-0.1, 0.1)
            ahead = np.array([np.cos(turned), np.sin(turned), -0.15])
            frames.append(_taken(room, looking(at, at + ahead), rng))
        yield frames[0], frames[1]


def other_rooms(
    sequences: list[list[FrameReference]], n: int, seed: int, model: Model
) -> Counter[str]:
    """Outcomes of `n` pairs of frames drawn from two different recordings."""
    rng = np.random.default_rng(seed)
    known: dict[tuple[int, int], Geometry] = {}

    def drawn(which: int) -> Geometry:
        index = int(rng.integers(len(sequences[which]) // 10 or 1)) * 10 % len(sequences[which])
        if (which, index) not in known:
            known[which, index] = geometry(sequences[which][index].read_depth(), model)
        return known[which, index]

    outcomes: Counter[str] = Counter()
    for i in tqdm(range(n), desc="other rooms", unit="pair", disable=None):
        a, b = rng.choice(len(sequences), 2, replace=False).tolist()
        outcomes[outcome(drawn(a), drawn(b), None, i)] += 1
    return outcomes


def overlapping(recording: list[FrameReference], n: int, seed: int) -> list[tuple[Frame, Frame]]:
    """`n` pairs of every 20th frame of a recording that overlap by half, the smaller direction."""
    frames = [reference.read_depth() for reference in recording[::20]]
    found = [(p.query, p.match) for p in pairs_among(frames) if p.overlap >= 0.5]
    return [found[i] for i in np.random.default_rng(seed).permutation(len(found))[:n]]


def geometry(frame: Frame, model: Model) -> Geometry:
    """The geometry artifact of a frame."""
    return geometry_of(see(frame, model.parameters), model)


def outcome(query: Geometry, match: Geometry, truth: Floats | None, seed: int) -> str:
    """`status` of a pair, with strength, and `right` or `wrong` where it was accepted."""
    v = validate(query, match, seed)
    if v.status != "accepted" or v.T_match_query is None:
        return v.status
    right = truth is not None and difference(v.T_match_query, truth)[0] < RIGHT_M
    return f"accepted {v.strength}, {'right' if right else 'wrong'}"


def outcomes_of(
    pairs: Iterator[tuple[Frame, Frame]], n: int, name: str, model: Model
) -> Counter[str]:
    """Outcomes of pairs with known poses."""
    counted: Counter[str] = Counter()
    for i, (a, b) in enumerate(tqdm(pairs, total=n, desc=name, unit="pair", disable=None)):
        assert a.pose is not None
        assert b.pose is not None
        truth = inverse(b.pose) @ a.pose
        counted[outcome(geometry(a, model), geometry(b, model), truth, i)] += 1
    return counted


def not_believed(counted: Counter[str]) -> float:
    """Share of pairs that were not accepted with a wrong transform."""
    wrong = sum(n for what, n in counted.items() if what.endswith("wrong"))
    return 1.0 - wrong / counted.total()


def main() -> int:
    """Print a line for each kind of pair."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path, nargs="?", help="folder of recordings")
    parser.add_argument("--pairs", type=int, default=100)
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--model", default="depth")
    options = parser.parse_args()
    n, seed, model = options.pairs, options.seed, read_model(options.model)
    kinds = {
        "lone box": outcomes_of(box_pairs(n, seed), n, "lone box", model),
        "corridor": outcomes_of(corridor_pairs(n, seed), n, "corridor", model),
    }
    if options.data is not None:
        scenes = [
            options.data / s for s in ("7scenes/redkitchen", "tum/fr1_rpy", "sun3d/studyroom2")
        ]
        references = [[f for s in find_sequences(scene) for f in s.frames] for scene in scenes]
        kinds["other rooms"] = other_rooms(references, 5 * n, seed, model)
        alike = overlapping(references[0], n, seed)
        kinds["overlap of half"] = outcomes_of(iter(alike), len(alike), "overlap of half", model)
    for name, counted in kinds.items():
        shares = ", ".join(f"{what} {count}" for what, count in sorted(counted.items()))
        believed = f"not wrongly accepted {not_believed(counted):.3f}"
        print(f"{name}: {counted.total()} pairs: {shares}; {believed}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
