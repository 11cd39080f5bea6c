"""The commands `evaluate` and `evaluate-pairs`: accuracy of retrieval and registration."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, TypeVar

from tqdm import tqdm

from sceneprint.atomic_files import check_writable, write_whole
from sceneprint.cli import number_within, positive, positive_number, whole_number
from sceneprint.cli.bag import add_recording_options, sequences_at
from sceneprint.cli.preparation import add_model_options, open_signer_of
from sceneprint.errors import DatasetError
from sceneprint.settings import Settings
from sceneprint_client.sidecars import Camera

if TYPE_CHECKING:
    from sceneprint_lab.evaluation.protocol import EvaluationProtocol

T = TypeVar("T")

_EXAMPLES = """\
frames are numbered from 0 over all sequences of a PATH, in order; STOP is excluded:
  sceneprint evaluate redkitchen --db 0:600:2 --queries 650:1000:2
each PATH may have its own ranges, joined by +; all PATHs form one database:
  sceneprint evaluate redkitchen@db=0:600:2,queries=650:1000:2 \\
      fr1_rpy@db=0:217,queries=235: studyroom2@db=0:25+50:75,queries=30:50
without ranges, TrainSplit.txt and TestSplit.txt of each scene define the split: one row for
each scene, and with several also Average and Combine (all scenes in one database):
  sceneprint evaluate 7scenes --db-step 10 --query-step 10
the benchmark of the paper, on the official download with all archives unpacked:
  sceneprint evaluate --7scenes 7scenes --db-step 5 --query-step 10
a scanner that returns to a place after more than 30 m of travel:
  sceneprint evaluate hall --model lidar --gap-m 30 --within 5 --baselines
"""


def add_evaluate(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint evaluate`."""
    command.epilog = _EXAMPLES
    command.formatter_class = argparse.RawDescriptionHelpFormatter
    command.add_argument(
        "paths", nargs="*", metavar="PATH", help="PATH or PATH@db=RANGES,queries=RANGES"
    )
    command.add_argument(
        "--7scenes", type=Path, dest="seven_scenes", metavar="DIR",
        help="evaluate the scenes of 7-Scenes in this folder with their official splits, and print "
        "the figures beside those of the paper; without intrinsics.json, use the Kinect's "
        "intrinsics (focal length 585 pixels, principal point 320, 240)",
    )  # fmt: skip
    add_model_options(command)
    _add_frames(command)
    _add_method(command)
    add_recording_options(command)
    command.add_argument("--json", type=Path, metavar="FILE", help="write all figures as JSON")
    command.set_defaults(run=run_evaluate)


def _add_frames(command: argparse.ArgumentParser) -> None:
    command.add_argument("--db", metavar="RANGES", help="database frames, such as 0:600 or 0:600:2")
    command.add_argument("--queries", metavar="RANGES", help="query frames, such as 650:1000")
    for option, what in (("--db-step", "database"), ("--query-step", "query")):
        command.add_argument(
            option, type=positive, default=1, metavar="N",
            help=f"use every N-th {what} frame if a range has no step (default: 1)",
        )  # fmt: skip
    command.add_argument(
        "--max-overlap", type=_share, metavar="X",
        help="exclude frames that overlap the query by more than this share, 0 to 1",
    )  # fmt: skip
    command.add_argument(
        "--distractors", type=Path, nargs="+", default=[], metavar="PATH",
        help="add all frames of these PATHs to the database",
    )  # fmt: skip
    command.add_argument(
        "--gap-m", type=positive_number, metavar="METRES",
        help="use each frame as query and as database frame (--db and --queries may overlap, "
        "and default to all frames); a query finds only frames that are more than this distance "
        "of travel before it",
    )  # fmt: skip
    command.add_argument(
        "--within", type=positive_number, metavar="METRES",
        help="recall: maximum distance of a frame that shows the query's place (default: an "
        "overlap of half is required instead)",
    )  # fmt: skip
    command.add_argument(
        "--absent",
        action="store_true",
        help="let a query find only frames of other scenes, so that every accepted match is wrong",
    )


