"""`make bench`: the cost of signing, as a table, as JSON, and in docs/performance.md."""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path

from tqdm import tqdm

from benchmarks.encode import EncodeFigures, measure
from benchmarks.machine import (
    Machine,
    describe_machine,
    peak_megabytes_of_signing,
    pin_to_one_processor,
    seconds_to_import,
)
from sceneprint.datasets import Camera, find_sequences, write_depth_png, write_intrinsics
from sceneprint.models import PRESETS
from sceneprint.pipeline import open_signer
from sceneprint.synth import synthesise_room
from sceneprint.types import Frame

ROOT = Path(__file__).resolve().parent.parent
BEGIN, END = "<!-- bench:begin -->", "<!-- bench:end -->"


def real_frames(n: int) -> list[Frame]:
    """`n` frames spread over the recordings at SCENEPRINT_DATA; none where there are none."""
    root = Path(os.environ.get("SCENEPRINT_DATA", ROOT.parent / "shared" / "data"))
    scenes = [root / "7scenes", root / "tum", root / "sun3d"]
    found = [
        reference
        for scene in scenes
        if scene.is_dir()
        for sequence in find_sequences(scene)
        for reference in sequence.frames
    ]
    step = max(len(found) // n, 1)
    return [reference.read() for reference in found[::step][:n]]


def synthetic_frames(n: int) -> list[Frame]:
    """`n` frames of synthetic rooms, five of each."""
    rooms = tqdm(range((n + 4) // 5), desc="synthetic rooms", disable=None)
    return [frame for i in rooms for frame in synthesise_room(3, i, 5).frames][:n]


def peak_memory(frames: list[Frame], preset: str) -> float:
    """Peak memory of `sceneprint sign` over ten of the frames, MB."""
    with tempfile.TemporaryDirectory() as folder:
        for i, frame in enumerate(frames[:10]):
            own = Path(folder) / f"{i:02d}"
            own.mkdir()
            write_intrinsics(own, Camera(frame.intrinsics, 1000.0, along_ray=False))
            write_depth_png(own / "frame.png", frame.depth, 1000.0)
        return peak_megabytes_of_signing(Path(folder), preset)


def table(preset: str, f: EncodeFigures, peak: float) -> list[str]:
    """The figures of one preset as lines of Markdown."""
    lines = [
        f"### Signing, `{preset}`: median of {f.frames} frames, one thread, warm",
        "",
        "| stage | ms |",
        "|---|--:|",
    ]
    lines += [f"| {stage} | {ms:.1f} |" for stage, ms in f.stages.items()]
    lines += [f"| **signing, sum** | **{f.signing:.1f}** |"]
    lines += [f"| {stage} | {ms:.1f} |" for stage, ms in f.fpfh_stages.items()]
    if f.fpfh is not None and f.ratio is not None:
        lines += [f"| **FPFH, sum** | **{f.fpfh:.1f}** |"]
        lines += [f"| **signing / FPFH** | **{f.ratio:.2f}** |"]
    else:
        lines += [f"| FPFH | not measured: {f.note} |"]
    return [*lines, "", f"Peak memory of a process that signs: {peak:.0f} MB.", ""]


def page(machine: Machine, rows: dict[str, tuple[EncodeFigures, float]], start: float) -> str:
    """The section of docs/performance.md that `make bench` owns."""
    packages = ", ".join(f"{name} {number}" for name, number in machine.packages.items())
    lines = [
        BEGIN,
        f"Measured {datetime.now(UTC):%Y-%m-%d} on: {machine.processor}, {machine.cores} cores, "
        f"{machine.memory_gib} GiB; Python {machine.python}, {packages}. The machine is shared: "
        "compare ratios, not milliseconds.",
        "",
    ]
    for preset, (figures, peak) in rows.items():
        lines += table(preset, figures, peak)
    return "\n".join([*lines, f"`import sceneprint`: {start:.2f} s.", END])


def main() -> int:
    """Measure both presets, print, and write what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=50)
    parser.add_argument("--json", type=Path, default=ROOT / "out" / "bench.json")
    parser.add_argument("--page", type=Path, help="Markdown file whose marked section is replaced")
    options = parser.parse_args()
    start = seconds_to_import()
    frames = real_frames(options.frames) or synthetic_frames(options.frames)
    pin_to_one_processor()
    rows: dict[str, tuple[EncodeFigures, float]] = {}
    for preset in PRESETS:
        rows[preset] = measure(frames, open_signer(preset)), peak_memory(frames, preset)
    machine = describe_machine()
    section = page(machine, rows, start)
    print(section)
    options.json.parent.mkdir(parents=True, exist_ok=True)
    result = {
        "machine": asdict(machine),
        "import_seconds": start,
        "encode": {p: asdict(f) | {"peak_megabytes": m} for p, (f, m) in rows.items()},
    }
    options.json.write_text(json.dumps(result, indent=1) + "\n")
    if options.page is not None:
        text = options.page.read_text()
        before, rest = text.split(BEGIN)
        options.page.write_text(before + section + rest.split(END)[1])
    return 0


if __name__ == "__main__":
    sys.exit(main())
