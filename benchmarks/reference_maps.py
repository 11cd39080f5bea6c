"""Real frames located on a map that is one surface: `python -m benchmarks.reference_maps hall`.

surface  --choose_views, Renderer-->  views, signed  <--  real frames, each answered

`hall`: scans 0-99 joined into one cloud, scans 100-174 located in it. `redkitchen`: frames 0-599
fused to one mesh, frames 650-999 located in it. `rooms` and `halls`: synthetic meshes, to choose
numbers on. With --frames the map is the real frames themselves, for comparison. Times of a first
run hold the compilation of kernels.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sceneprint.errors import UselessFrame
from sceneprint.formats.dataset import find_sequences
from sceneprint.geometry.views import ViewParameters, view_parameters
from sceneprint.lab.evaluation.protocol import JudgedAnswer
from sceneprint.lab.evaluation.sites import answers_of, signed
from sceneprint.lab.evaluation.surface_maps import join_frames, render_views
from sceneprint.lab.synth.dataset import (
    premises_and_rng,
    room_and_rng,
    synthesise_room,
    synthesise_survey,
)
from sceneprint.lab.synth.mesh import SyntheticMesh
from sceneprint.pipeline import Signer, open_signer, prepare
from sceneprint.types import AnyFrame, ReferenceSurface

#: A pose is right within so many metres and degrees.
RIGHT = {"depth": (0.25, 5.0), "lidar": (0.5, 5.0)}
#: Side of the voxels that a mesh is made of, and that a joined cloud is thinned to, metres.
VOXEL_M = {"depth": 0.02, "lidar": 0.1}
#: Frames whose signing is timed.
_TIMED = 20


@dataclass(frozen=True)
class Place:
    """A surface, the frames it was made of, and frames that are to be located in it."""

    preset: str
    surface: ReferenceSurface
    frames: Sequence[AnyFrame]
    queries: Sequence[AnyFrame]


def hall(recordings: Path) -> Place:
    """Return the hall: scans 0-99 as a cloud, thinned to a point a voxel."""
    references = find_sequences(recordings / "lidar" / "hall")[0].frames
    scans = {int(one.path.stem.split("-")[-1]): one.read() for one in references}
    frames = [one for number, one in scans.items() if number < 100]
    surface = join_frames(frames, VOXEL_M["lidar"], np.array([0.0, 0.0, 1.0]))
    return Place("lidar", surface, frames, [one for number, one in scans.items() if number >= 100])


def redkitchen(recordings: Path) -> Place:
    """Return the kitchen: every fifth of frames 0-599 as a mesh."""
    references = find_sequences(recordings / "7scenes" / "redkitchen")[0].frames
    frames = [one.read_depth() for one in references[:600:5]]
    surface = join_frames(frames, VOXEL_M["depth"], np.array([0.0, -1.0, 0.0]))
    return Place("depth", surface, frames, [one.read_depth() for one in references[650:1000:10]])


def rooms(number: int) -> Place:
    """Return a synthetic room."""
    room, _ = room_and_rng(53, number)
    queries = synthesise_room(53, number, 20).frames
    frames = synthesise_room(53, number, 80, along_path=True).frames
    return Place("depth", _surface(room.mesh), frames, queries)


def halls(number: int) -> Place:
    """Return a synthetic hall, storey or block."""
    premises, _ = premises_and_rng(53, number)
    walked = synthesise_survey(53, number, 60, along_path=True).clouds
    queries = synthesise_survey(53, number, 20).clouds
    return Place("lidar", _surface(premises.mesh), walked, queries)


def _surface(mesh: SyntheticMesh) -> ReferenceSurface:
    return ReferenceSurface(
        mesh.vertices.astype(np.float32), mesh.faces, np.zeros(3), np.array([0.0, 0.0, 1.0])
    )


def views(place: Place, p: ViewParameters) -> tuple[list[AnyFrame], str]:
    """Return the views of a surface as frames, and how long choosing and rendering took."""
    began = time.process_time()
    plan, frames = render_views(place.surface, p)
    spent = time.process_time() - began
    floor = "none" if plan.floor is None else f"at {plan.floor:.2f} m"
    return frames, (
        f"{len(plan.poses)} of {plan.candidates} views, {plan.covered:.3f} covered, floor {floor}; "
        f"{spent:.1f} s choosing and rendering"
    )


def answers(
    place: Place, frames: Sequence[AnyFrame], signer: Signer, *, rendered: bool
) -> list[JudgedAnswer]:
    """Answer all queries on a map of some frames; those that show nothing are not found."""
    _, database, of_map = signed(frames, "map", signer, 0)
    _, queries, of_queries = signed(place.queries, "map", signer, len(database))
    found = answers_of(signer, database, queries, [*of_map, *of_queries], rendered=rendered)
    return found + [JudgedAnswer()] * (len(place.queries) - len(queries))


def signing_seconds(frames: Sequence[AnyFrame], signer: Signer) -> float:
    """Return processor seconds to sign one frame, as the mean of some."""
    some = frames[:: max(len(frames) // _TIMED, 1)]
    began = time.process_time()
    for frame in some:
        try:
            prepare(frame, signer)
        except UselessFrame:
            continue
    return (time.process_time() - began) / len(some)


def report(name: str, place: Place, signer: Signer, options: argparse.Namespace) -> Counter[str]:
    """Locate all queries of a place, print what came of it, and return the counts."""
    if options.frames:
        frames, text = list(place.frames), f"{len(place.frames)} real frames"
    else:
        p = view_parameters(signer.model.parameters, heights=options.height)
        if options.spacing:
            p = replace(p, spacing=options.spacing)
        frames, text = views(place, p)
        real, rendered = (signing_seconds(some, signer) for some in (place.frames, frames))
        text += f"; signing {1e3 * rendered:.0f} ms each, a real frame {1e3 * real:.0f} ms"
    counts: Counter[str] = Counter()
    metres = []
    for one in answers(place, frames, signer, rendered=not options.frames):
        right = one.error.within(*RIGHT[place.preset])
        counts[one.status if one.status != "found" else "right" if right else "wrong"] += 1
        if one.status == "found" and right:
            metres.append(one.error.metres)
    print(f"{name}: {len(place.queries)} queries: {dict(counts)}, median {np.median(metres):.3f} m")
    print(f"  {text}", flush=True)
    return counts


def main() -> None:
    """Measure one place, or several synthetic ones."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.reference_maps", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("place", choices=("hall", "redkitchen", "rooms", "halls"))
    parser.add_argument("--recordings", type=Path, default=Path("../shared/data"))
    parser.add_argument("--count", type=int, default=6, help="synthetic places (default: 6)")
    parser.add_argument("--frames", action="store_true", help="the map is the real frames")
    parser.add_argument("--height", type=float, nargs="+", help="of the sensor above the floor")
    parser.add_argument("--spacing", type=float, help="between viewpoints, metres")
    options = parser.parse_args()
    signer = open_signer("lidar" if options.place in ("hall", "halls") else "depth")
    if options.place in ("hall", "redkitchen"):
        make = hall if options.place == "hall" else redkitchen
        report(options.place, make(options.recordings), signer, options)
        return
    total: Counter[str] = Counter()
    for number in range(options.count):
        place = rooms(number) if options.place == "rooms" else halls(number)
        total += report(f"{options.place} {number}", place, signer, options)
    print(f"all: {dict(total)}")


if __name__ == "__main__":
    main()
