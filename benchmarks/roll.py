"""How far a roll of the camera moves a signature: `python -m benchmarks.roll`.

The same synthetic scene, without noise, seen by a camera that turns about its optical axis.
Behind a round lens the content stays the same at every angle, and only the sampling of it
changes; a rectangular sensor also gains and loses the corners.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from tqdm import tqdm

from sceneprint.pipeline import Signer, distance, open_signer, sign
from sceneprint.synth import KINECT, Room, render, synthesise_room
from sceneprint.synth.synthesis import room_and_rng
from sceneprint.types import Floats, Floats32, Frame, Intrinsics

#: A square sensor with the pixels of a Kinect, behind a round lens.
SQUARE = Intrinsics(480, 480, 585.0, 585.0, 239.5, 239.5)
#: Seed of rooms that no shipped model was trained on.
SEED = 7
ANGLES = (10, 30, 45, 90, 135, 180, 250)


@dataclass(frozen=True)
class RolledView:
    """One place and direction in a synthetic room."""

    room: Room
    pose: Floats
    _seen: dict[tuple[float, bool], Frame] = field(default_factory=dict, repr=False)

    def seen(self, degrees: float, round_lens: bool) -> Frame:
        """The depth image after a roll about the optical axis, noise-free; rendered once."""
        asked = (degrees, round_lens)
        if asked not in self._seen:
            self._seen[asked] = self._render(degrees, round_lens)
        return self._seen[asked]

    def _render(self, degrees: float, round_lens: bool) -> Frame:
        a = math.radians(degrees)
        roll = np.eye(4)
        roll[:2, :2] = [[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]]
        camera = SQUARE if round_lens else KINECT
        depth: Floats32 = render(self.room, self.pose @ roll, camera)
        if round_lens:
            y, x = np.mgrid[: camera.height, : camera.width]
            inside = (x - camera.cx) ** 2 + (y - camera.cy) ** 2 < 239.0**2
            depth = np.where(inside, depth, np.float32(0))
        return Frame(depth, camera, f"rolled by {degrees:g}")


def view(number: int) -> RolledView:
    """View `number` of rooms kept for this measurement."""
    pose = synthesise_room(SEED, number, 1).frames[0].pose
    assert pose is not None
    return RolledView(room_and_rng(SEED, number)[0], pose)


def shares_of_d0(
    one: RolledView, signer: Signer, round_lens: bool, angles: Iterable[float] = ANGLES
) -> list[float]:
    """Distance to the unrolled view, for each angle, as a share of d0."""
    d0 = signer.model.unrelated_distance
    still = sign(one.seen(0, round_lens), signer)
    return [distance(still, sign(one.seen(a, round_lens), signer)) / d0 for a in angles]


def main() -> int:
    """Print median and largest share for both lenses."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", default="depth", help="preset or model file")
    parser.add_argument("--views", type=int, default=12)
    options = parser.parse_args()
    signer = open_signer(options.model)
    views = [view(i) for i in range(options.views)]
    print(f"model {signer.model.label}; distance / d0 over {options.views} views, by angle")
    for name, round_lens in (("round lens", True), ("rectangle", False)):
        rows = [shares_of_d0(v, signer, round_lens) for v in tqdm(views, desc=name, disable=None)]
        table = np.array(rows)
        for angle, column in zip(ANGLES, table.T, strict=True):
            print(
                f"{name:10} {angle:4d} deg  median {np.median(column):.3f}  max {column.max():.3f}"
            )
        print(
            f"{name:10}   all     median {np.median(table):.3f}  max {table.max():.3f}  "
            f"within d0 / 3: {(table <= 1 / 3).sum()} of {table.size}"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
