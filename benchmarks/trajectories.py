"""Signatures as robots would send them: real recordings, and laps through synthetic rooms.

`python -m benchmarks.trajectories FOLDER` signs them into a folder (resumable); nothing of it
belongs into the repository.

A lap is a robot's round of one room: the path of `sceneprint.synth.trajectory`, of which every
STEP-th pose is taken (18 to 48 cm or 6 to 18 degrees a frame, a robot of half a metre a second
that uploads one or two frames a second). Each lap of a room begins at another phase, drifts
smoothly about the path, and has sensor noise of its own. Laps 0 to 3 are the map; of a fifth lap,
which is in no map, every fifth frame is a query. No model was trained on these rooms.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from sceneprint.datasets import find_sequences
from sceneprint.errors import UselessFrame
from sceneprint.pipeline import Signer, open_signer, sign
from sceneprint.synth import KINECT, take, trajectory
from sceneprint.synth.synthesis import room_and_rng
from sceneprint.types import Bytes, Floats, Frame
from sceneprint.writing import write_whole

#: Collection of the rooms; models are trained on collection 0.
SEED = 7000
#: Rooms; laps of each that are its map; frames of a lap; poses of a path from one to the next.
ROOMS, LAPS, FRAMES, STEP = 45, 4, 50, 6
#: One in so many frames of the lap that is asked, and of a real recording, is a query.
ASKED = 5
#: Frames of a room that are taken a second time, from the same pose, to measure sensor noise.
TWINS = 4
#: Standard deviation of a lap's drift about the path, and poses over which it is smooth.
DRIFT_M, DRIFT_RAD, DRIFT_POSES = 0.08, 0.06, 40
#: Rooms that the large preset signs too.
PAPER_ROOMS = 15

#: What a frame is for.
MAP, QUERY, TWIN = 0, 1, 2


@dataclass(frozen=True, eq=False)
class Signed:
    """Signatures of one place, in the order in which they were taken.

    Parameters
    ----------
    signatures : (n, D) uint8
    roles : (n,) MAP, QUERY or TWIN
    runs : (n,) lap or recording; neighbours of one run are neighbours in time
    origins : (n,) of a twin the row that it was taken again of, else -1
    """

    signatures: Bytes
    roles: NDArray[np.int64]
    runs: NDArray[np.int64]
    origins: NDArray[np.int64]

    def of(self, role: int) -> Bytes:
        """(k, D) the signatures of one role."""
        return self.signatures[self.roles == role]


def laps(index: int, count: int, frames: int) -> Iterator[tuple[int, int, int, Frame]]:
    """Frames of laps through one room, and of a lap that asks.

    Parameters
    ----------
    index : of the room
    count : laps of the map
    frames : of a lap

    Yields
    ------
    role, lap, the frame of the room of which this is a twin or -1, and the frame
    """
    room, rng = room_and_rng(SEED, index)
    path = np.array(trajectory(room, (frames + 1) * STEP, rng))
    poses, taken = [], 0
    for lap in range(count + 1):
        drifted = _drifted(path, rng)[int(rng.integers(STEP)) :: STEP][:frames]
        role = MAP if lap < count else QUERY
        chosen = drifted if role == MAP else drifted[::ASKED]
        for pose in chosen:
            yield role, lap, -1, _taken(room, pose, rng)
            poses.append(pose)
            taken += role == MAP
    for row in np.linspace(0, taken - 1, TWINS).astype(int).tolist():
        yield TWIN, count + 1, row, _taken(room, poses[row], rng)


def _taken(room: object, pose: Floats, rng: np.random.Generator) -> Frame:
    from sceneprint.synth import Room

    assert isinstance(room, Room)
    return Frame(take(room, pose, KINECT, rng), KINECT, pose=pose)


def _drifted(path: Floats, rng: np.random.Generator) -> Floats:
    """The path (n, 4, 4) as another lap follows it: moved and turned a little, smoothly."""
    n = len(path)
    knots = np.linspace(0, n - 1, max(n // DRIFT_POSES, 1) + 1)
    moves = rng.normal(0, 1, (len(knots), 6)) * np.repeat((DRIFT_M, DRIFT_RAD), 3)
    smooth = np.column_stack([np.interp(np.arange(n), knots, column) for column in moves.T])
    return np.array([T @ _small(move) for T, move in zip(path, smooth, strict=True)])


def _small(move: Floats) -> Floats:
    """A pose (4, 4) of a small translation and a small rotation vector."""
    T = np.eye(4)
    T[:3, 3] = move[:3]
    angle = float(np.linalg.norm(move[3:]))
    if angle > 0:
        x, y, z = move[3:] / angle
        K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        T[:3, :3] += np.sin(angle) * K + (1 - np.cos(angle)) * K @ K
    return T


def recorded(root: Path) -> Iterator[tuple[int, int, int, Frame]]:
    """Frames of the real recordings, as of `laps`; every fifth is a query."""
    number = 0
    for run, place in enumerate(("7scenes/redkitchen", "tum/fr1_rpy", "sun3d/studyroom2")):
        for sequence in find_sequences(root / place):
            for reference in sequence.frames:
                yield (QUERY if number % ASKED == 0 else MAP), run, -1, reference.read()
                number += 1


def signed(frames: Iterator[tuple[int, int, int, Frame]], signers: list[Signer]) -> list[Signed]:
    """Sign frames with some models; frames that cannot be signed are left out."""
    rows: list[tuple[int, int, int]] = []
    vectors: list[list[Bytes]] = [[] for _ in signers]
    places: dict[int, int] = {}
    for number, (role, run, origin, frame) in enumerate(frames):
        try:
            own = [sign(frame, signer).vector for signer in signers]
        except UselessFrame:
            continue
        if role == TWIN and origin not in places:
            continue
        places[number] = len(rows)
        rows.append((role, run, places.get(origin, -1)))
        for kept, vector in zip(vectors, own, strict=True):
            kept.append(vector)
    roles, runs, origins = np.array(rows, np.int64).T
    return [Signed(np.stack(kept), roles, runs, origins) for kept in vectors]


def file_of(folder: Path, signer_id: str, place: str) -> Path:
    """Where the signatures of a place by one model are kept."""
    return folder / signer_id[:12] / f"{place}.npz"


def write_signed(path: Path, made: Signed) -> None:
    """Write the signatures of a place."""
    data = BytesIO()
    np.savez(
        data,
        signatures=made.signatures,
        roles=made.roles,
        runs=made.runs,
        origins=made.origins,
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, data.getvalue())


def read_signed(path: Path) -> Signed:
    """Read what `write_signed` wrote."""
    with np.load(path, allow_pickle=False) as data:
        return Signed(data["signatures"], data["roles"], data["runs"], data["origins"])


def make(
    folder: Path, recordings: Path | None, rooms: int = ROOMS, paper_rooms: int = PAPER_ROOMS
) -> None:
    """Sign all that is not in the folder yet: real recordings, then room after room."""
    signers = {name: open_signer(name) for name in ("compact", "paper")}
    places: list[tuple[str, Iterator[tuple[int, int, int, Frame]], list[Signer]]] = []
    if recordings is not None and recordings.is_dir():
        places.append(("real", recorded(recordings), list(signers.values())))
    for index in range(rooms):
        own = list(signers.values()) if index < paper_rooms else [signers["compact"]]
        places.append((f"room-{index:03d}", laps(index, LAPS, FRAMES), own))
    for place, frames, wanted in tqdm(places, unit="place", disable=None):
        paths = [file_of(folder, signer.model.id, place) for signer in wanted]
        if not all(path.is_file() for path in paths):
            for path, made in zip(paths, signed(frames, wanted), strict=True):
                write_signed(path, made)


def main() -> int:
    """Sign into a folder."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--data", type=Path, help="folder of real recordings")
    parser.add_argument("--rooms", type=int, default=ROOMS)
    options = parser.parse_args()
    make(options.folder, options.data, options.rooms)
    return 0


if __name__ == "__main__":
    sys.exit(main())
