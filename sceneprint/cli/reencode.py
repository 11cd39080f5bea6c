"""`sceneprint reencode`: a map signed with another model, to which it then switches."""

from __future__ import annotations

import argparse
import sys
import time
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from sceneprint.cli.existing import require_database
from sceneprint.cli.serve import add_data_option, settings_of

if TYPE_CHECKING:
    from sceneprint.engine import Engine
    from sceneprint.schemas import Map

#: Seconds without a frame signed after which no worker is believed to be there.
STALL_S = 120.0
#: Seconds between two looks; longer where a look takes more than a tenth of it.
LOOK_S = 0.5


def add_to(commands: Any) -> None:
    """Describe the command to the parser."""
    command = commands.add_parser(
        "reencode",
        help="sign a map anew with another model, and switch to it",
        description="Sign every frame of a map once more, with another model, from the uploads. "
        "Workers do it behind what robots send. Queries go on with the model that the map has, "
        "until all is done: then the map switches at once. Works on the data folder, also while "
        "a service runs on it. The same command again tries again what broke down.",
    )
    command.add_argument("map", metavar="MAP")
    what = command.add_mutually_exclusive_group(required=True)
    what.add_argument("--model", metavar="MODEL", help="depth, lidar, paper, or a model file")
    what.add_argument("--status", action="store_true", help="say how far it has come")
    what.add_argument(
        "--cancel", action="store_true", help="keep the model, and remove what was made for another"
    )
    command.add_argument("--wait", action="store_true", help="wait until the map has switched")
    add_data_option(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Begin, watch or give up; returns 2 where waiting was no use."""
    from sceneprint.engine import Engine

    settings = settings_of(options)
    require_database(settings)
    with Engine(settings) as engine:
        if options.model is not None:
            told = engine.reencode(options.map, options.model)
            engine.audit.command("reencode --model", map_name=options.map, model=str(options.model))
        elif options.cancel:
            told = engine.cancel_reencode(options.map)
            engine.audit.command("reencode --cancel", map_name=options.map)
        else:
            told = engine.get_map(options.map)
        if options.wait and told.reencoding is not None:
            return _wait(engine, told)
        _say(told)
    return 0


def _say(told: Map) -> None:
    print(f"map {told.name}, model {told.model}")
    coming = told.reencoding
    if coming is None:
        return
    print(f"to come: {coming.model}; {coming.done} frames are signed with it, {coming.left} wait")
    if coming.failed:
        print(
            f"in {coming.failed} frames it finds nothing to sign: they will be rejected when the "
            "map switches"
        )
    if coming.dead:
        print(
            f"{coming.dead} frames broke down in every try, and the map does not switch before "
            "they are signed or deleted: see their jobs, and run this with --model again"
        )


def _wait(engine: Engine, told: Map) -> int:
    """Wait while frames are signed now and then."""
    coming = told.reencoding
    assert coming is not None
    last, since = -1, time.monotonic()
    with tqdm(desc=f"sign with {coming.model}", unit="frame", disable=None) as bar:
        while True:
            looked = time.monotonic()
            told = engine.get_map(told.name)
            took = time.monotonic() - looked
            now = told.reencoding
            if now is None or now.model_id != coming.model_id:
                break
            done = now.done + now.failed
            bar.total = done + now.left + now.dead
            bar.update(done - bar.n)
            if done != last:
                last, since = done, time.monotonic()
            if (now.dead and not now.left) or time.monotonic() - since > STALL_S:
                bar.close()
                _say(told)
                if not now.dead:
                    print(
                        f"nothing has come of it for {STALL_S:.0f} s. See that workers run: "
                        "`sceneprint work` starts some.",
                        file=sys.stderr,
                    )
                return 2
            time.sleep(max(LOOK_S, 10 * took))
    _say(told)
    return 0 if told.model_id == coming.model_id else 2
