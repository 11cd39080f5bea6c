"""Commits that pgbench replays are those of the product."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from benchmarks.fleet.replayed_commits import WARM, Replay, commands_of, measure, uploads_together

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
    given = {"n_maps": 6, "n_senders": 3, "delay_ms": 0.5, "commits": 6}
    server: Any = None  # what is executed does not depend on where
    return Replay(server, Path(), **given | more)  # type: ignore[arg-type]


def test_commands_come_from_a_log_with_their_values() -> None:
    assert commands_of(LOG) == [
        "BEGIN; SELECT 1",
        "UPDATE maps SET name=NULL, title='it''s $2, '' and more'\n\tWHERE number = '4'::BIGINT",
        "COMMIT",
    ]


def test_a_message_is_one_round_trip() -> None:
    messages = [["SELECT 1", "UPDATE a\n SET b = :m0"], ["UPDATE c"]]
    lines = replay().script(messages, 2, own_maps=False).splitlines()
    trip = ["\\sleep 1000 us", "\\startpipeline"]
    assert lines == [
        "\\set k :k + 1", "\\set n :client_id + 3 * :k",
        "\\set m0 random(0, 5)", "\\set r0 random(1, 1000000000000000)",
        "\\set m1 random(0, 5)", "\\set r1 random(1, 1000000000000000)",
        *trip, "SELECT 1;", "UPDATE a  SET b = :m0;", "\\endpipeline",
        *trip, "UPDATE c;", "\\endpipeline",
    ]  # fmt: skip
    of_own = [replay(n_maps=n).script([["x"]], 1, own_maps=True).splitlines()[2] for n in (6, 3, 1)]
    assert of_own == [
        "\\set m0 random(0, 1) * 3 + :client_id", "\\set m0 random(0, 2)", "\\set m0 random(0, 0)"
    ]  # fmt: skip


def test_uploads_are_put_together_as_one_statement() -> None:
    content, frame, job = f"{WARM:064x}", "ab" * 16, "cd" * 16
    record = (
        f'{{"frame_content_id": "{content}", "frame_id": "{frame}", "job_id": "{job}", '
        f'"map": 700001, "name": "map-0", "at": 1795887901.5, "share": "5%", "place": 0}}'
    )
    lock, insert = uploads_together(
        ["SELECT lock('{700001}')", f"INSERT json_to_recordset('[{record}]'::JSON)"], [3, 4]
    )
    numbers = "ARRAY[700001 + :m3, 700001 + :m4]"
    assert lock == f"SELECT lock((SELECT array_agg(n ORDER BY n) FROM unnest({numbers}) AS t (n)))"
    text = (
        """'{"frame_content_id": %1$s, "frame_id": %4$s, "job_id": %5$s, "map": %2$s, """
        """"name": %3$s, "at": %6$s, "share": "5%%", "place": NUMBER}'"""
    )
    assert insert.startswith("INSERT json_to_recordset(('[' || format(")
    assert insert.endswith(" || ']')::JSON)")
    first, second = insert.removeprefix("INSERT json_to_recordset(('[' || ").split(" || ',' || ")
    for i, made in ((3, first), (4, second.removesuffix(" || ']')::JSON)"))):
        assert made == (
            f"format({text.replace('NUMBER', str(i))}, "
            f"""'"' || md5('c' || :r{i}) || md5('d' || :r{i}) || '"', 700001 + :m{i}, """
            f"""'"map-' || :m{i} || '"', '"' || md5('0' || :r{i}) || '"', """
            f"""'"' || md5('1' || :r{i}) || '"', extract(epoch FROM clock_timestamp()))"""
        )


@pytest.mark.thorough  # of a measurement, which says itself when it is wrong
def test_all_that_is_counted_is_written(monkeypatch: pytest.MonkeyPatch) -> None:
    uploads, ends, feed = measure(2, 3, 0.0, 12)
    assert min(uploads, ends) > 0
    assert (feed.missed, feed.disordered) == (0, 0)
    said = Replay.script

    def without_last(own: Replay, messages: Any, n: int, **how: bool) -> str:
        return said(own, [one[:-1] for one in messages], n, **how)

    monkeypatch.setattr(Replay, "script", without_last)
    with pytest.raises(RuntimeError, match="were to be written"):
        measure(2, 3, 0.0, 12)