def _add_method(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--signature", choices=("stored", "psi"), default="stored",
        help="rank by the signature that a service stores, or by psi as in the paper, from the "
        "given model or else the preset paper (default: stored)",
    )  # fmt: skip
    command.add_argument(
        "--metric", choices=("l1", "l2"), help="default: l2; for psi l1, as in the paper"
    )
    command.add_argument(
        "--levels", type=positive, metavar="H", help="levels of psi to use (default: all)"
    )
    _add_judging(command)
    command.add_argument(
        "--baselines", nargs="*", metavar="NAME",
        help="also rank by these baselines: thumbnail_l1, thumbnail_zncc, fpfh_vlad, rings "
        "(after the PATHs; without names: all, with a notice for those that do not support the "
        "frames)",
    )  # fmt: skip
    command.add_argument(
        "--candidates", type=positive, default=10, metavar="N",
        help="number of frames in the selection (C), and of first frames in the ranking (R) to "
        "validate (default: 10)",
    )  # fmt: skip
    command.add_argument("--seed", type=whole_number, default=0, metavar="S", help="default: 0")
    command.add_argument(
        "--jobs", type=positive, default=os.cpu_count() or 1, metavar="N",
        help="number of processes; results do not depend on it",
    )  # fmt: skip


def _add_judging(command: argparse.ArgumentParser) -> None:
    """Add `--mode` and `--matching`."""
    command.add_argument(
        "--mode", choices=("full", "paper"), default="full",
        help="accept on all evidence, or on the residual alone as in the paper (default: full)",
    )  # fmt: skip
    command.add_argument(
        "--matching", choices=("histograms", "sequence"), default="histograms",
        help="find correspondences by histograms, or by aligned sequences of neighbours as in "
        "the paper, which is slower (default: histograms)",
    )  # fmt: skip


def _share(text: str) -> float:
    """Parse a number above 0 and up to 1; raise ArgumentTypeError for others."""
    return number_within(text, lambda number: 0 < number <= 1, "a share above 0, up to 1")


def run_evaluate(options: argparse.Namespace) -> int:
    """Query a database of frames with each query frame, and compare the answers with the true
    poses: the rows R, VR, DR, VDR of the paper, and the averaged pose.
    """
    from sceneprint_lab.evaluation.protocol import FrameStore
    from sceneprint_lab.evaluation.report import figures, seven_scenes_table, table, to_json
    from sceneprint_lab.evaluation.run import EvaluationSettings, evaluate

    protocol = _protocol(options)
    baselines = _baselines(options.baselines)
    signer = open_signer_of(options, Settings(), psi=options.signature == "psi")
    if options.levels is not None and signer.model.whitening is not None:
        raise DatasetError(
            f"--levels {options.levels}: the signatures of model {signer.model.label} cannot be "
            "split by level. Add --signature psi, or omit --levels."
        )
    if (options.levels or 1) > (most := len(signer.model.levels)):
        raise DatasetError(
            f"--levels {options.levels}: model {signer.model.label} has {most} levels. "
            f"Choose from 1 to {most}."
        )
    _check_writable(options.json)
    keys = (
        "metric", "levels", "mode", "matching", "candidates", "max_overlap", "absent", "gap_m",
        "seed", "jobs",
    )  # fmt: skip
    settings = EvaluationSettings(
        **{key: getattr(options, key) for key in keys}, within_m=options.within,
        baselines=baselines, cache_dir=Settings().cache_dir,
    )  # fmt: skip
    with TemporaryDirectory(prefix="sceneprint-") as folder:
        store = FrameStore(Path(folder))
        evaluation = evaluate(protocol, signer, store, settings, _watch)
        database = evaluation.prepared.database
        written = _settings_of(
            options, signer.model.id, "paths", "db", "queries", "db_step", "query_step",
            "max_overlap", "absent", "gap_m", "within", "baselines", "signature", "metric",
            "levels", "mode", "matching", "candidates", "seed", "seven_scenes", "distractors",
        )  # fmt: skip
        written["metric"] = options.metric or signer.model.metric
        report = figures(evaluation, lambda match: store.frame(database[match]), written)
        if options.json is not None:
            write_whole(options.json, to_json(report))
        counts = report["counts"]
        print(
            f"model {signer.model.label}: {counts['queries']} queries, {counts['database']} "
            f"database frames{_skipped(counts['left_out'])}"
        )
        print("\n".join(table(report)))
        if options.seven_scenes is not None:
            print("\n".join(["", *seven_scenes_table(report, evaluation.outcomes[0].scene)]))
    return 0


def _check_writable(file: Path | None) -> None:
    """Create the folder for the figures; check, before a long evaluation, that it is writable."""
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        check_writable(file)


