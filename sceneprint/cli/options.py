"""Options shared by several commands: services, filters, queries and data folders."""

from __future__ import annotations

import argparse
import json
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from sceneprint.cli import positive, whole_number
from sceneprint.errors import InvalidRequest, UnusableStore
from sceneprint_client.api.base import GivenBase, checked, novelty_of
from sceneprint_client.api.frames import MOST_PRIORITY
from sceneprint_client.api.query import Prior
from sceneprint_client.http import DEFAULT_URL

if TYPE_CHECKING:
    from sceneprint.settings import Settings
    from sceneprint.store import Store
    from sceneprint_client import Client

# Filters of frames.


def add_filter_options(command: argparse.ArgumentParser) -> None:
    """Add `--robot` and the other options of a filter."""
    group = command.add_argument_group(
        "filter",
        "search only frames that match all of these options; a frame without the value is excluded",
    )
    group.add_argument("--robot", action="append", metavar="NAME", help="repeatable: matches any")
    group.add_argument("--session", action="append", metavar="NAME", help="repeatable: matches any")
    group.add_argument(
        "--after", metavar="TIME",
        help="captured at or after this time, such as 2026-11-16T09:30:00Z",
    )  # fmt: skip
    group.add_argument("--before", metavar="TIME", help="captured at or before this time")
    group.add_argument("--tag", action="append", metavar="TAG", help="repeatable: matches all")
    group.add_argument(
        "--not-within", type=float, metavar="SECONDS",
        help="for loop closure: exclude frames of the query's session that were captured within "
        "this time of it",
    )  # fmt: skip
    group.add_argument(
        "--region", type=_box, metavar="X0,Y0,Z0,X1,Y1,Z1",
        help="box that contains the pose, in metres (write --region=-1,... if the first number is "
        "negative)",
    )  # fmt: skip
    group.add_argument(
        "--region-frame", metavar="NAME", help="parent frame of the box and of the poses"
    )
    group.add_argument(
        "--exclude", action="append", metavar="FRAME", help="exclude this frame; repeatable"
    )


def filter_of(options: argparse.Namespace) -> dict[str, Any] | None:
    """Return the filter options as a JSON object; None if none is set.

    Raise InvalidRequest if only one of --region and --region-frame is present.
    """
    region = None
    if (options.region is None) != (options.region_frame is None):
        raise InvalidRequest(
            "A box requires a parent frame. Specify --region and --region-frame together."
        )
    if options.region is not None:
        least, most = options.region
        region = {"parent_frame": options.region_frame, "min": least, "max": most}
    fields = {
        "robot": options.robot, "session": options.session, "captured_after": options.after,
        "captured_before": options.before, "tags": options.tag, "not_within_s": options.not_within,
        "region": region, "exclude_frames": options.exclude,
    }  # fmt: skip
    return {name: value for name, value in fields.items() if value is not None} or None


# Types of options.


def numbers_of(text: str, count: int, what: str) -> list[float]:
    """Parse comma-separated numbers; `what` describes the expected text in the error."""
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != count:
        raise argparse.ArgumentTypeError(f"{text!r} is not {what}")
    return numbers


def _box(text: str) -> tuple[dict[str, float], ...]:
    numbers = numbers_of(text, 6, "six comma-separated numbers")
    return tuple(dict(zip("xyz", numbers[i : i + 3], strict=True)) for i in (0, 3))


def base_of(text: str) -> GivenBase:
    """Parse the mounting pose of a sensor, T_base_sensor, from seven numbers."""
    what = "seven comma-separated numbers: metres and a unit quaternion"
    numbers = numbers_of(text, 7, what)
    translation, rotation = zip("xyz", numbers, strict=False), zip("xyzw", numbers[3:], strict=True)
    try:
        return GivenBase.model_validate(
            {"translation": dict(translation), "rotation": dict(rotation)}
        )
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is not {what}") from error


def mounting_of(options: argparse.Namespace) -> GivenBase | None:
    """Return the mounting pose in `--base` and `--base-frame`; None if `--base` is absent."""
    base: GivenBase | None = options.base
    if base is None or options.base_frame is None:
        return base
    return base.model_copy(update={"base_frame": options.base_frame})


def up_of(text: str) -> list[float]:
    """Parse three numbers; the record of the frame checks that they are a unit vector."""
    return numbers_of(text, 3, "three comma-separated numbers")


def add_up_option(command: argparse.ArgumentParser, read: Callable[[str], object] = up_of) -> None:
    """Add `--up`; `read` parses its value."""
    command.add_argument(
        "--up", type=read, metavar="X,Y,Z",
        help="unit vector that points up, in the sensor's axes, such as 0,-1,0 for a level camera "
        "(write --up=-1,0,0 if the first number is negative)",
    )  # fmt: skip


