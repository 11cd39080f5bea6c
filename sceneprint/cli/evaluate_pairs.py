"""`sceneprint evaluate-pairs`: how well two frames are registered, and rightly believed."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

from tqdm import tqdm

from sceneprint.cli.judging import add_judging_options
from sceneprint.cli.numbers import positive, whole
from sceneprint.cli.signer import add_model_options, open_for
from sceneprint.settings import Settings
from sceneprint.writing import check_writable, write_whole

T = TypeVar("T")

#: Frames of a scene at the most: overlap is of all with all.
_MOST = 2000
_EXAMPLES = """\
frames of one PATH, or of several that are one scene, overlap or do not; frames of two scenes are
negatives of each other, a quarter of them drawn among pairs with a frame that shows little but
one plane:
  sceneprint evaluate-pairs redkitchen studyroom2 fr1_rpy --negatives 3000 --json pairs.json
beside Open3D (FPFH with RANSAC or FGR, then ICP), with curves and failures drawn into a folder:
  sceneprint evaluate-pairs redkitchen --baselines --out pairs
"""


def add_to(commands: Any) -> None:
    """Describe the command to the parser."""
    command = commands.add_parser(
        "evaluate-pairs",
        help="measure registration and acceptance of pairs of frames with known poses",
        description="Draw pairs of frames by how much they truly overlap, validate each, and "
        "judge it by the\ntrue poses: success by overlap, precision, recall, false accepts.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.add_argument("paths", nargs="+", type=Path, metavar="PATH", help="of sequences")
    add_model_options(command)
    _add_drawing(command)
    add_judging_options(command)
    command.add_argument(
        "--right",
        nargs=2,
        type=_limit,
        default=[0.1, 10.0],
        metavar=("METRES", "DEGREES"),
        help="a transform is right within these (default: 0.1 10)",
    )
    command.add_argument(
        "--baselines",
        action="store_true",
        help="register overlapping pairs by Open3D, too: about a second each",
    )
    command.add_argument(
        "--jobs",
        type=positive,
        default=os.cpu_count() or 1,
        metavar="N",
        help="processes; no figure but times depends on it",
    )
    command.add_argument("--json", type=Path, metavar="FILE", help="write every figure")
    command.add_argument("--out", type=Path, metavar="DIR", help="draw curves and failed pairs")
    command.set_defaults(run=run)


def _add_drawing(command: argparse.ArgumentParser) -> None:
    for option, default, kind, what in (
        ("--pairs", 120, positive, "pairs of each bin of overlap of each scene"),
        ("--negatives", 400, whole, "pairs of two scenes, over all of these"),
        ("--apart", 30, whole, "places in a recording between two frames, at least"),
        ("--frames", 300, _frames, "frames of each scene, evenly spread, at most"),
        ("--seed", 0, whole, "of the draw and of every validation"),
    ):
        command.add_argument(
            option, type=kind, default=default, metavar="N", help=f"{what} (default: {default})"
        )


def _frames(text: str) -> int:
    """A whole number from 2 to _MOST."""
    number = positive(text)
    if not 2 <= number <= _MOST:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 2 to {_MOST}")
    return number


def _limit(text: str) -> float:
    """A number above 0, up to 180."""
    try:
        limit = float(text)
    except ValueError:
        limit = -1.0
    if not 0 < limit <= 180:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0, up to 180")
    return limit


def run(options: argparse.Namespace) -> int:
    """Evaluate, print, and write what was asked for."""
    from sceneprint.evaluation.frames import Store
    from sceneprint.evaluation.pair_drawing import Drawing
    from sceneprint.evaluation.pair_report import pair_figures
    from sceneprint.evaluation.pair_run import Settings as PairSettings
    from sceneprint.evaluation.pair_run import evaluate_pairs
    from sceneprint.evaluation.pair_table import pair_table
    from sceneprint.evaluation.report import to_json

    own = Settings()
    _make_room(options)
    signer = open_for(options, own)
    settings = PairSettings(
        drawing=Drawing(options.pairs, options.negatives, options.apart, options.seed),
        frames=options.frames,
        mode=options.mode,
        matching=options.matching,
        seed=options.seed,
        limits=(options.right[0], options.right[1]),
        baselines=options.baselines,
        jobs=options.jobs,
        cache_dir=own.cache_dir,
    )
    with TemporaryDirectory(prefix="sceneprint-") as folder:
        store = Store(Path(folder))
        evaluation = evaluate_pairs(options.paths, signer, store, settings, _watch)
        found = pair_figures(evaluation, _asked(options, signer.model.id))
        # figures first: a picture that cannot be drawn must not cost an hour's work
        if options.json is not None:
            write_whole(options.json, to_json(found))
        print(f"model {signer.model.label}: {_counts(found)}")
        print("\n".join(pair_table(found)))
        if options.out is not None:
            from sceneprint.evaluation.pair_pictures import save_pair_pictures

            for path in save_pair_pictures(options.out, evaluation, found, store):
                print(f"picture: {path}")
    return 0


def _make_room(options: argparse.Namespace) -> None:
    """Folders for what is to be written; what cannot be written must not cost an hour's work."""
    for file in (options.json, options.out / "roc.png" if options.out else None):
        if file is not None:
            file.parent.mkdir(parents=True, exist_ok=True)
            check_writable(file)


def _asked(options: argparse.Namespace, model_id: str) -> dict[str, Any]:
    """Everything that is needed to repeat the evaluation."""
    from sceneprint import __version__

    keys = (
        "pairs",
        "negatives",
        "apart",
        "frames",
        "seed",
        "mode",
        "matching",
        "right",
        "baselines",
    )
    return {
        "version": __version__,
        "model_id": model_id,
        "paths": [str(path) for path in options.paths],
        **{key: getattr(options, key) for key in keys},
    }


def _counts(found: dict[str, Any]) -> str:
    counts = found["counts"]
    frames = ", ".join(
        f"{n} frames of {scene} ({counts['planar'][scene]} planar)"
        for scene, n in counts["frames"].items()
    )
    left_out = f", {counts['left_out']} frames left out" if counts["left_out"] else ""
    return f"{counts['pairs']} pairs of {frames}{left_out}"


def _watch(items: Iterable[T], stage: str, total: int) -> Iterable[T]:
    return tqdm(items, desc=stage, total=total, disable=None)
