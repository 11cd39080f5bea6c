"""Commits that pgbench replays are those of the product."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from benchmarks.fleet.replayed_commits import Replay, commands_of, measure

LOG = """\
2026-11-28 10:51:10.517 UTC [3543] LOG:  statement: BEGIN; SELECT 1
2026-11-28 10:51:10.521 UTC [3543] LOG:  execute _pg3_2: UPDATE maps SET name=$10, title=$1
\tWHERE number = $2::BIGINT
2026-11-28 10:51:10.521 UTC [3543] DETAIL:  Parameters: $1 = 'it''s $2, '' and more', $2 = '4', \
$10 = NULL
2026-11-28 10:51:10.522 UTC [3543] LOG:  statement: COMMIT
2026-11-28 10:51:10.523 UTC [3543] LOG:  received SIGHUP, reloading configuration files
"""


def replay(**more: int) -> Replay:
    given = {"n_maps": 2, "n_clients": 3, "delay_ms": 0.5, "commits": 6}
    server: Any = None  # what is executed does not depend on where
    return Replay(server, Path(), **given | more)  # type: ignore[arg-type]


def test_commands_come_from_a_log_with_their_values() -> None:
    assert commands_of(LOG) == [
        "BEGIN; SELECT 1",
        "UPDATE maps SET name=NULL, title='it''s $2, '' and more'\n\tWHERE number = '4'::BIGINT",
        "COMMIT",
    ]


def test_what_is_one_message_is_one_round_trip() -> None:
    lines = replay().script(["BEGIN; SELECT 1", "UPDATE a\n SET b = 1", "COMMIT"]).splitlines()
    assert lines[3] == "\\set n :client_id + 3 * :k"
    trip = ["\\sleep 1000 us", "\\startpipeline"]
    assert lines[4:] == [
        *trip, "BEGIN;", "SELECT 1;", "\\endpipeline",
        *trip, "UPDATE a  SET b = 1;", "\\endpipeline",
        *trip, "COMMIT;", "\\endpipeline",
    ]  # fmt: skip
    lines = replay().script(["SELECT 1", "UPDATE a"]).splitlines()
    assert lines[4:] == [*trip, "SELECT 1;", "UPDATE a;", "\\endpipeline"]


@pytest.mark.thorough  # of a measurement, which says itself when it is wrong
def test_all_that_is_counted_is_written(monkeypatch: pytest.MonkeyPatch) -> None:
    uploads, ends, feed = measure(2, 3, 0.0, 12)
    assert min(uploads, ends) > 0
    assert (feed.missed, feed.disordered) == (0, 0)
    said = Replay.script
    monkeypatch.setattr(Replay, "script", lambda own, commands: said(own, commands[:-1]))
    with pytest.raises(RuntimeError, match="were to be written"):
        measure(2, 3, 0.0, 12)
