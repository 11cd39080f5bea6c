"""Queries in their turn, each with its count and its record.

AskedQuery, what answers it  --run_query-->  Answer
"""

from __future__ import annotations

import time
from collections.abc import Callable

from sceneprint.engine.results.query_history import AskedQuery, record_of
from sceneprint.errors import NotFound
from sceneprint_client.api import Answer
from service.context import Context


async def run_query(
    here: Context, asked: AskedQuery, since: float, do: Callable[[], Answer]
) -> Answer:
    """Answer a query when it is its turn, and leave a record of it, unless it wants none.

    Parameters
    ----------
    here : of the service; the query has a place at its gate
    asked : the query, and who asks
    since : when the request came, by `time.perf_counter`
    do : answers it, in a thread

    Raises
    ------
    Busy : see `Gate.run`; and what `do` raises.
    """
    try:
        answer = await here.gate.run(do)
    except NotFound:  # what was asked for is not there: no query was begun
        raise
    except Exception as error:
        _note(here, asked, error, since)
        raise
    if asked.query.record:
        here.metrics.answer(answer)
    _note(here, asked, answer, since)
    return answer


def _note(here: Context, asked: AskedQuery, came_of_it: Answer | Exception, since: float) -> None:
    if asked.query.record:
        here.engine.history.note(record_of(asked, came_of_it, time.perf_counter() - since))
