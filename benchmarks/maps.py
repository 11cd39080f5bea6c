"""Maps of a wished size, of what `trajectories` signed and `extension` makes of it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.extension import fit_mirror, places, visits
from benchmarks.recall import Case
from benchmarks.trajectories import MAP, QUERY, TWIN, Signed, file_of, read_signed
from sceneprint.geometry.retrieval import distances
from sceneprint.types import Bytes

#: Rooms that are a map of a thousand frames.
ROOMS_TOGETHER = 5
#: One in so many frames of a recording is asked where its neighbours in time stay in the map.
DENSE = 5
#: Queries of one map at most, spread over all: an exact scan of a large one takes long.
MOST_QUERIES = 300


@dataclass(frozen=True, eq=False)
class Library:
    """All that was signed with one model.

    Parameters
    ----------
    recorded : the real recordings, or None
    rooms : the synthetic rooms, in their order
    """

    recorded: Signed | None
    rooms: tuple[Signed, ...]

    @property
    def places(self) -> tuple[Signed, ...]:
        """Real recordings and rooms."""
        return (() if self.recorded is None else (self.recorded,)) + self.rooms


@dataclass(frozen=True, eq=False)
class Joined:
    """A case, and which of its frames follow each other: see `visits`."""

    case: Case
    runs: NDArray[np.int64]


def read_library(folder: Path, model_id: str) -> Library:
    """What a folder holds of a model."""
    real = file_of(folder, model_id, "real")
    rooms = sorted(real.parent.glob("room-*.npz"))
    return Library(
        read_signed(real) if real.is_file() else None, tuple(read_signed(path) for path in rooms)
    )


def join(name: str, members: Sequence[Signed], size: int | None = None) -> Joined:
    """Places put behind each other until there are `size` frames, and their queries."""
    maps, queries, runs, total, following = [], [], [], 0, 0
    for member in members:
        known = member.roles == MAP
        room = known.sum() if size is None else min(known.sum(), size - total)
        if room == 0:
            break
        maps.append(member.signatures[known][:room])
        runs.append(member.runs[known][:room] + following)
        queries.append(member.of(QUERY))
        total, following = total + int(room), following + int(member.runs.max()) + 1
    asked = np.concatenate(queries)
    asked = asked[np.linspace(0, len(asked) - 1, min(len(asked), MOST_QUERIES)).astype(int)]
    return Joined(Case(name, np.concatenate(maps), asked), np.concatenate(runs))


def dense(name: str, recorded: Signed) -> Case:
    """All frames of the recordings but every fifth, which is asked."""
    asked = np.arange(len(recorded.signatures)) % DENSE == 0
    return Case(name, recorded.signatures[~asked], recorded.signatures[asked])


def thousands(name: str, rooms: Sequence[Signed]) -> list[Case]:
    """As many maps of about a thousand frames as the rooms give."""
    starts = range(0, len(rooms) - ROOMS_TOGETHER + 1, ROOMS_TOGETHER)
    return [join(name, rooms[start : start + ROOMS_TOGETHER]).case for start in starts]


def grown(joined: Joined, how: str, total: int, path: Path) -> Case:
    """A map extended to `total` frames by "places" or "visits", kept at `path` as an array.

    Parameters
    ----------
    joined : what was signed
    how : see `extension`
    total : of frames
    path : of the array; taken as it is where it is there and of that shape
    """
    case, length = joined.case, joined.case.signatures.shape[1]
    if not path.is_file():
        if how == "places":
            blocks = places(case.signatures, fit_mirror(case.signatures), total)
        else:
            blocks = visits(case.signatures, joined.runs, total)
        _write(path, blocks, (total, length))
    stored: Bytes = np.load(path, mmap_mode="r")
    if stored.shape != (total, length):
        raise ValueError(f"{path}: {stored.shape}, not {(total, length)}. Remove it.")
    return Case(f"{case.name}, extended by {how}", stored, case.queries)


def _write(path: Path, blocks: Iterable[Bytes], shape: tuple[int, int]) -> None:
    part = path.with_suffix(".part")
    stored = np.lib.format.open_memmap(part, "w+", np.uint8, shape)
    start = 0
    for block in blocks:
        stored[start : start + len(block)] = block
        start += len(block)
    stored.flush()
    part.rename(path)


def noise(members: Iterable[Signed]) -> float:
    """Median distance of two takes from the same pose."""
    found = [
        distances(member.signatures[row], member.signatures[member.origins[row]][None])[0]
        for member in members
        for row in np.flatnonzero(member.roles == TWIN)
    ]
    return float(np.median(found))
