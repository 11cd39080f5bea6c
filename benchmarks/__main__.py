"""Measure what each part costs beside references in the same run, and print tables.

`make bench` measures all parts.
`python -m benchmarks --only service --map-frames 10000` measures one part.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from tqdm import tqdm

from benchmarks import dashboard, encode, readiness, registration, scan, search, service
from benchmarks.machine import (
    describe_machine,
    measured_on,
    pin_to_one_processor,
    seconds_to_import,
)
from benchmarks.pairs import real_pairs, synthetic_pairs
from sceneprint.formats.dataset import FrameReference, find_sequences
from sceneprint.models import PRESETS
from sceneprint.pipeline import open_signer
from sceneprint.types import DepthFrame
from sceneprint_lab.cli.demo import write_building
from sceneprint_lab.synth import synthesise_room

ROOT = Path(__file__).resolve().parent.parent
#: Folder of real recordings, which need not be there.
RECORDINGS = Path(os.environ.get("SCENEPRINT_DATA", ROOT.parent / "shared" / "data"))


def frames_to_sign(n: int) -> list[DepthFrame]:
    """Return `n` frames spread over the recordings, or of synthetic rooms."""
    scenes = [RECORDINGS / name for name in ("7scenes", "tum", "sun3d")]
    found = [
        frame
        for scene in scenes
        if scene.is_dir()
        for sequence in find_sequences(scene)
        for frame in sequence.frames
    ]
    if found:
        return [frame.read_depth() for frame in found[:: max(len(found) // n, 1)][:n]]
    rooms = tqdm(range((n + 4) // 5), desc="synthetic rooms", disable=None)
    return [frame for i in rooms for frame in synthesise_room(3, i, 5).frames][:n]


@contextmanager
def frames_to_serve(dataset: Path, most: int = 320) -> Iterator[list[FrameReference]]:
    """Yield frames of a data set, evenly thinned, or of a synthetic building."""
    with TemporaryDirectory(prefix="sceneprint-bench-") as temporary:
        if not dataset.is_dir():
            dataset = Path(temporary) / "building"
            for _ in tqdm(write_building(dataset, 6), "synthetic rooms", 6, disable=None):
                pass
        found = [frame for sequence in find_sequences(dataset) for frame in sequence.frames]
        yield found[:: max(len(found) // most, 1)][:most]


def parts(options: argparse.Namespace) -> dict[str, Callable[[], list[str]]]:
    """Return what measures each part. Those behind `service` run on one processor."""

    def served(measure: Callable[[list[FrameReference]], list[str]]) -> list[str]:
        with frames_to_serve(options.dataset) as frames:
            return measure(frames)

    def registered() -> list[str]:
        pairs = real_pairs(RECORDINGS, options.pairs) or synthetic_pairs(options.pairs)
        return registration.measure(pairs, open_signer(PRESETS[0]).model)

    def encoded() -> list[str]:
        frames = frames_to_sign(options.frames)
        return [line for one in PRESETS for line in encode.measure(frames, one)]

    return {
        "dashboard": dashboard.measure,
        "readiness": lambda: served(lambda some: readiness.measure(some[0], some[1:201])),
        "disk": lambda: served(lambda some: readiness.measure_disk(some[:40])),
        "service": lambda: served(lambda some: service.measure(some, options.map_frames)),
        "signing": encoded,
        "registration": registered,
        "scan": lambda: [line for size in scan.SCANNED for line in scan.measure(*size)],
        "search": search.table,
    }


def main() -> int:
    """Measure, and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", metavar="PART", help="parts to measure")
    parser.add_argument("--dataset", type=Path, default=RECORDINGS / "7scenes" / "redkitchen",
                        help="of what a service is asked")  # fmt: skip
    parser.add_argument("--frames", type=int, default=50, help="that are signed")
    parser.add_argument("--pairs", type=int, default=20, help="that are registered")
    parser.add_argument("--map-frames", type=int, default=0, help="of the served map, with random")
    options = parser.parse_args()
    every = parts(options)
    if unknown := set(options.only or ()) - set(every):
        parser.error(f"--only {min(unknown)}: choose from {', '.join(every)}")
    machine = describe_machine()
    packages = ", ".join(f"{name} {number}" for name, number in machine.packages.items())
    lines = [
        f"{measured_on('`make bench`')} {machine.memory_gib} GiB; Python {machine.python}, "
        f"{packages}. The machine is shared: compare ratios, not milliseconds.",
        "",
    ]
    for name, measure in every.items():
        if name == "signing":
            pin_to_one_processor()
        if options.only is None or name in options.only:
            lines += measure()
    lines.append(f"`import sceneprint`: {seconds_to_import():.2f} s.")
    print("\n".join(lines))
    return 0


if __name__ == "__main__":
    sys.exit(main())
