"""`make bench`: what every stage costs, as tables, as JSON, and in docs/performance.md."""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from tqdm import tqdm

from benchmarks import dashboard, disk, readiness, registration, scan, search, service, summary
from benchmarks.encode import EncodeFigures, measure
from benchmarks.machine import (
    Machine,
    describe_machine,
    peak_megabytes_of_signing,
    pin_to_one_processor,
    seconds_to_import,
)
from benchmarks.pairs import real_pairs, synthetic_pairs
from sceneprint.formats.dataset import Camera, find_sequences, write_depth_png, write_intrinsics
from sceneprint.models import PRESETS
from sceneprint.pipeline import open_signer
from sceneprint.types import DepthFrame
from sceneprint_lab.synth import synthesise_room

ROOT = Path(__file__).resolve().parent.parent
#: Frames of the maps that are searched, and whether by sketches.
SEARCHED = (
    (10_000, search.FLAT), (100_000, search.FLAT), (1_000_000, search.FLAT),
    (100_000, search.SKETCHES), (1_000_000, search.SKETCHES),
)  # fmt: skip
BEGIN, END = "<!-- bench:begin -->", "<!-- bench:end -->"


def recordings() -> Path:
    """Folder of real recordings, which need not be there."""
    return Path(os.environ.get("SCENEPRINT_DATA", ROOT.parent / "shared" / "data"))


def real_frames(n: int) -> list[DepthFrame]:
    """`n` frames spread over the recordings at SCENEPRINT_DATA; none where there are none."""
    root = recordings()
    scenes = [root / "7scenes", root / "tum", root / "sun3d"]
    found = [
        reference
        for scene in scenes
        if scene.is_dir()
        for sequence in find_sequences(scene)
        for reference in sequence.frames
    ]
    step = max(len(found) // n, 1)
    return [reference.read_depth() for reference in found[::step][:n]]


def synthetic_frames(n: int) -> list[DepthFrame]:
    """`n` frames of synthetic rooms, five of each."""
    rooms = tqdm(range((n + 4) // 5), desc="synthetic rooms", disable=None)
    return [frame for i in rooms for frame in synthesise_room(3, i, 5).frames][:n]


def peak_memory(frames: list[DepthFrame], preset: str) -> float:
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
    lines += [f"| {stage} | {ms:.1f} |" for stage, ms in f.artifact_stages.items()]
    lines += [f"| {stage} | {ms:.1f} |" for stage, ms in f.fpfh_stages.items()]
    if f.fpfh is not None and f.ratio is not None and f.ratio_with_artifact is not None:
        lines += [f"| **FPFH, sum** | **{f.fpfh:.1f}** |"]
        lines += [f"| **signing / FPFH** | **{f.ratio:.2f}** |"]
        lines += [f"| **signing and geometry artifact / FPFH** | **{f.ratio_with_artifact:.2f}** |"]
    else:
        lines += [f"| FPFH | not measured: {f.note} |"]
    sizes = f"Geometry artifact: {f.artifact_bytes:,} bytes. Peak memory of a process that signs: "
    return [*lines, "", f"{sizes}{peak:.0f} MB.", ""]


@dataclass(frozen=True)
class Rows:
    """All that one run measured; `encode`: figures and peak memory (MB) of each preset."""

    encode: dict[str, tuple[EncodeFigures, float]]
    scan: list[scan.ScanFigures]
    registration: registration.RegistrationFigures
    search: list[search.SearchFigures]
    service: service.ServiceFigures
    readiness: readiness.ReadinessFigures | None = None
    disk: list[disk.DiskFigures] | None = None
    dashboard: dashboard.DashboardFigures | None = None


def page(machine: Machine, rows: Rows, start: float) -> str:
    """The section of docs/performance.md that `make bench` owns."""
    packages = ", ".join(f"{name} {number}" for name, number in machine.packages.items())
    lines = [
        BEGIN,
        f"Measured {datetime.now(UTC):%Y-%m-%d} on: {machine.processor}, {machine.cores} cores, "
        f"{machine.memory_gib} GiB; Python {machine.python}, {packages}. The machine is shared: "
        "compare ratios, not milliseconds.",
        "",
    ]
    of_depth = rows.encode.get(PRESETS[0])
    if of_depth is not None:
        lines += summary.table(of_depth[0], rows.search[0], rows.service)
    for preset, (figures, peak) in rows.encode.items():
        lines += table(preset, figures, peak)
    lines += service.table(rows.service)
    lines += readiness.table(rows.readiness) if rows.readiness is not None else []
    lines += dashboard.table(rows.dashboard)
    lines += [line for one in rows.scan for line in scan.table(one)] + search.table(rows.search)
    lines += registration.table(rows.registration)
    lines += disk.table(rows.disk) if rows.disk is not None else []
    return "\n".join([*lines, f"`import sceneprint`: {start:.2f} s.", END])


def measure_all(n_frames: int, n_pairs: int) -> Rows:
    """Every row, one after the other."""
    frames = real_frames(n_frames) or synthetic_frames(n_frames)
    pairs = real_pairs(recordings(), n_pairs) or synthetic_pairs(n_pairs)
    recording = recordings() / "7scenes" / "redkitchen"
    with service.frames_of(recording if recording.is_dir() else None) as served_frames:
        served = service.measure(served_frames)
        started = readiness.measure(served_frames[0], list(served_frames[1:201]))
        stored = [disk.measure_new(served_frames[:40], preset) for preset in ("depth", "paper")]
    looked = dashboard.measure()
    pin_to_one_processor()  # the service above has all processors, as it would
    signers = {preset: open_signer(preset) for preset in PRESETS}
    return Rows(
        encode={p: (measure(frames, s), peak_memory(frames, p)) for p, s in signers.items()},
        scan=[scan.measure(*size) for size in scan.SCANNED],
        registration=registration.measure(pairs, signers[PRESETS[0]].model),
        search=[search.measure(n, flat_bytes=kind) for n, kind in SEARCHED],
        service=served,
        readiness=started,
        disk=stored,
        dashboard=looked,
    )


def main() -> int:
    """Measure, print, and write what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=50)
    parser.add_argument("--pairs", type=int, default=20)
    parser.add_argument("--json", type=Path, default=ROOT / "out" / "bench.json")
    parser.add_argument("--page", type=Path, help="Markdown file whose marked section is replaced")
    options = parser.parse_args()
    start = seconds_to_import()
    rows = measure_all(options.frames, options.pairs)
    machine = describe_machine()
    section = page(machine, rows, start)
    print(section)
    options.json.parent.mkdir(parents=True, exist_ok=True)
    result = {
        "machine": asdict(machine),
        "import_seconds": start,
        "encode": {p: asdict(f) | {"peak_megabytes": m} for p, (f, m) in rows.encode.items()},
        "scan": [asdict(one) for one in rows.scan],
        "registration": asdict(rows.registration),
        "search": [asdict(one) for one in rows.search],
        "service": asdict(rows.service),
        "readiness": None if rows.readiness is None else asdict(rows.readiness),
        "disk": None if rows.disk is None else [asdict(one) for one in rows.disk],
        "dashboard": None if rows.dashboard is None else asdict(rows.dashboard),
    }
    options.json.write_text(json.dumps(result, indent=1) + "\n")
    if options.page is not None:
        before, rest = options.page.read_text().split(BEGIN)
        options.page.write_text(before + section + rest.split(END)[1])
    return 0


if __name__ == "__main__":
    sys.exit(main())
