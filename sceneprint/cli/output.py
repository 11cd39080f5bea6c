"""Output of commands: single lines, tables, JSON and progress bars."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from pydantic import BaseModel

    from sceneprint_client.api.admin import Stats

Row = TypeVar("Row", bound="BaseModel")


def one_line(text: str) -> str:
    """Return a text, escaped if it contains line breaks or control characters."""
    return text if text.isprintable() else ascii(text)[1:-1]


def percent(confidence: float) -> str:
    """Return a confidence as a percentage, rounded down."""
    return f"{math.floor(1000 * min(confidence, 0.999)) / 10:.1f} %"


def count_of(number: int, noun: str) -> str:
    """Return a number with its noun, such as `1 frame` or `2 frames`."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def frame_label(frame_id: str, name: str | None) -> str:
    """Return a label of a frame: its id, and the name of its file."""
    return one_line(frame_id if name is None else f"{frame_id} ({name})")


def source_label(record: Any) -> str:
    """Return a label with the robot and the session of a record."""
    return one_line(f"{record.robot or '-'}/{record.session or '-'}")


def print_rows(
    rows: Iterable[Row], line: Callable[[Row], str], *, header: str, none: str, as_json: bool
) -> None:
    """Print records as they arrive: as rows of a table, or as lines of JSON.

    Parameters
    ----------
    line : function that converts a record to a row of the table
    none : text to print instead of an empty table
    """
    empty = True
    for row in rows:
        if empty and not as_json:
            print(header)
        empty = False
        print(row.model_dump_json() if as_json else line(row).rstrip())
    if empty and not as_json:
        print(none)


def print_error(text: str) -> None:
    """Print a text on standard error."""
    print(text, file=sys.stderr)


@contextmanager
def progress_bar(
    name: str, unit: str = "frame", **options: Any
) -> Iterator[Callable[[int, int], None]]:
    """Show a progress bar on a terminal; yield a function that sets its done and total steps."""
    from tqdm import tqdm

    with tqdm(desc=name, unit=unit, disable=None, **options) as bar:

        def progress(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield progress


def waiting_reason(stats: Stats | None, own: int = 0) -> str:
    """Return a text that explains why jobs wait, and what to do.

    Parameters
    ----------
    stats : statistics of the service; None if the key cannot read them
    own : number of own waiting jobs; all others count as ahead of them
    """
    if stats is None or not stats.workers:
        return "Check that workers are running; `sceneprint work` starts some."
    busy = sum(worker.job_id is not None for worker in stats.workers)
    ahead = max(stats.waiting - own, 0)
    of = count_of(len(stats.workers), "worker")
    return f"{busy} of {of} busy, {count_of(ahead, 'job')} ahead."