def _settings_of(options: argparse.Namespace, model_id: str, *keys: str) -> dict[str, Any]:
    """Return the version, model and options `keys` with which the evaluation can be repeated."""
    from sceneprint import __version__

    def plain(value: Any) -> Any:
        if isinstance(value, Path):
            return str(value)
        return [plain(item) for item in value] if isinstance(value, list) else value

    own = {key: plain(getattr(options, key)) for key in keys}
    return {"version": __version__, "model_id": model_id, **own}


def _skipped(number: int) -> str:
    return f", {number} frames skipped" if number else ""


def _protocol(options: argparse.Namespace) -> EvaluationProtocol:
    """Return the frames that the options select; raise DatasetError if options contradict."""
    from sceneprint_lab.evaluation.protocol import PathRanges, choose, parse_part, parse_ranges

    if options.seven_scenes is not None:
        from sceneprint_lab.synth import KINECT  # camera of 7-Scenes, according to its web page

        return choose(
            [PathRanges(scene) for scene in _seven_scenes(options)],
            database_step=options.db_step,
            query_step=options.query_step,
            find=partial(sequences_at, options=options, camera=Camera(KINECT)),
        )
    if not options.paths:
        raise DatasetError("There is nothing to evaluate. Specify a PATH, or --7scenes DIR.")
    parts = [parse_part(text) for text in options.paths]
    both = options.db is not None, options.queries is not None
    ranged = [part for part in parts if part.database is None and part.queries is None]
    elsewhere = options.distractors or any(part.database for part in parts)
    if any(both) and not all(both) and not (both[1] and elsewhere):
        option, other = ("--db", "--queries") if both[0] else ("--queries", "--db")
        raise DatasetError(f"{option} requires {other}. Specify both or neither.")
    if any(both) and not ranged:
        raise DatasetError(
            "--db and --queries apply only to a PATH without its own ranges, but every PATH has "
            "ranges. Omit --db and --queries."
        )
    return choose(
        parts, options.distractors, database=parse_ranges(options.db) if both[0] else None,
        queries=parse_ranges(options.queries) if both[1] else None, database_step=options.db_step,
        query_step=options.query_step, shared=options.gap_m is not None,
        find=partial(sequences_at, options=options),
    )  # fmt: skip


def _seven_scenes(options: argparse.Namespace) -> list[Path]:
    """Return the folders of the scenes; print the names of missing scenes to standard error.

    Raise DatasetError if there is no scene, or if another option contradicts --7scenes.
    """
    from sceneprint_lab.evaluation.report import PAPER

    for value, name in (
        (options.paths, "PATH"), (options.db, "--db"), (options.queries, "--queries"),
        (options.distractors, "--distractors"), (options.gap_m, "--gap-m"),
    ):  # fmt: skip
        if value:
            raise DatasetError(
                f"--7scenes uses the splits of its scenes for database and queries. Omit {name}, "
                "or specify the scenes as PATHs."
            )
    folder: Path = options.seven_scenes
    names = list(PAPER)
    folders = [folder / name for name in names if (folder / name).is_dir()]
    missing = [name for name in names if folder / name not in folders]
    if not folders:
        raise DatasetError(
            f"{folder}: There is no folder {', '.join(names[:-1])} or {names[-1]} here. Download "
            "7-Scenes, unpack the archives of its scenes and sequences, and specify the folder "
            "that contains the scenes."
        )
    if missing:
        print(f"not in {folder}: {', '.join(missing)}", file=sys.stderr)
    return folders


def _baselines(names: list[str] | None) -> tuple[str, ...]:
    """Return the baselines `names` (none for None, all for []) in the order of BASELINES.

    Raise DatasetError if a name is unknown.
    """
    from sceneprint_lab.evaluation.baselines import BASELINES

    if unknown := [name for name in names or () if name not in BASELINES]:
        raise DatasetError(
            f"--baselines {unknown[0]}: There is no such baseline. Choose from "
            f"{', '.join(BASELINES)}; put the PATHs first."
        )
    return () if names is None else tuple(name for name in BASELINES if name in names or not names)


def _watch(items: Iterable[T], stage: str, total: int) -> Iterable[T]:
    """Return the items with a progress bar."""
    return tqdm(items, desc=stage, total=total, disable=None)


