"""How large the errors of accepted matches are, beside what their covariances say.

    python -m benchmarks.uncertainty --seed 6202 --rooms 60

Prints the figures of docs/uncertainty.md: normalised errors on synthetic rooms, where the truth is
exact. The scale of `CovarianceParameters` was fitted on seed 6101.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2
from tqdm import tqdm

from sceneprint.geometry.averaging import average_poses
from sceneprint.geometry.covariance import (
    error_of,
    free_directions,
    place_covariance,
    transported,
)
from sceneprint.geometry.rigid import inverse
from sceneprint.models import Model, read_model
from sceneprint.pipeline import geometry_of, validate
from sceneprint.signing import see
from sceneprint.synth import KINECT, KINECT_V1, take, trajectory
from sceneprint.synth.synthesis import own_sensor, room_and_rng
from sceneprint.types import Floats, Frame

#: Views of a room along a path, frames of the path from one to the next, and which are compared.
VIEWS, STEP, APART = 8, 14, (1, 2, 3, 5)
#: A match that is off by more is of another place: no error that a covariance speaks of.
WRONG_M, WRONG_RAD = 0.15, np.radians(10.0)


@dataclass(frozen=True, eq=False)
class Vote:
    """An accepted match.

    Parameters
    ----------
    query : of which view of which room
    error : (6,) of its transform
    covariance : (6, 6)
    T_world_query, T_world_match : (4, 4) as they are
    T_match_query : (4, 4) as it was found
    """

    query: tuple[int, int]
    error: Floats
    covariance: Floats
    T_world_query: Floats
    T_world_match: Floats
    T_match_query: Floats


def votes_of(seed: int, index: int, model: Model) -> list[Vote]:
    """Accepted matches within one room."""
    room, rng = room_and_rng(seed, index)
    sensor = own_sensor(KINECT_V1, KINECT, rng)
    poses = trajectory(room, VIEWS * STEP, rng)[::STEP]
    frames = [Frame(take(room, T, KINECT, rng, sensor), KINECT) for T in poses]
    seen = [geometry_of(see(frame, model.parameters), model) for frame in frames]
    found = []
    for i in range(VIEWS):
        for j in ((i + apart) % VIEWS for apart in APART):
            v = validate(seen[i], seen[j])
            if v.T_match_query is None or v.covariance is None:
                continue
            error = error_of(v.T_match_query, inverse(poses[j]) @ poses[i])
            found.append(Vote((index, i), error, v.covariance, poses[i], poses[j], v.T_match_query))
    return found


def near(error: Floats) -> bool:
    """Whether it is an error, and not another place."""
    return bool(np.linalg.norm(error[:3]) < WRONG_M and np.linalg.norm(error[3:]) < WRONG_RAD)


def square(error: Floats, covariance: Floats) -> float:
    """Normalised error squared: on average as large as there are numbers in it."""
    return float(error @ np.linalg.solve(covariance, error))


def places(votes: list[Vote]) -> list[float]:
    """Normalised errors squared of the places that two or more votes agree on."""
    by_query: dict[tuple[int, int], list[Vote]] = defaultdict(list)
    for one in votes:
        by_query[one.query].append(one)
    found = []
    for several in by_query.values():
        poses = np.array([one.T_world_match @ one.T_match_query for one in several])
        own = [transported(one.covariance, one.T_world_match[:3, :3], np.zeros(3))
               for one in several]  # fmt: skip
        average = average_poses(poses)
        error = error_of(average.T, several[0].T_world_query)
        if average.support > 1 and near(error):
            found.append(square(error, place_covariance(average, poses, np.array(own))))
    return found


def line(name: str, squares: list[float], numbers: int = 6) -> str:
    """A row of the table."""
    found = np.array(squares)
    shares = [(found < chi2.ppf(share, numbers)).mean() for share in (0.5, 0.68, 0.95, 0.99)]
    return (
        f"| {name} | {len(found)} | {found.mean() / numbers:.2f} | "
        + " | ".join(f"{share:.0%}" for share in shares)
        + " |"
    )


def main() -> None:
    """Measure, and print."""
    asked = argparse.ArgumentParser(description="Errors beside their covariances.")
    asked.add_argument("--seed", type=int, default=6202)
    asked.add_argument("--rooms", type=int, default=60)
    asked.add_argument("--model", default="depth")
    options = asked.parse_args()
    model = read_model(options.model)
    rooms = tqdm(range(options.rooms), desc="rooms", disable=None)
    every = [one for index in rooms for one in votes_of(options.seed, index, model)]
    votes = [one for one in every if near(one.error)]
    e, S = [one.error for one in votes], [one.covariance for one in votes]
    lines = [
        f"{len(every)} accepted, {len(every) - len(votes)} of another place; "
        f"{np.mean([len(free_directions(one)) > 0 for one in S]):.1%} with a free direction",
        line("pairs", [square(a, b) for a, b in zip(e, S, strict=True)]),
        line("translation", [square(a[:3], b[:3, :3]) for a, b in zip(e, S, strict=True)], 3),
        line("rotation", [square(a[3:], b[3:, 3:]) for a, b in zip(e, S, strict=True)], 3),
        line("places", places(every)),
    ]
    print("\n".join(lines))


if __name__ == "__main__":
    main()
