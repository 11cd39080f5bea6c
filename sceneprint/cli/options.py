"""Options that many commands share: how they ask a map, and with which model they sign."""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
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
    from sceneprint_client import Client
    from sceneprint_client.api import Answer
    from sceneprint_client.api.admin import Stats

# Which frames of a map a command asks among.


def add_filter_options(command: argparse.ArgumentParser) -> None:
    """`--robot` and its like; all that are given must hold."""
    group = command.add_argument_group(
        "filter",
        "search only frames that match all of these; frames without the value are excluded",
    )
    group.add_argument("--robot", action="append", metavar="NAME", help="repeatable: matches any")
    group.add_argument("--session", action="append", metavar="NAME", help="repeatable: matches any")
    group.add_argument(
        "--after",
        metavar="TIME",
        help="captured at or after this time, such as 2026-11-16T09:30:00Z",
    )
    group.add_argument("--before", metavar="TIME", help="captured at or before this time")
    group.add_argument("--tag", action="append", metavar="TAG", help="repeatable: matches all")
    group.add_argument(
        "--not-within",
        type=float,
        metavar="SECONDS",
        help="for loop closure: exclude frames of the query's session within this time of it",
    )
    group.add_argument(
        "--region",
        type=_box,
        metavar="X0,Y0,Z0,X1,Y1,Z1",
        help=(
            "box that contains the pose, in metres (write --region=-1,... if it starts with a "
            "minus)"
        ),
    )
    group.add_argument(
        "--region-frame", metavar="NAME", help="parent frame of the box and of the poses"
    )
    group.add_argument(
        "--exclude", action="append", metavar="FRAME", help="exclude this frame; repeatable"
    )


def filter_of(options: argparse.Namespace) -> dict[str, Any] | None:
    """The filter that the options describe, as JSON has it; None where there is none.

    Raises
    ------
    InvalidRequest : one of --region and --region-frame without the other.
    """
    region = None
    if (options.region is None) != (options.region_frame is None):
        raise InvalidRequest(
            "A box needs a parent frame. Give --region and --region-frame together."
        )
    if options.region is not None:
        least, most = options.region
        region = {"parent_frame": options.region_frame, "min": least, "max": most}
    given = {
        "robot": options.robot,
        "session": options.session,
        "captured_after": options.after,
        "captured_before": options.before,
        "tags": options.tag,
        "not_within_s": options.not_within,
        "region": region,
        "exclude_frames": options.exclude,
    }
    return {name: value for name, value in given.items() if value is not None} or None


def _box(text: str) -> tuple[dict[str, float], dict[str, float]]:
    """Two corners."""
    try:
        numbers = [float(one) for one in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 6:
        raise argparse.ArgumentTypeError(f"{text!r} is not six comma-separated numbers")
    x, y, z = zip(numbers[:3], numbers[3:], strict=True)
    return {"x": x[0], "y": y[0], "z": z[0]}, {"x": x[1], "y": y[1], "z": z[1]}


# What options of `sceneprint upload` say, read from text.


def base_of(text: str) -> GivenBase:
    """Seven numbers."""
    try:
        tx, ty, tz, qx, qy, qz, qw = (float(part) for part in text.split(","))
        return GivenBase.model_validate(
            {
                "translation": {"x": tx, "y": ty, "z": tz},
                "rotation": {"x": qx, "y": qy, "z": qz, "w": qw},
            }
        )
    except ValueError as error:  # pydantic's too
        raise argparse.ArgumentTypeError(
            f"{text!r} is not seven comma-separated numbers: metres and a unit quaternion"
        ) from error


def up_of(text: str) -> list[float]:
    """Three numbers; whether they are of length 1, the frame's record sees."""
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError as error:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not three comma-separated numbers"
        ) from error
    return [x, y, z]


def add_up_option(command: argparse.ArgumentParser, read: Callable[[str], object] = up_of) -> None:
    """`--up`, which `read` takes from its text."""
    command.add_argument(
        "--up",
        type=read,
        metavar="X,Y,Z",
        help="up in the sensor's axes, a unit vector, as 0,-1,0 for a camera held level (write "
        "--up=-1,0,0 if it starts with a minus)",
    )


_A_PRIOR = (
    '{"pose": {"parent_frame": "room", "translation": {"x": 1, "y": 2, "z": 0}, "rotation": '
    '{"x": 0, "y": 0, "z": 0, "w": 1}}, "deviation_m": 0.3, "deviation_deg": 10}'
)