#: Maximum number of frames of a scene, because the overlaps of all pairs are computed.
_MOST = 2000
_PAIR_EXAMPLES = """\
pairs of one PATH, or of several of one scene, may overlap; pairs of two scenes are
negatives, and in a quarter of these one frame shows little more than a plane:
  sceneprint evaluate-pairs redkitchen studyroom2 fr1_rpy --negatives 3000 --json pairs.json
compare with Open3D (FPFH with RANSAC or FGR, then ICP):
  sceneprint evaluate-pairs redkitchen --baselines
"""


def add_evaluate_pairs(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint evaluate-pairs`."""
    command.epilog = _PAIR_EXAMPLES
    command.formatter_class = argparse.RawDescriptionHelpFormatter
    command.add_argument("paths", nargs="+", type=Path, metavar="PATH", help="path of sequences")
    add_model_options(command)
    _add_drawing(command)
    _add_judging(command)
    command.add_argument(
        "--right", nargs=2, type=_limit, default=[0.1, 10.0], metavar=("METRES", "DEGREES"),
        help="maximum errors of a correct transform, metres and degrees (default: 0.1 10)",
    )  # fmt: skip
    command.add_argument(
        "--baselines",
        action="store_true",
        help="also register overlapping pairs with Open3D, in about a second per pair",
    )
    command.add_argument(
        "--jobs", type=positive, default=os.cpu_count() or 1, metavar="N",
        help="number of processes; only the times depend on it",
    )  # fmt: skip
    command.add_argument("--json", type=Path, metavar="FILE", help="write all figures as JSON")
    command.set_defaults(run=run_evaluate_pairs)


def _add_drawing(command: argparse.ArgumentParser) -> None:
    for option, default, kind, what in (
        ("--pairs", 120, positive, "number of pairs per scene and overlap bin"),
        ("--negatives", 400, whole_number, "total number of pairs of two scenes"),
        (
            "--apart", 30, whole_number,
            "minimum number of frames by which two frames of a recording are apart",
        ),
        ("--frames", 300, _frames, "maximum number of frames of each scene, evenly spread"),
        ("--seed", 0, whole_number, "random seed of sampling and validation"),
    ):  # fmt: skip
        command.add_argument(
            option, type=kind, default=default, metavar="N", help=f"{what} (default: {default})"
        )


def _frames(text: str) -> int:
    """Parse a whole number from 2 to _MOST."""
    number = positive(text)
    if not 2 <= number <= _MOST:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 2 to {_MOST}")
    return number


def _limit(text: str) -> float:
    """Parse a number above 0 and up to 180."""
    return number_within(text, lambda number: 0 < number <= 180, "a number above 0, up to 180")


def run_evaluate_pairs(options: argparse.Namespace) -> int:
    """Sample pairs of frames by their true overlap, validate each, and compare the result with
    the true poses: success by overlap, precision, recall, false accepts.

    Print the figures, and write them to the file of `--json`.
    """
    from sceneprint_lab.evaluation.pair_report import pair_figures, pair_table
    from sceneprint_lab.evaluation.pair_run import Drawing, PairSettings, evaluate_pairs
    from sceneprint_lab.evaluation.protocol import FrameStore
    from sceneprint_lab.evaluation.report import to_json

    _check_writable(options.json)
    signer = open_signer_of(options, Settings())
    keys = ("frames", "mode", "matching", "seed", "baselines", "jobs")
    settings = PairSettings(
        Drawing(options.pairs, options.negatives, options.apart, options.seed),
        **{key: getattr(options, key) for key in keys}, limits=tuple(options.right),
        cache_dir=Settings().cache_dir,
    )  # fmt: skip
    with TemporaryDirectory(prefix="sceneprint-") as folder:
        store = FrameStore(Path(folder))
        evaluation = evaluate_pairs(options.paths, signer, store, settings, _watch)
        written = _settings_of(
            options, signer.model.id, "paths", "pairs", "negatives", "apart", "frames", "seed",
            "mode", "matching", "right", "baselines",
        )  # fmt: skip
        report = pair_figures(evaluation, written)
        if options.json is not None:
            write_whole(options.json, to_json(report))
        counts = report["counts"]
        frames = ", ".join(
            f"{n} frames of {scene} ({counts['planar'][scene]} planar)"
            for scene, n in counts["frames"].items()
        )
        print(
            f"model {signer.model.label}: {counts['pairs']} pairs of {frames}"
            f"{_skipped(counts['left_out'])}"
        )
        print("\n".join(pair_table(report)))
    return 0
