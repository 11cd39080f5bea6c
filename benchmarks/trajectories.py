"""Signatures as robots would send them: real recordings, and laps through synthetic rooms.

A lap is a robot's round of one room: the path of `sceneprint.synth.trajectory`, of which every
STEP-th pose is taken (18 to 48 cm or 6 to 18 degrees a frame, a robot of half a metre a second
that uploads one or two frames a second). Each lap of a room begins at another phase, drifts
smoothly about the path, and has sensor noise of its own. Laps 0 to 3 are the map; of a fifth lap,
which is in no map, every fifth frame is a query. No model was trained on these rooms.

Of a real recording, at 30 frames a second, stretches are held out whole and their middles asked:
else the nearest frames of each would be those just before it and just after.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from sceneprint.datasets import find_sequences
from sceneprint.errors import UselessFrame
from sceneprint.models import PRESETS
from sceneprint.pipeline import Signer, open_signer, sign
from sceneprint.synth import KINECT_V1, Room, take, trajectory
from sceneprint.synth.synthesis import room_and_rng
from sceneprint.types import Bytes, Floats, Frame, Intrinsics
from sceneprint.writing import write_whole

#: Collection of the rooms; models are trained on collection 0.
SEED = 7000
#: Rooms; laps of each that are its map; frames of a lap; poses of a path from one to the next.
ROOMS, LAPS, FRAMES, STEP = 46, 4, 50, 6
#: One in so many frames of the lap that is asked is a query.
ASKED = 5
#: Of so many frames of a recording, those before the second number are the map's, and those from
#: the third to the fourth are asked.
STRETCH = (150, 90, 105, 135)
#: Frames of a room that are taken a second time, from the same pose, to measure sensor noise.
TWINS = 4
#: Standard deviation of a lap's drift about the path, and poses over which it is smooth.
DRIFT_M, DRIFT_RAD, DRIFT_POSES = 0.08, 0.06, 40
#: The camera of 7-Scenes at half its pixels each way, and its sensor in these pixels: signing
#: works on a quarter, so that a frame costs half the time, and two takes of a pose by one and by
#: the other differ no more than two by one.
CAMERA = Intrinsics(320, 240, 292.5, 292.5, 159.75, 119.75)
SENSOR = replace(
    KINECT_V1,
    disparity_sigma=KINECT_V1.disparity_sigma / 2,
    correlation=KINECT_V1.correlation / 2,
    warp=KINECT_V1.warp / 2,
    disparity_step=KINECT_V1.disparity_step / 2,
    edge_jitter=KINECT_V1.edge_jitter / 2,
    edge_block=2,
    shadow_margin=KINECT_V1.shadow_margin / 2,
    shadow_growth=2,
    patch=KINECT_V1.patch / 2,
)
#: What a frame is for; ASIDE is near a query in time, and in no map.
MAP, QUERY, TWIN, ASIDE = 0, 1, 2, 3


@dataclass(frozen=True, eq=False)
class Signed:
    """Signatures of one place, in the order in which they were taken.

    Parameters
    ----------
    signatures : (n, D) uint8
    roles : (n,) MAP, QUERY, TWIN or ASIDE
    runs : (n,) lap or recording; neighbours of one run are neighbours in time
    origins : (n,) of a twin the row that it was taken again of, else -1
    """

    signatures: Bytes
    roles: NDArray[np.int64]
    runs: NDArray[np.int64]
    origins: NDArray[np.int64]

    def of(self, role: int) -> Bytes:
        """(k, D) the signatures of one role."""
        chosen: Bytes = self.signatures[self.roles == role]
        return chosen


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


def _taken(room: Room, pose: Floats, rng: np.random.Generator) -> Frame:
    return Frame(take(room, pose, CAMERA, rng, SENSOR), CAMERA, pose=pose)


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
    """Frames of the real recordings, as of `laps`."""
    run = 0
    for place in ("7scenes/redkitchen", "tum/fr1_rpy", "sun3d/studyroom2"):
        for sequence in find_sequences(root / place):
            for number, reference in enumerate(sequence.frames):
                yield role_in_recording(number), run, -1, reference.read_depth()
            run += 1


def role_in_recording(number: int) -> int:
    """What frame `number` of a recording is for."""
    length, known, start, end = STRETCH
    at = number % length
    if at < known:
        return MAP
    return QUERY if start <= at < end else ASIDE


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
    folder: Path, recordings: Path, presets: Sequence[str] = tuple(PRESETS), rooms: int = ROOMS
) -> None:
    """Sign what is not in the folder yet: the recordings, then room by room."""
    signers = [open_signer(name) for name in presets]
    places = {f"room-{i:03d}": laps(i, LAPS, FRAMES) for i in range(rooms)}
    if recordings.is_dir():
        places = {"real": recorded(recordings)} | places
    for place, frames in tqdm(places.items(), unit="place", disable=None):
        paths = {file_of(folder, signer.model.id, place): signer for signer in signers}
        missing = {path: signer for path, signer in paths.items() if not path.is_file()}
        if missing:
            made = signed(frames, list(missing.values()))
            for path, one in zip(missing, made, strict=True):
                write_signed(path, one)