_A_PRIOR = (
    '{"pose": {"parent_frame": "room", "translation": {"x": 1, "y": 2, "z": 0}, "rotation": '
    '{"x": 0, "y": 0, "z": 0, "w": 1}}, "deviation_m": 0.3, "deviation_deg": 10}'
)


def prior_of(text: str) -> dict[str, Any]:
    """Parse a prior from JSON text or from a JSON file."""
    document = text
    if not text.lstrip().startswith("{"):
        try:
            document = Path(text).read_text()
        except (OSError, UnicodeDecodeError) as error:
            why = error.strerror if isinstance(error, OSError) else "it is not text"
            raise argparse.ArgumentTypeError(
                f"{text}: cannot be read ({why}). Pass the path of a JSON file, or JSON such as "
                f"{_A_PRIOR}"
            ) from error
    try:
        prior = json.loads(document)
    except ValueError as error:
        raise argparse.ArgumentTypeError(
            f"the prior is not JSON ({error}). Pass an object such as {_A_PRIOR}"
        ) from error
    if not isinstance(prior, dict):
        raise argparse.ArgumentTypeError(
            f"the prior is not a JSON object. Pass an object such as {_A_PRIOR}"
        )
    try:
        checked(Prior, "The prior", **prior)
    except InvalidRequest as error:
        raise argparse.ArgumentTypeError(f"{error} An example: {_A_PRIOR}") from error
    return prior


def add_signing_options(command: argparse._ActionsContainer) -> None:
    """Add `--priority` and `--if-novel` for uploaded frames."""
    from sceneprint_client.api.base import NOVEL

    command.add_argument(
        "--priority", type=_priority, default=0, metavar="N",
        help="-10 to 10; frames with a higher priority are signed first (default: 0)",
    )  # fmt: skip
    command.add_argument(
        "--if-novel", nargs="?", type=_share, const=True, metavar="D",
        help="store a frame only if its place is new to the map: the distance from the nearest "
        "frame exceeds D, a share of the distance between unrelated frames (without a value: "
        f"{NOVEL:g})",
    )  # fmt: skip


def _priority(text: str) -> int:
    if text.removeprefix("-") not in {str(number) for number in range(MOST_PRIORITY + 1)}:
        raise argparse.ArgumentTypeError(f"{text!r} is not an integer from -10 to 10")
    return int(text)


def _share(text: str) -> float:
    try:
        share = novelty_of(text)
    except InvalidRequest:
        share = None
    if share is None:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0 and up to 1")
    return share


# Data folders.


def add_data_option(command: argparse.ArgumentParser) -> None:
    """Add `--data`."""
    command.add_argument(
        "--data", type=Path, metavar="DIR",
        help="data folder with database and blobs (default: the user's data folder)",
    )  # fmt: skip


def settings_of(options: argparse.Namespace) -> Settings:
    """Return the settings of the environment, overridden by the options.

    Raise InvalidRequest if a value is not valid, or a name is misspelt.
    """
    from pydantic import ValidationError

    from sceneprint.settings import Settings

    names = {"data": "data_dir", "host": "host", "port": "port", "workers": "workers"}
    fields = {
        field: getattr(options, name)
        for name, field in names.items()
        if getattr(options, name, None) is not None
    }
    try:
        return Settings(**fields)
    except ValidationError as error:
        first = error.errors()[0]
        if not first["loc"]:  # the error concerns several settings
            raise InvalidRequest(str(first["ctx"]["error"])) from error
        name = str(first["loc"][0])
        # Do not print URLs, which may contain a password.
        secret = name.endswith("_url")
        value = "not usable" if secret else f"{first['input']!r:.60}"
        raise InvalidRequest(
            f"The setting {name} is {value}: {first['msg']}. Correct the option or "
            f"SCENEPRINT_{name.upper()}."
        ) from (None if secret else error)


def existing_store(options: argparse.Namespace) -> Settings:
    """Return the settings of an existing store, so that a mistyped --data does not create a store.

    Raise UnusableStore if the data folder has no database.
    """
    settings = settings_of(options)
    if settings.database_url is None and not (settings.data_dir / "sceneprint.db").is_file():
        raise UnusableStore(
            f"{settings.data_dir}: there is no database here. Specify the data folder with --data."
        )
    return settings


def open_command_store(settings: Settings) -> AbstractContextManager[Store]:
    """Open the store of the settings; create it, or migrate its schema, if necessary."""
    from sceneprint.store import open_store

    return closing(open_store(settings.database, settings.blobs))


