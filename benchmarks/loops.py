"""`python -m benchmarks.loops`: loop closures and joins of real sequences, against their poses.

Everything goes the way of a robot: frames are uploaded to an embedded client with poses that drift,
or with an origin of their own, associated, and the edges and the join compared with the poses of
the recording, which nobody was shown. docs/associations.md has the figures.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path

import numpy as np
from tqdm import tqdm

from benchmarks.__main__ import recordings
from sceneprint.client import Client
from sceneprint.client.frames import sendable
from sceneprint.datasets import FrameReference, find_sequences
from sceneprint.evaluation.overlap import AnyView, overlap, view_of
from sceneprint.geometry.rigid import difference, inverse, nearest_rotation, rotation_angle
from sceneprint.schemas.associations import Association, Edge
from sceneprint.types import Floats

#: An edge is right within these; at low overlap, within twice the metres.
RIGHT_M, RIGHT_RAD, LOW_OVERLAP = 0.1, math.radians(10.0), 0.3
#: Frames of the recordings between closures.
APART = 100
#: Odometry's error: a share of each step and turn, a part of it always the same way.
DRIFT = 0.03


@dataclass(frozen=True, eq=False)
class Recording:
    """Frames of a sequence with their true poses."""

    name: str
    step: int
    references: Sequence[FrameReference]
    poses: Floats


@dataclass(frozen=True)
class Judged:
    """Edges held against the truth."""

    edges: int
    strict: float  #: share within RIGHT_M and RIGHT_RAD
    right: float  #: share that also counts twice the metres at low overlap
    gross: int  #: off by more than 30 cm or 15 degrees
    median_m: float
    median_rad: float
    frames: int  #: that have an edge

    def row(self, *names: str) -> str:
        """A row of the table."""
        return "| " + " | ".join(
            [*names, str(self.edges), str(self.frames), f"{self.strict:.4f}", f"{self.right:.4f}",
             str(self.gross), f"{100 * self.median_m:.1f} cm, {math.degrees(self.median_rad):.1f}°"]
        ) + " |"  # fmt: skip


def recording(root: Path, place: str, step: int) -> Recording:
    """Every `step`-th frame that has a pose."""
    found = [one for sequence in find_sequences(root / place) for one in sequence.frames][::step]
    posed = [(one, one.pose) for one in found]
    kept = [(one, pose) for one, pose in posed if pose is not None]
    return Recording(place, step, [one for one, _ in kept], np.array([pose for _, pose in kept]))


def drifting(poses: Floats, seed: int) -> Floats:
    """The poses as odometry would have them."""
    rng = np.random.default_rng(seed)
    always, found = rng.normal(0, 1, 6), [np.eye(4)]
    for a, b in pairwise(poses):
        step = inverse(a) @ b
        metres, radians = float(np.linalg.norm(step[:3, 3])), rotation_angle(step[:3, :3])
        error = DRIFT * (always + rng.normal(0, 1, 6)) / math.sqrt(2)
        x, y, z = error[3:] * (0.3 * radians + math.radians(20.0) * metres)
        noise = np.eye(4)
        noise[:3, :3] = nearest_rotation(np.array([[1, -z, y], [z, 1, -x], [-y, x, 1]]))
        noise[:3, 3] = error[:3] * metres
        found.append(found[-1] @ step @ noise)
    return np.array(found)


def unrelated(seed: int) -> Floats:
    """An origin that has nothing to do with another, some metres away."""
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = nearest_rotation(rng.normal(0, 1, (3, 3))), rng.normal(0, 5, 3)
    return T


def upload(
    client: Client, map_name: str, of: Recording, poses: Floats, sessions: Sequence[str]
) -> dict[str, int]:
    """Send the frames; their places by id."""
    begin, ids = datetime(2026, 1, 1, tzinfo=UTC), {}
    for i, reference in enumerate(of.references):
        data, meta = sendable(reference, None, with_pose=True)
        told = meta.model_dump(mode="json", exclude={"pose"}, exclude_none=True)
        told["session"], told["robot"] = sessions[i], "bench"
        told["captured_at"] = (begin + timedelta(seconds=i * of.step / 30)).isoformat()
        told["pose"] = {"matrix": poses[i].tolist()}
        ids[client.upload(map_name, data, type(meta).model_validate(told)).frame_id] = i
    jobs = [client.frame(map_name, frame_id).job_id for frame_id in ids]
    with tqdm(total=len(jobs), desc=f"sign {map_name}", disable=None) as bar:

        def progress(done: int, _: int) -> None:
            bar.update(done - bar.n)

        client.wait(jobs, timeout_s=7200, progress=progress)
    return ids


class Truth:
    """What the recording's poses say of edges."""

    def __init__(self, of: Recording, ids: dict[str, int]) -> None:
        self._of, self._ids = of, ids
        self._views: dict[int, AnyView] = {}

    def judge(self, edges: Sequence[Edge]) -> Judged:
        """Hold edges against it."""
        if not edges:
            return Judged(0, math.nan, math.nan, 0, math.nan, math.nan, 0)
        off = np.array([self._error(edge) for edge in edges])
        least = np.array([self._overlap(edge) for edge in edges])
        turned = off[:, 1] <= RIGHT_RAD
        strict = turned & (off[:, 0] <= RIGHT_M)
        right = strict | (turned & (off[:, 0] <= 2 * RIGHT_M) & (least < LOW_OVERLAP))
        gross = (off[:, 0] > 0.3) | (off[:, 1] > math.radians(15.0))
        frames = len({edge.from_frame for edge in edges})
        metres, radians = np.median(off, axis=0).tolist()
        return Judged(len(edges), strict.mean(), right.mean(), int(gross.sum()), metres, radians,
                      frames)  # fmt: skip

    def _error(self, edge: Edge) -> tuple[float, float]:
        here, there = self._ids[edge.from_frame], self._ids[edge.to_frame]
        truth = inverse(self._of.poses[there]) @ self._of.poses[here]
        return difference(truth, np.array(edge.transform.matrix))

    def _overlap(self, edge: Edge) -> float:
        both = [self._view(self._ids[one]) for one in (edge.from_frame, edge.to_frame)]
        return overlap(*both)[1]

    def _view(self, i: int) -> AnyView:
        if i not in self._views:
            self._views[i] = view_of(self._of.references[i].read_depth())
        return self._views[i]