def prior_of(text: str) -> dict[str, Any]:
    """A prior as JSON has it: the text itself, or the file that it names."""
    given = text
    if not text.lstrip().startswith("{"):
        try:
            given = Path(text).read_text()
        except (OSError, UnicodeDecodeError) as error:
            why = error.strerror if isinstance(error, OSError) else "it is not text"
            raise argparse.ArgumentTypeError(
                f"{text}: cannot be read ({why}). Give JSON, or a file of it, such as {_A_PRIOR}"
            ) from error
    try:
        prior = json.loads(given)
    except ValueError as error:
        raise argparse.ArgumentTypeError(
            f"the prior is not JSON ({error}). Give an object such as {_A_PRIOR}"
        ) from error
    if not isinstance(prior, dict):
        raise argparse.ArgumentTypeError(
            f"the prior is not a JSON object. Give one such as {_A_PRIOR}"
        )
    try:
        checked(Prior, "The prior", **prior)
    except InvalidRequest as error:
        raise argparse.ArgumentTypeError(f"{error} An example: {_A_PRIOR}") from error
    return prior


def add_prior_option(command: argparse.ArgumentParser) -> None:
    """`--prior`."""
    command.add_argument(
        "--prior",
        type=prior_of,
        metavar="FILE|JSON",
        help="what you believe of the pose: JSON, or a file of it, with `pose` (its "
        "`parent_frame` is needed) and `covariance` (36 numbers) or `deviation_m` and "
        "`deviation_deg` (default: 0.3 m, 10 deg)",
    )


def priority_of(text: str) -> int:
    """A whole number from -10 to 10."""
    if text.removeprefix("-") not in {str(number) for number in range(MOST_PRIORITY + 1)}:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from -10 to 10")
    return int(text)


def share_of(text: str) -> float:
    """A share of the distance of unrelated frames."""
    try:
        share = novelty_of(text)
    except InvalidRequest:
        share = None
    if share is None:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0, up to 1")
    return share


# Commands that work on what is there make nothing that is not.


def require_database(settings: Settings) -> None:
    """See that a data folder has a database: a mistyped --data would make a new, empty one.

    Raises
    ------
    UnusableStore : it has none.
    """
    if settings.database_url is None and not (settings.data_dir / "sceneprint.db").is_file():
        raise UnusableStore(
            f"{settings.data_dir}: there is no database here. Name the data folder with --data."
        )


# Where a command finds its service.


def add_service_options(command: argparse.ArgumentParser) -> None:
    """`--url` and `--key`."""
    command.add_argument(
        "--url",
        default=os.environ.get("SCENEPRINT_URL") or None,
        help=f"address of the service (default: SCENEPRINT_URL, or {DEFAULT_URL})",
    )
    command.add_argument(
        "--key",
        default=os.environ.get("SCENEPRINT_KEY") or None,
        help="API key, if the service requires one (default: SCENEPRINT_KEY)",
    )


def open_client(options: argparse.Namespace) -> Client:
    """A client of the service that the options name.

    Raises
    ------
    Unreachable : the address is none.
    """
    from sceneprint_client import Client

    return Client(options.url or DEFAULT_URL, options.key)


def waiting_reason(stats: Stats | None, own: int = 0) -> str:
    """Return why jobs wait, and what to do.

    Parameters
    ----------
    stats : of the whole service; None where the key may not see them
    own : jobs of the caller that wait for a worker; those of others are ahead of them
    """
    if stats is None or not stats.workers:
        return "Check that workers are running; `sceneprint work` starts some."
    busy = sum(worker.job_id is not None for worker in stats.workers)
    ahead = max(stats.waiting - own, 0)
    return (
        f"{busy} of {len(stats.workers)} worker{'s' * (len(stats.workers) > 1)} busy, {ahead} "
        f"job{'s' * (ahead != 1)} ahead."
    )


def one_line(text: str) -> str:
    """A text that may hold line breaks and escapes; a line of ours never does."""
    return text if text.isprintable() else ascii(text)[1:-1]


def percent(confidence: float) -> str:
    """A confidence for people, rounded down, so that none looks better than it is."""
    return f"{math.floor(1000 * min(confidence, 0.999)) / 10:.1f} %"


def add_seed_option(command: argparse.ArgumentParser) -> None:
    """Add --seed, of the random choices of a validation."""
    command.add_argument(
        "--seed",
        type=whole_number,
        default=0,
        metavar="S",
        help="random seed (default: 0)",
    )


