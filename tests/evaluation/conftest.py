"""Fixtures of the evaluation tests: rooms, and outcomes with known figures."""

import json
import math

import numpy as np
import pytest

from sceneprint.cli import main
from sceneprint.geometry.validation.validation import PairValidation
from sceneprint.models import save_model
from sceneprint_lab.evaluation.protocol import Error, QueryOutcome, ValidatedPair


@pytest.fixture(scope="session")
def building(once):
    """Two read-only rooms with twelve views each along a path."""

    def make(folder):
        of = ("--rooms", "2", "--views", "12", "--seed", "9", "--path", "--jobs", "1")
        assert main(["synth", str(folder), *of]) == 0

    return once("evaluated", make)


@pytest.fixture(scope="session")
def model_file(small_model, tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "small.safetensors"
    save_model(small_model, path)
    return path


@pytest.fixture(scope="session")
def figures_of():
    """A function that runs a command and returns the figures that it wrote to a folder."""

    def run(folder, command, *arguments):
        path = folder / "figures.json"
        assert main([command, *map(str, arguments), "--jobs", "1", "--json", str(path)]) == 0
        return json.loads(path.read_text(), parse_constant=pytest.fail)

    return run


def error(cm, degrees=0.0):
    return Error(cm / 100, math.radians(degrees))


def pair(
    match, status="accepted", strength="strong", off=None, *, scene="here", mean=0.5, least=0.4,
    bound=None,
):  # fmt: skip
    strength = strength if status == "accepted" else None
    v = PairValidation(
        status, strength, "as given", np.eye(4), 0.01, 0.01, 0.5, 0.4, 0.0, 100, 0.5, None, 0
    )
    same = scene == "here"
    off = off if same and off is not None else Error()
    return ValidatedPair(match, scene, v, same, off, bound, mean, least, 10.0)


def outcome(ranking, selection, pairs, *, least=None, present=True, **rest):
    """Return an outcome for a query at the origin of "here", with a database like `least`."""
    overlap = np.array(least if least is not None else [0.4] * (max(ranking) + 1))
    return QueryOutcome(
        name="here/query",
        scene="here",
        pose=np.eye(4),
        allowed=np.arange(len(overlap)),
        present=present,
        overlap_mean=overlap,
        overlap_least=overlap,
        ranking=ranking,
        distances=np.arange(len(ranking)),
        selection=selection,
        pairs={pair.match: pair for pair in pairs},
        candidates=3,
        milliseconds={"rank": 1.0, "diversify": 1.0, "average": 1.0},
        **rest,
    )


@pytest.fixture
def three():
    """A successful query, a failed one, and one whose scene is not in the database.

    First query: rank 1 is weak and off by 7 cm, rank 2 strong and off by 2 cm, rank 3 strong and
    off by 4 cm and 6 degrees; C has ranks 1 and 3. Second: rank 1 is of another scene,
    rank 2 weak and off by 15 cm, rank 3 ambiguous but correct; C has ranks 1 and 3.
    Third: a weak, wrong match.
    """
    results = outcome(
        [0, 1, 2],
        [0, 2],
        [
            pair(0, strength="weak", off=error(7, 1), mean=0.6),
            pair(1, off=error(2, 1), mean=0.4, least=0.2),
            pair(2, off=error(4, 6), mean=0.2, bound=error(3, 1)),
        ],
        least=[0.6, 0.4, 0.2, 0.0],
        average=error(1, 1),
        average_of_ranking=error(6, 1),
        average_bound=error(2, 1),
    )
    lost = outcome(
        [3, 1, 2],
        [3, 2],
        [
            pair(3, "rejected", scene="there", mean=0.0, least=0.0),
            pair(1, strength="weak", off=error(15), mean=0.3),
            pair(2, "ambiguous", off=error(1), mean=0.5),
        ],
        least=[0.1, 0.3, 0.5, 0.0],
        average_of_ranking=error(15),
    )
    away = outcome(
        [3],
        [3],
        [pair(3, strength="weak", scene="there", mean=0.0, least=0.0)],
        least=[0.0] * 4,
        present=False,
    )
    return [results, lost, away]
