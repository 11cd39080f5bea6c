"""`sceneprint evaluate`: how well frames are found again, by their true poses."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, TypeVar

from tqdm import tqdm

from sceneprint.cli.judging import add_judging_options
from sceneprint.cli.numbers import positive, whole
from sceneprint.cli.signer import add_model_options, open_for
from sceneprint.errors import DatasetError
from sceneprint.settings import Settings
from sceneprint.writing import check_writable, write_whole

if TYPE_CHECKING:
    from sceneprint.evaluation.protocol import Protocol
    from sceneprint.models import Model

T = TypeVar("T")

_EXAMPLES = """\
frames are counted from 0 over all sequences of a PATH, in order; STOP is not included:
  sceneprint evaluate redkitchen --db 0:600:2 --queries 650:1000:2
each PATH may have ranges of its own, several joined by +; all PATHs make one database:
  sceneprint evaluate redkitchen@db=0:600:2,queries=650:1000:2 \\
      fr1_rpy@db=0:217,queries=235: studyroom2@db=0:25+50:75,queries=30:50
without ranges, the TrainSplit.txt and TestSplit.txt of each scene say what is what: one row for
each scene, and with several also Average and Combine (all scenes in one database):
  sceneprint evaluate 7scenes --db-step 10 --query-step 10
a scanner that comes back to where it was, more than 30 m of travel later:
  sceneprint evaluate hall --model lidar --gap-m 30 --within 5 --baselines
"""


def add_to(commands: Any) -> None:
    """Describe the command to the parser."""
    command = commands.add_parser(
        "evaluate",
        help="measure retrieval, validation and poses on frames with known poses",
        description="Ask a database of frames for each query frame, and judge the answers by the "
        "true\nposes: the rows R, VR, DR, VDR of the paper, and the averaged pose.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.add_argument(
        "paths", nargs="+", metavar="PATH", help="PATH or PATH@db=RANGES,queries=RANGES"
    )
    add_model_options(command)
    _add_frames(command)
    _add_method(command)
    command.add_argument("--json", type=Path, metavar="FILE", help="write every figure")
    command.add_argument(
        "--plots", type=Path, metavar="DIR", help="draw curves, bars, a contact sheet and clouds"
    )
    command.set_defaults(run=run)


def _add_frames(command: argparse.ArgumentParser) -> None:
    command.add_argument("--db", metavar="RANGES", help="database frames, such as 0:600 or 0:600:2")
    command.add_argument("--queries", metavar="RANGES", help="query frames, such as 650:1000")
    for option, what in (("--db-step", "database"), ("--query-step", "query")):
        command.add_argument(
            option,
            type=positive,
            default=1,
            metavar="N",
            help=f"every N-th {what} frame, where a range names no step (default: 1)",
        )
    command.add_argument(
        "--max-overlap",
        type=_share,
        metavar="X",
        help="a query may find only frames that overlap it by less, 0 to 1",
    )
    command.add_argument(
        "--distractors",
        type=Path,
        nargs="+",
        default=[],
        metavar="PATH",
        help="all of their frames are in the database",
    )
    command.add_argument(
        "--gap-m",
        type=_metres,
        metavar="METRES",
        help="a frame is query and database frame at once (--db and --queries may meet, and are "
        "everything without), and finds only what was taken more than so much travel before it",
    )
    command.add_argument(
        "--within",
        type=_metres,
        metavar="METRES",
        help="recall: a frame is the query's place where its pose is this near (default: where "
        "the two overlap by half)",
    )
    command.add_argument(
        "--absent",
        action="store_true",
        help="a query may find only frames of other scenes: everything accepted is wrong",
    )


def _add_method(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--signature",
        choices=("stored", "psi"),
        default="stored",
        help="rank by what a service stores, or by psi as the paper does: of the model, or of the "
        "preset paper where none is named (default: stored)",
    )
    command.add_argument(
        "--metric", choices=("l1", "l2"), help="default: l2, and of psi l1, as in the paper"
    )
    command.add_argument(
        "--levels", type=positive, metavar="H", help="levels of psi to use (default: all)"
    )
    add_judging_options(command)
    command.add_argument(
        "--baselines",
        nargs="*",
        metavar="NAME",
        help="rank by these as well: thumbnail_l1, thumbnail_zncc, fpfh_vlad, rings (after the "
        "PATHs; without names: by all, and those not made for the frames say so)",
    )
    command.add_argument(
        "--candidates",
        type=positive,
        default=10,
        metavar="N",
        help="size of C, and how many of R are validated (default: 10)",
    )
    command.add_argument("--seed", type=whole, default=0, metavar="S", help="default: 0")
    command.add_argument(
        "--jobs",
        type=positive,
        default=os.cpu_count() or 1,
        metavar="N",
        help="processes; no figure depends on it",
    )


def _share(text: str) -> float:
    """A number above 0, up to 1."""
    try:
        share = float(text)
    except ValueError:
        share = -1.0
    if not 0 < share <= 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a share above 0, up to 1")
    return share


def _metres(text: str) -> float:
    """A finite number above 0."""
    try:
        metres = float(text)
    except ValueError:
        metres = -1.0
    if not 0 < metres < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of metres above 0")
    return metres


def run(options: argparse.Namespace) -> int:
    """Evaluate, print, and write what was asked for."""
    from sceneprint.evaluation.frames import Store
    from sceneprint.evaluation.report import figures, to_json
    from sceneprint.evaluation.run import Settings as EvaluationSettings
    from sceneprint.evaluation.run import evaluate
    from sceneprint.evaluation.table import table

    protocol = _protocol(options)
    baselines = _baselines(options.baselines)
    own = Settings()
    signer = open_for(options, own, psi=options.signature == "psi")
    if options.levels is not None and signer.model.whitening is not None:
        raise DatasetError(
            f"--levels {options.levels}: the signatures of model {signer.model.label} are not of "
            "levels end to end. Add --signature psi, or leave it out."
        )
    if (options.levels or 1) > (most := len(signer.model.levels)):
        raise DatasetError(
            f"--levels {options.levels}: model {signer.model.label} has {most} levels. "
            f"Choose from 1 to {most}."
        )
    _make_room(options)
    settings = EvaluationSettings(
        metric=options.metric,
        levels=options.levels,
        mode=options.mode,
        matching=options.matching,
        candidates=options.candidates,
        max_overlap=options.max_overlap,
        absent=options.absent,
        gap_m=options.gap_m,
        within_m=options.within,
        baselines=baselines,
        seed=options.seed,
        jobs=options.jobs,
        cache_dir=own.cache_dir,
    )
    with TemporaryDirectory(prefix="sceneprint-") as folder:
        store = Store(Path(folder))
        evaluation = evaluate(protocol, signer, store, settings, _watch)
        database = evaluation.prepared.database
        found = figures(
            evaluation, lambda match: store.frame(database[match]), _asked(options, signer.model)
        )
        # figures first: a picture that cannot be drawn must not cost an hour's work
        if options.json is not None:
            write_whole(options.json, to_json(found))
        print(f"model {signer.model.label}: {_counts(found)}")
        print("\n".join(table(found)))
        if options.plots is not None:
            from sceneprint.evaluation.pictures import save_pictures

            for path in save_pictures(options.plots, evaluation, found, store, signer.model):
                print(f"picture: {path}")
    return 0


def _make_room(options: argparse.Namespace) -> None:
    """Folders for what is to be written; what cannot be written must not cost an hour's work."""
    for file in (options.json, options.plots / "accuracy.png" if options.plots else None):
        if file is not None:
            file.parent.mkdir(parents=True, exist_ok=True)
            check_writable(file)