def add_asking_options(command: argparse.ArgumentParser) -> None:
    """`--k` and its like, with the filter."""
    command.add_argument(
        "--k",
        type=positive,
        default=5,
        metavar="K",
        help="largest number of accepted matches to list; the pose does not depend on it "
        "(default: 5)",
    )
    command.add_argument("--exact", action="store_true", help="compare every frame of the map")
    add_seed_option(command)
    command.add_argument(
        "--candidates",
        type=positive,
        metavar="N",
        help="number of ranked frames to select and validate (default: 10, or K if larger)",
    )
    command.add_argument(
        "--diversity",
        type=setting,
        action="append",
        metavar="NAME=VALUE",
        help="set a parameter of the selection, sigma or omega; repeatable",
    )
    command.add_argument(
        "--validation",
        type=setting,
        action="append",
        metavar="NAME=VALUE",
        help="set a validation option, such as mode=paper or residual_m=0.05; repeatable",
    )
    command.add_argument(
        "--confidence",
        type=float,
        default=0.99,
        metavar="P",
        help="least probability of a pose that is found, 0.5 to 0.999 (default: 0.99)",
    )
    command.add_argument(
        "--deadline-ms",
        type=positive,
        metavar="MS",
        help="start no candidate that would finish after this time",
    )
    command.add_argument(
        "--explain", action="store_true", help="explain at which stage each frame dropped out"
    )
    command.add_argument(
        "--explain-frame",
        metavar="FRAME",
        help="explain at which stage this frame of the map dropped out",
    )
    command.add_argument(
        "--no-keep", action="store_true", help="do not store the answer for `GET /v1/queries/ID`"
    )
    add_filter_options(command)


def options_of(options: argparse.Namespace) -> dict[str, Any]:
    """How to ask, as `Client.query` takes it."""
    return {
        "k": options.k,
        "exact": options.exact,
        "seed": options.seed,
        "candidates": options.candidates,
        "diversity": settings_of(options.diversity),
        "validation": settings_of(options.validation),
        "confidence": options.confidence,
        "deadline_ms": options.deadline_ms,
        "explain": options.explain,
        "explain_frame": options.explain_frame,
        "keep": not options.no_keep,
        "filter": filter_of(options),
    }


def setting(text: str) -> tuple[str, str]:
    """A name and a value; whether there is such a name, the query knows."""
    name, equals, value = text.partition("=")
    if not equals or not name:
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=VALUE")
    return name, value


def settings_of(given: Sequence[tuple[str, str]] | None) -> dict[str, str] | None:
    """Names with their values; None where none was given."""
    return None if given is None else dict(given)


def frame_label(frame_id: str, name: str | None) -> str:
    """A frame for people: its id, and what its file was called."""
    return one_line(frame_id if name is None else f"{frame_id} ({name})")


def explained_lines(answer: Answer) -> list[str]:
    """Why the frames of the ranking came as far as they did, a line each; none if not asked."""
    lines = [
        f"  {one.rank:4}  {frame_label(one.frame_id, one.name)}  {one.similarity:4.2f}  "
        f"{one.stage}: {one.outcome.replace('_', ' ')}; {one_line(one.reason)}"
        for one in answer.explanations or []
    ]
    one = answer.explained_frame
    if one is not None:
        place = "not searched" if one.rank is None else f"rank {one.rank} of {one.of}"
        lost = "a match" if one.lost_at is None else f"lost at {one.lost_at}"
        label = frame_label(one.frame_id, one.name)
        lines.append(f"  {label}: {place}; {lost}: {one_line(one.reason)}")
    return lines


# Signals that end a command as Ctrl-C does, so that it clears away what is its own.

_ENDING = (signal.SIGTERM, signal.SIGHUP)


@contextmanager
def ended_by_signals() -> Iterator[None]:
    """Raise KeyboardInterrupt for SIGTERM and SIGHUP; in the main thread only.

    Once: `make` and a closed terminal send several, and clearing away must not be cut short.
    """

    def end(_number: int, _frame: FrameType | None) -> None:
        for number in taken:
            signal.signal(number, signal.SIG_IGN)
        raise KeyboardInterrupt

    # `nohup` has SIGHUP ignored, and means it
    taken = [one for one in _ENDING if signal.getsignal(one) is signal.SIG_DFL]
    for number in taken:
        signal.signal(number, end)
    try:
        yield
    finally:
        for number in taken:
            signal.signal(number, signal.SIG_DFL)
