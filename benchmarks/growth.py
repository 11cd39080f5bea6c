"""How a map's search grows: recall, time, memory and disk against the number of frames.

`python -m benchmarks.growth`               a small version, with signatures made on the spot
`python -m benchmarks.growth --make FOLDER` signs realistic frames into a folder (12 minutes)
`python -m benchmarks.growth --full FOLDER` measures with these, up to 100,000 frames; with
`--page docs/performance.md` writes the section of that page, and its picture beside it
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
from tqdm import tqdm

from benchmarks import curves, disk, recall
from benchmarks.growth_page import GrowthFigures, section, table
from benchmarks.machine import pin_to_one_processor
from benchmarks.maps import Library, dense, grown, join, noise, read_library, thousands
from benchmarks.pages import put_between
from benchmarks.trajectories import laps, make, signed
from sceneprint.datasets import find_sequences
from sceneprint.models import PRESETS, read_model
from sceneprint.pipeline import open_signer
from sceneprint.types import Bytes

ROOT = Path(__file__).resolve().parent.parent
BEGIN, END = "<!-- growth:begin -->", "<!-- growth:end -->"
#: Sizes of the curves, and the map that is signed and that it is extended to.
SIZES = (1_000, 3_000, 10_000, 30_000, 100_000)
SIGNED, EXTENDED = 10_000, 100_000


def measure_small(rooms: int = 4, sizes: Sequence[int] = SIZES[:4]) -> GrowthFigures:
    """Recall of a few short laps extended to 2,000 frames, and curves of random bytes."""
    signer = open_signer("compact")
    made = [
        signed(laps(i, 2, 20), [signer])[0]
        for i in tqdm(range(rooms), desc="laps", unit="room", disable=None)
    ]
    joined = join("short laps", made)
    rng = np.random.default_rng(0)
    random: Bytes = rng.integers(0, 256, (max(sizes), signer.model.signature_bytes), np.uint8)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        case = grown(joined, "places", 2_000, folder / "grown.npy")
        found = recall.measure([case], folder / "recall")
        points = curves.measure(random, random[:32], sizes, folder / "curves")
    return GrowthFigures([found], {random.shape[1]: points}, [], {})


def measure_full(folder: Path, recordings: Path) -> GrowthFigures:
    """Everything, with the signatures of a folder; arrays of extended maps are kept there."""
    kinds: list[recall.RecallFigures] = []
    drawn: dict[int, list[curves.Point]] = {}
    apart: dict[int, float] = {}
    with tempfile.TemporaryDirectory(dir=folder) as name:
        scratch = Path(name)
        for preset in ("compact", "paper"):
            model = read_model(preset)
            library = read_library(folder, model.id)
            joined = join("real and synthetic", library.places, SIGNED)
            cases = _cases(library, joined.case)
            whole = joined.case
            if preset == "compact":
                for how in ("places", "visits"):
                    path = folder / f"{preset}-{how}-{len(whole.signatures)}-{EXTENDED}.npy"
                    cases.append([grown(joined, how, EXTENDED, path)])
                whole = cases[-2][0]
            elif len(whole.signatures) < SIGNED:
                path = folder / f"{preset}-places-{len(whole.signatures)}-{SIGNED}.npy"
                whole = grown(joined, "places", SIGNED, path)
            for i, own in enumerate(tqdm(cases, desc=f"recall, {preset}", disable=None)):
                at = scratch / f"{preset}-{i}"
                appended = len(own[0].signatures) >= SIGNED and "visits" not in own[0].name
                kinds.append(recall.measure(own, at, appended=appended))
            sizes = [n for n in SIZES if n <= len(whole.signatures)]
            drawn[model.signature_bytes] = curves.measure(
                whole.signatures, whole.queries, sizes, scratch / f"curves-{preset}"
            )
            apart[model.signature_bytes] = noise(library.rooms) / model.unrelated_distance
        return GrowthFigures(kinds, drawn, _disk(recordings, scratch), apart)


def _cases(library: Library, joined: recall.Case) -> list[list[recall.Case]]:
    """Maps of what was signed, of about a thousand frames and of all."""
    cases = [thousands("synthetic", library.rooms), [joined]]
    if library.recorded is not None:
        real = [[dense("real, every fifth asked", library.recorded)]]
        real.append([join("real, stretches asked", [library.recorded]).case])
        cases = real + cases
    return [own for own in cases if own]


def _disk(recordings: Path, scratch: Path) -> list[disk.DiskFigures]:
    found = [f for s in find_sequences(recordings / "7scenes") for f in s.frames][::12]
    return [disk.measure(found, preset, scratch / f"disk-{preset}") for preset in PRESETS]


def main() -> int:
    """Make, or measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--make", type=Path, metavar="FOLDER")
    parser.add_argument("--presets", nargs="+", choices=PRESETS, default=["compact"])
    parser.add_argument("--full", type=Path, metavar="FOLDER")
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--page", type=Path, help="Markdown file whose marked section is replaced")
    parser.add_argument("--json", type=Path, default=ROOT / "out" / "growth.json")
    options = parser.parse_args()
    if options.make is not None:
        make(options.make, options.data, options.presets)
        return 0
    pin_to_one_processor()
    if options.full is None:
        print("\n".join(table(measure_small())))
        return 0
    figures = measure_full(options.full, options.data)
    options.json.parent.mkdir(parents=True, exist_ok=True)
    options.json.write_text(json.dumps(asdict(figures), indent=1) + "\n")
    print("\n".join(table(figures)))
    if options.page is not None:
        write_page(figures, options.page)
    return 0


def write_page(figures: GrowthFigures, page: Path) -> None:
    """Replace the marked section of a page, and the picture beside it."""
    from benchmarks.growth_picture import draw

    draw(figures, page.with_name("growth.png"))
    put_between(page, BEGIN, END, section(figures, "growth.png"))


if __name__ == "__main__":
    sys.exit(main())
