"""`python -m benchmarks.peers PATH`: our validation beside other registrations, on the same pairs.

pairs of frames by overlap  --each method-->  success, median time

KISS-Matcher, small_gicp and Open3D (FPFH with RANSAC or FGR, then ICP) each in one standard
configuration, not tuned. They always answer and do not say whether to believe it; ours does. What
is not installed is left out: `pip install kiss-matcher small_gicp open3d`. None of them is a
dependency of ours. Times are of one thread, features of both frames counted for all but ours,
whose geometry is stored: that of both frames is a row of its own.
"""

from __future__ import annotations

import argparse
import importlib
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from sceneprint.formats.dataset import find_sequences
from sceneprint.geometry.rigid import difference, inverse
from sceneprint.lab.evaluation.pair_run import (
    BINS,
    inside,
    peer_points,
    refined_by_us,
    register,
    scale_of,
)
from sceneprint.lab.evaluation.protocol import overlap, view_of
from sceneprint.models import Model, read_model
from sceneprint.pipeline import geometry_of, validate
from sceneprint.signing import see
from sceneprint.types import AnyFrame, Floats

#: Points of a query and of a match (N, 3), metres, to T_match_query (4, 4), by name.
Method = Callable[[Floats, Floats], dict[str, Floats]]


def kiss_matcher(module: Any, scale: float) -> Method:
    """Global registration by Faster-PFH and graph pruning, in voxels of 6 cm times the scale."""

    def run(query: Floats, match: Floats) -> dict[str, Floats]:
        found = module.KISSMatcher(0.06 * scale).estimate(
            query.astype(np.float32), match.astype(np.float32)
        )
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = found.rotation, np.ravel(found.translation)
        return {"KISS-Matcher": T}

    return run


def small_gicp(module: Any, scale: float) -> Method:
    """Local registration from the identity: what a tracker would do without a guess."""

    def run(query: Floats, match: Floats) -> dict[str, Floats]:
        found = module.align(
            match, query, registration_type="GICP", downsampling_resolution=0.05 * scale,
            max_correspondence_distance=0.4 * scale, num_threads=1,
        )  # fmt: skip
        return {"small_gicp from identity": np.asarray(found.T_target_source)}

    return run


def open3d_methods(module: Any, scale: float) -> Method:
    """FPFH with RANSAC, and with FGR, each with ICP after it."""

    def run(query: Floats, match: Floats) -> dict[str, Floats]:
        found = register(query, match, module, seed=0, scale=scale)
        return {f"{name} + ICP": one.refined for name, one in found.items()}

    return run


#: Module and what runs it, in the order of the table.
PEERS = {"kiss_matcher": kiss_matcher, "small_gicp": small_gicp, "open3d": open3d_methods}


def installed(scale: float) -> dict[str, Method]:
    """The peers that can be imported; the others are named on the terminal."""
    found = {}
    for name, make in PEERS.items():
        try:
            found[name] = make(importlib.import_module(name), scale)
        except ImportError as error:
            print(f"{name} is left out: {error}")
    return found


def drawn_pairs(
    frames: Sequence[AnyFrame], n: int, apart: int, seed: int
) -> list[tuple[str, int, int]]:
    """At most n pairs of each bin of overlap, `apart` places or more from each other."""
    views = [view_of(frame) for frame in frames]
    later, earlier = np.tril_indices(len(frames), -apart)
    least = np.array([overlap(views[i], views[j])[1] for i, j in zip(later, earlier, strict=True)])
    found = []
    for number, name in enumerate(BINS):
        own = np.flatnonzero(inside(least, name))
        rng = np.random.default_rng((seed, number))
        some = rng.choice(own, min(n, len(own)), replace=False)
        found += [(name, int(later[k]), int(earlier[k])) for k in some]
    return found


def measure(
    frames: Sequence[AnyFrame], pairs: Sequence[tuple[str, int, int]], model: Model,
    peers: dict[str, Method], right: tuple[float, float],
) -> dict[str, dict[str, list[tuple[bool, float]]]]:  # fmt: skip
    """By method and bin: whether each pair is right, and the processor time in milliseconds."""
    told: dict[str, dict[str, list[tuple[bool, float]]]] = {}
    p = model.parameters.validation.alignment
    for name, i, j in tqdm(pairs, unit="pair", disable=None):
        query, match = frames[i], frames[j]
        assert query.pose is not None
        assert match.pose is not None
        true = inverse(match.pose) @ query.pose

        def note(
            method: str, T: Floats | None, spent: float, name: str = name, true: Floats = true
        ) -> None:
            metres, radians = (np.inf, np.inf) if T is None else difference(T, true)
            is_right = metres <= right[0] and radians <= np.radians(right[1])
            told.setdefault(method, {}).setdefault(name, []).append((bool(is_right), spent))

        start = time.process_time()
        ours, its = (geometry_of(see(one, model.parameters), model) for one in (query, match))
        middle = time.process_time()
        found = validate(ours, its)
        spent = 1e3 * (time.process_time() - middle)
        note("ours", found.T_match_query, spent)
        accepted = found.T_match_query if found.status == "accepted" else None
        note("ours, accepted", accepted, spent)
        note("geometry of both, ours", None, 1e3 * (middle - start))
        for method in peers.values():
            start = time.process_time()
            results = method(peer_points(query, model), peer_points(match, model))
            spent = 1e3 * (time.process_time() - start)
            for title, T in results.items():
                note(title, T, spent)
                note(f"{title}, refined by us", refined_by_us(ours, its, T, p), spent)
    return told


def report(told: dict[str, dict[str, list[tuple[bool, float]]]]) -> str:
    """A Markdown table: shares of right transforms by overlap, and the median time."""
    lines = ["| | " + " | ".join(f"{name} %" for name in BINS) + " | ms |", "|---" * 6 + "|"]
    for method, bins in told.items():
        every = [one for found in bins.values() for one in found]
        shares = [
            f"{np.mean([right for right, _ in bins[name]]):.2f}" if name in bins else "-"
            for name in BINS
        ]
        if method.startswith("geometry"):
            shares = [""] * len(BINS)
        lines.append(
            f"| {method} | {' | '.join(shares)} | {np.median([ms for _, ms in every]):.0f} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Read frames, draw pairs, run every method on them, print the table."""
    parser = argparse.ArgumentParser(prog="benchmarks.peers", description=__doc__)
    parser.add_argument("path", type=Path, help="of a sequence with poses")
    parser.add_argument("--preset", default="lidar")
    parser.add_argument("--pairs", type=int, default=25, help="of each bin")
    parser.add_argument("--apart", type=int, default=3, help="least distance in the recording")
    parser.add_argument("--step", type=int, default=1, help="every which frame is read")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--right", type=float, nargs=2, default=(0.3, 3.0), metavar=("M", "DEG"))
    options = parser.parse_args()
    model = read_model(options.preset)
    references = [f for s in find_sequences(options.path) for f in s.frames][:: options.step]
    frames = [frame.read() for frame in references]
    pairs = drawn_pairs(frames, options.pairs, options.apart, options.seed)
    peers = installed(scale_of(model.parameters))
    told = measure(frames, pairs, model, peers, (options.right[0], options.right[1]))
    print(report(told))


if __name__ == "__main__":
    main()