def add_service_options(command: argparse.ArgumentParser) -> None:
    """Add `--url` and `--key`."""
    command.add_argument(
        "--url", default=os.environ.get("SCENEPRINT_URL") or None,
        help=f"address of the service (default: SCENEPRINT_URL, or {DEFAULT_URL})",
    )  # fmt: skip
    command.add_argument(
        "--key", default=os.environ.get("SCENEPRINT_KEY") or None,
        help="API key, if the service requires one (default: SCENEPRINT_KEY)",
    )  # fmt: skip


def open_client(options: argparse.Namespace) -> Client:
    """Return a client of the service in the options; raise Unreachable if `--url` is not valid."""
    from sceneprint_client import Client

    return Client(options.url or DEFAULT_URL, options.key)


def add_seed_option(command: argparse.ArgumentParser) -> None:
    """Add `--seed`, the seed for the random choices of a validation."""
    command.add_argument(
        "--seed", type=whole_number, default=0, metavar="S", help="random seed (default: 0)"
    )


def add_query_options(command: argparse.ArgumentParser) -> None:
    """Add `--k` and the other options of a query, with the filter."""
    command.add_argument(
        "--k", type=positive, default=5, metavar="K",
        help="maximum number of accepted matches to list; the pose does not depend on it "
        "(default: 5)",
    )  # fmt: skip
    command.add_argument("--exact", action="store_true", help="compare every frame of the map")
    add_seed_option(command)
    command.add_argument(
        "--candidates", type=positive, metavar="N",
        help="number of ranked frames to select and validate (default: 10, or K if larger)",
    )  # fmt: skip
    for option, text in (
        ("--diversity", "set a parameter of the selection, sigma or omega; repeatable"),
        ("--validation", "set a validation option, such as mode=paper or residual_m=0.05; "
                         "repeatable"),
    ):  # fmt: skip
        command.add_argument(
            option, type=_assignment, action="append", metavar="NAME=VALUE", help=text
        )
    command.add_argument(
        "--confidence", type=float, default=0.99, metavar="P",
        help="minimum probability of a found pose, 0.5 to 0.999 (default: 0.99)",
    )  # fmt: skip
    command.add_argument(
        "--deadline-ms", type=positive, metavar="MS",
        help="skip candidates whose validation would end after this time",
    )  # fmt: skip
    command.add_argument(
        "--explain", action="store_true", help="explain at which stage each frame was dropped"
    )
    command.add_argument(
        "--explain-frame", metavar="FRAME",
        help="explain at which stage this frame of the map was dropped",
    )  # fmt: skip
    command.add_argument(
        "--no-keep", action="store_true", help="do not store the answer for `GET /v1/queries/ID`"
    )
    command.add_argument(
        "--prior", type=prior_of, metavar="FILE|JSON",
        help="expected pose, as JSON or the path of a JSON file: `pose` (with `parent_frame`) and "
        "`covariance` (36 numbers) or `deviation_m` and `deviation_deg` (default: 0.3 m, 10 deg)",
    )  # fmt: skip
    add_up_option(command)
    add_filter_options(command)


def query_fields(options: argparse.Namespace) -> dict[str, Any]:
    """Return the query options as arguments of `Client.query`."""
    names = (
        "k", "exact", "seed", "candidates", "confidence", "deadline_ms", "explain",
        "explain_frame", "prior",
    )  # fmt: skip
    return {
        **{name: getattr(options, name) for name in names},
        "diversity": None if options.diversity is None else dict(options.diversity),
        "validation": None if options.validation is None else dict(options.validation),
        "keep": not options.no_keep,
        "filter": filter_of(options),
    }


def _assignment(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not equals or not name:
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=VALUE")
    return name, value


# Signals that end a command like Ctrl-C, so that it removes its temporary files.

_ENDING = (signal.SIGTERM, signal.SIGHUP)


@contextmanager
def ended_by_signals() -> Iterator[None]:
    """Raise KeyboardInterrupt for the first SIGTERM or SIGHUP, in the main thread only. Further
    signals are ignored: `make` and a closed terminal send several, which would interrupt the
    cleanup.
    """

    def end(_number: int, _frame: FrameType | None) -> None:
        for number in caught:
            signal.signal(number, signal.SIG_IGN)
        raise KeyboardInterrupt

    # Do not handle a SIGHUP that `nohup` ignores.
    caught = [number for number in _ENDING if signal.getsignal(number) is signal.SIG_DFL]
    for number in caught:
        signal.signal(number, end)
    try:
        yield
    finally:
        for number in caught:
            signal.signal(number, signal.SIG_DFL)
