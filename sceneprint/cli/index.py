"""`sceneprint index`: the search indexes of a data folder, looked at, verified, made anew."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from sceneprint.cli.existing import require_database
from sceneprint.cli.numbers import whole
from sceneprint.cli.serve import add_data_option, settings_of
from sceneprint.errors import InvalidRequest

if TYPE_CHECKING:
    from sceneprint.engine import Engine
    from sceneprint.maintenance.indexes import IndexStats


def add_to(commands: Any) -> None:
    """Describe the command to the parser."""
    command = commands.add_parser(
        "index",
        help="look at, verify or rebuild the search indexes",
        description="The search indexes of a data folder. They are caches: what is wrong with "
        "one costs no frame, and `rebuild` makes it anew from the database.",
    )
    what = command.add_subparsers(dest="what", required=True, metavar="ACTION")
    stats = what.add_parser(
        "stats", help="frames, lag, bytes a frame, and recall against the exact scan"
    )
    stats.add_argument(
        "--sample", type=whole, default=100, metavar="N",
        help="frames to look up for the recall (default: 100)",
    )  # fmt: skip
    stats.add_argument("--seed", type=whole, default=0, metavar="N", help="of their choice")
    stats.add_argument("--json", action="store_true", help="print JSON, a line a map")
    verify = what.add_parser("verify", help="read all of it; exit code 1 where something is wrong")
    rebuild = what.add_parser("rebuild", help="make it anew from the database")
    purge = what.add_parser(
        "purge", help="leave no byte of a deleted frame on this node, now and not within PURGE_S"
    )
    add_data_option(purge)
    for one in (stats, verify, rebuild):
        one.add_argument("map", nargs="*", metavar="MAP", help="default: all maps")
        add_data_option(one)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Do what was asked for with the indexes of the data folder."""
    from sceneprint.engine import Engine

    settings = settings_of(options)
    require_database(settings)
    with Engine(settings) as engine:
        if options.what == "purge":
            return _purge(engine)
        do = {"stats": _stats, "verify": _verify, "rebuild": _rebuild}[options.what]
        for name in options.map:  # all of them are there, before anything is done with one
            engine.get_map(name)
        names = options.map or [one.name for one in engine.list_maps().items]
        if not names:
            print("no maps yet")
        return max((do(engine, name, options) for name in names), default=0)


def _stats(engine: Engine, name: str, options: argparse.Namespace) -> int:
    from tqdm import tqdm

    from sceneprint.maintenance.indexes import describe_index

    with tqdm(unit="query", leave=False, disable=not sys.stderr.isatty()) as bar:

        def progress(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        found = describe_index(engine, name, options.sample, options.seed, progress)
    if options.json:
        print(json.dumps(asdict(found) | {"bytes_beyond_upload": found.bytes_beyond_upload}))
    else:
        print("\n".join(_lines(found)))
    return 0


def _lines(s: IndexStats) -> list[str]:
    index = "no index" if s.generation == 0 else f"generation {s.generation}"
    recall = "1: queries compare every frame" if s.recall is None else f"{s.recall:.3f}"
    lists = f", {s.probes} lists compared" if s.probes else ""
    spread = "" if s.spread is None else f"; 100th neighbour at {s.spread:.2f} of the 10th"
    return [
        f"map {s.map}, {s.model}",
        f"  frames      {s.frames}, {index}",
        f"  lag         {s.lag_frames} frames, {s.lag_s:.0f} s; {s.deleted} deleted ones in it",
        f"  bytes       {s.bytes_beyond_upload} a frame beside its upload of {s.upload_bytes}: "
        f"signature {s.signature_bytes}, artifact {s.artifact_bytes}, index {s.index_bytes}",
        f"  recall@10   {recall}{lists} ({s.sample} frames){spread}",
    ]


def _verify(engine: Engine, name: str, _: argparse.Namespace) -> int:
    from sceneprint.maintenance.indexes import verify_index

    wrong = verify_index(engine, name)
    for line in wrong:
        print(f"map {name}: {line}")
    if wrong:
        print(f"map {name}: rebuild it with `sceneprint index rebuild {name}`")
    else:
        print(f"map {name}: sound")
    return int(bool(wrong))


def _rebuild(engine: Engine, name: str, options: argparse.Namespace) -> int:
    try:
        print(f"map {name}: generation {engine.rebuild_index(name)}")
    except InvalidRequest as error:  # of all maps, those are passed over that can have none
        if options.map:
            raise
        print(f"map {name}: {error}")
    return 0


def _purge(engine: Engine) -> int:
    found = engine.purging.now()
    print(
        f"removed what deletions had left: {found.blobs} blobs, {found.answers} kept answers, "
        f"{found.reconstructions} reconstructions; {found.indexes} indexes were made anew"
    )
    if not engine.store.database.shrink_log():
        print("the log of the database is in use: run it again when nobody reads")
        return 1
    return 0
