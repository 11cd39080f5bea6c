"""Measure the cost of each part and of references in the same run, and print tables.

`make bench` measures all parts.
`python -m benchmarks --only service --map-frames 10000` measures one part.
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from tqdm import tqdm

from benchmarks import dashboard, encode, readiness, registration, scan, search, service
from benchmarks.machine import measured_on, memory_gib, seconds_to_import, version_of
from benchmarks.pairs import real_pairs, synthetic_pairs
from sceneprint.formats.dataset import FrameReference, find_sequences
from sceneprint.models import PRESETS
from sceneprint.pipeline import open_signer
from sceneprint.types import DepthFrame
from sceneprint_lab.cli.demo import write_building
from sceneprint_lab.synth import synthesise_room

ROOT = Path(__file__).resolve().parent.parent
#: Folder of real recordings. Synthetic rooms replace missing recordings.
RECORDINGS = Path(os.environ.get("SCENEPRINT_DATA", ROOT.parent / "shared" / "data"))


def thin(frames: list[FrameReference], most: int) -> list[FrameReference]:
    """Return at most `most` evenly spaced frames."""
    return frames[:: max(len(frames) // most, 1)][:most]


def frames_to_sign(n: int) -> list[DepthFrame]:
    """Return `n` frames of the recordings, evenly spaced, or of synthetic rooms."""
    scenes = [RECORDINGS / name for name in ("7scenes", "tum", "sun3d")]
    sequences = [run for scene in scenes if scene.is_dir() for run in find_sequences(scene)]
    if sequences:
        every = [frame for sequence in sequences for frame in sequence.frames]
        return [frame.read_depth() for frame in thin(every, n)]
    rooms = tqdm(range((n + 4) // 5), desc="synthetic rooms", disable=None)
    return [frame for i in rooms for frame in synthesise_room(3, i, 5).frames][:n]


@contextmanager
def frames_to_serve(dataset: Path) -> Iterator[list[FrameReference]]:
    """Yield up to 320 frames of a data set or, if it does not exist, of a synthetic building."""
    with TemporaryDirectory(prefix="sceneprint-bench-") as temporary:
        if not dataset.is_dir():
            dataset = Path(temporary) / "building"
            for _ in tqdm(write_building(dataset, 6), "synthetic rooms", 6, disable=None):
                pass
        yield thin([frame for run in find_sequences(dataset) for frame in run.frames], 320)


def parts(options: argparse.Namespace) -> dict[str, Callable[[], list[str]]]:
    """Return a measuring function for each part; those from `signing` on run on one processor."""

    def serve(measure: Callable[[list[FrameReference]], list[str]]) -> list[str]:
        with frames_to_serve(options.dataset) as frames:
            return measure(frames)

    def register() -> list[str]:
        pairs = real_pairs(RECORDINGS, options.pairs) or synthetic_pairs(options.pairs)
        return registration.measure(pairs, open_signer(PRESETS[0]).model)

    def sign() -> list[str]:
        frames = frames_to_sign(options.frames)
        return [line for preset in PRESETS for line in encode.measure(frames, preset)]

    return {
        "dashboard": dashboard.measure,
        "readiness": lambda: serve(lambda some: readiness.measure(some[0], some[1:201])),
        "disk": lambda: serve(lambda some: readiness.measure_disk(some[:40])),
        "service": lambda: serve(lambda some: service.measure(some, options.map_frames)),
        "signing": sign,
        "registration": register,
        "scan": lambda: [line for size in scan.SCANNED for line in scan.measure(*size)],
        "search": search.table,
    }


def main() -> int:
    """Measure the parts, and print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", metavar="PART", help="parts to measure")
    parser.add_argument("--dataset", type=Path, default=RECORDINGS / "7scenes" / "redkitchen",
                        help="frames for a service")  # fmt: skip
    parser.add_argument("--frames", type=int, default=50, help="number of frames to sign")
    parser.add_argument("--pairs", type=int, default=20, help="number of pairs to register")
    parser.add_argument("--map-frames", type=int, default=0,
                        help="fill the map of the service up to this number")  # fmt: skip
    options = parser.parse_args()
    every = parts(options)
    if unknown := set(options.only or ()) - set(every):
        parser.error(f"--only {min(unknown)}: choose from {', '.join(every)}")
    packages = ", ".join(f"{name} {version_of(name)}" for name in ("numpy", "numba", "open3d"))
    lines = [
        f"{measured_on('`make bench`')} {memory_gib():.1f} GiB; Python "
        f"{platform.python_version()}, {packages}. The machine is shared: compare ratios, not "
        "milliseconds.",
        "",
    ]
    for name, measure in every.items():
        if name == "signing":
            os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
        if options.only is None or name in options.only:
            lines += measure()
    lines.append(f"`import sceneprint`: {seconds_to_import():.2f} s.")
    print("\n".join(lines))
    return 0


if __name__ == "__main__":
    sys.exit(main())