def _protocol(options: argparse.Namespace) -> Protocol:
    from sceneprint.evaluation.protocol import choose, parse_part, parse_ranges

    parts = [parse_part(text) for text in options.paths]
    both = options.db is not None, options.queries is not None
    ranged = [part for part in parts if part.database is None and part.queries is None]
    elsewhere = options.distractors or any(part.database for part in parts)
    if any(both) and not all(both) and not (both[1] and elsewhere):
        given, missing = ("--db", "--queries") if both[0] else ("--queries", "--db")
        raise DatasetError(f"{given} is given without {missing}. Give both, or neither.")
    if any(both) and not ranged:
        raise DatasetError(
            "--db and --queries apply to a PATH without ranges of its own, and there is none. "
            "Leave them out."
        )
    return choose(
        parts,
        options.distractors,
        database=parse_ranges(options.db) if both[0] else None,
        queries=parse_ranges(options.queries) if both[1] else None,
        database_step=options.db_step,
        query_step=options.query_step,
        shared=options.gap_m is not None,
    )


def _baselines(names: list[str] | None) -> tuple[str, ...]:
    """The baselines to ask, in the order of BASELINES."""
    from sceneprint.evaluation.baselines.baseline import BASELINES

    if names is None:
        return ()
    unknown = [name for name in names if name not in BASELINES]
    if unknown:
        raise DatasetError(
            f"--baselines {unknown[0]}: There is no such baseline. Choose from "
            f"{', '.join(BASELINES)}; the PATHs go before."
        )
    return tuple(name for name in BASELINES if name in names or not names)


def _asked(options: argparse.Namespace, model: Model) -> dict[str, Any]:
    """Everything that is needed to repeat the evaluation."""
    from sceneprint import __version__

    keys = (
        "paths",
        "db",
        "queries",
        "db_step",
        "query_step",
        "max_overlap",
        "absent",
        "gap_m",
        "within",
        "baselines",
        "signature",
        "metric",
        "levels",
        "mode",
        "matching",
        "candidates",
        "seed",
    )
    asked = {key: getattr(options, key) for key in keys}
    asked["metric"] = options.metric or model.metric
    return {
        "version": __version__,
        "model_id": model.id,
        **asked,
        "distractors": [str(path) for path in options.distractors],
    }


def _counts(found: dict[str, Any]) -> str:
    counts = found["counts"]
    left_out = f", {counts['left_out']} frames left out" if counts["left_out"] else ""
    return f"{counts['queries']} queries, {counts['database']} database frames{left_out}"


def _watch(items: Iterable[T], stage: str, total: int) -> Iterable[T]:
    return tqdm(items, desc=stage, total=total, disable=None)