def edges_table(client: Client, told: Association, truth: Truth, *names: str) -> list[str]:
    """All edges, those that were not outvoted, and those that loops confirm."""
    every = list(client.edges(told.map, told.association_id))
    kinds = {
        "all": every,
        "not outvoted": [edge for edge in every if edge.consistent is not False],
        "confirmed": [edge for edge in every if edge.consistent],
    }
    return [truth.judge(edges).row(*names, kind) for kind, edges in kinds.items()]


def loops(client: Client, of: Recording, model: str, mode: str, k: int) -> list[str]:
    """Loop closures of a sequence with itself."""
    name = f"loops-{model}-{len(of.references)}"
    ids = _filled(client, name, of, model, drifting(of.poses, 1), ["run"] * len(of.references))
    begin = time.perf_counter()
    told = client.associate(name, "run", apart=APART // of.step, k=k, validation={"mode": mode},
                            timeout_s=7200)  # fmt: skip
    print(f"{name}: {told.state} in {time.perf_counter() - begin:.0f} s, {told.result}")
    return edges_table(client, told, Truth(of, ids), of.name, model, mode, str(k))


def halves(client: Client, of: Recording, model: str, seed: int) -> tuple[list[str], str]:
    """The second half of a sequence joined to the first, each with an origin of its own."""
    half, name = len(of.references) // 2, f"halves-{model}-{len(of.references)}-{seed}"
    origins = unrelated(10 + seed), unrelated(20 + seed)
    poses = np.concatenate([origins[0] @ of.poses[:half], origins[1] @ of.poses[half:]])
    sessions = ["first"] * half + ["second"] * (len(of.references) - half)
    ids = _filled(client, name, of, model, poses, sessions)
    told = client.associate(name, "second", "first", timeout_s=7200)
    rows = edges_table(client, told, Truth(of, ids), of.name, model, "halves", "3")
    assert told.result is not None
    if not told.result.joins or told.result.joins[0].transform is None:
        return rows, f"| {of.name} | {model} | not joined: {told.result.joins} |"
    one = told.result.joins[0]
    assert one.transform is not None
    T, true = np.array(one.transform.matrix), origins[0] @ inverse(origins[1])
    places = poses[half:, :3, 3]
    off = np.linalg.norm((places @ (T - true)[:3, :3].T) + (T - true)[:3, 3], axis=1)
    turn = math.degrees(difference(T, true)[1])
    return rows, (
        f"| {of.name} | {model} | {100 * off.mean():.1f} cm | {100 * off.max():.1f} cm | "
        f"{turn:.2f}° | {one.support} of {one.votes} | {100 * (one.spread_m or 0):.1f} cm, "
        f"{one.spread_deg:.1f}° | {one.strength} |"
    )


def _filled(
    client: Client, name: str, of: Recording, model: str, poses: Floats, sessions: Sequence[str]
) -> dict[str, int]:
    client.create_map(name, model=model)
    found = {frame.frame_id: i for i, frame in enumerate(client.frames(name))}
    return found or upload(client, name, of, poses, sessions)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", default="depth")
    parser.add_argument("--step", type=int, default=2, help="of the 1000 frames of redkitchen")
    parser.add_argument("--data", type=Path, help="folder to keep; default: one that is removed")
    options = parser.parse_args()
    root = recordings()
    kitchen = recording(root, "7scenes/redkitchen", options.step)
    with tempfile.TemporaryDirectory() as made, Client.embedded(options.data or made) as client:
        rows, joins = [], []
        for mode, k in (("full", 3), ("full", 5), ("paper", 3)):
            rows += loops(client, kitchen, options.model, mode, k)
        found, joined = halves(client, kitchen, options.model, 0)
        rows, joins = rows + found, [joined]
        study = recording(root, "sun3d/studyroom2", 1)
        found, joined = halves(client, study, options.model, 0)
        rows, joins = rows + found, [*joins, joined]
    print(
        "| recording | model | mode | k | edges | | frames | within 10 cm, 10° | and 20 cm at "
        "low overlap | gross | median |\n|---|---|---|--:|---|--:|--:|--:|--:|--:|---|"
    )
    print("\n".join(rows))
    print("| recording | model | mean at the frames | most | turn | support | spread | |\n"
          "|---|---|--:|--:|--:|---|---|---|")  # fmt: skip
    print("\n".join(joins))


if __name__ == "__main__":
    main()
