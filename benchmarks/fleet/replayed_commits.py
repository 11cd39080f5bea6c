"""Commits in a second that PostgreSQL takes where its clients have processors of their own.

`python -m benchmarks.fleet.replayed_commits [--maps N] [--clients N] [--delay-ms X] [--commits N]`:
as `commits`, but the statements of an upload and of an index commit are taken from the server's log
while the product executes them, and pgbench executes them from then on, each time for other frames
of any maps. It needs little of the processors, which our clients in a fleet have of their own. For
each round trip it waits as long as a network would take. Uploads are sent as services send them, to
which proxies route requests by their map: some together, one message after the other.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from itertools import accumulate
from math import lcm
from pathlib import Path

import psycopg
from sqlalchemy import func, select, update

from benchmarks.fleet.commits import (
    PROCESSES,
    Feed,
    Writer,
    claim,
    follow,
    in_process,
    index,
    make_maps,
    tell,
    upload,
)
from benchmarks.fleet.postgres import Server, binaries
from sceneprint.store import Database, open_database
from sceneprint.store.tables import frames, jobs, maps, signatures
from sceneprint_client.api import FrameState

#: First numbers of rows, so that each is known by its number in a statement.
FIRST = {"maps": 700_001, "frames": 2_000_001, "jobs": 5_000_001}
#: Uploads that services write together, as shares of their clients: `commits` measures that.
TOGETHER = (1 / 8, 4 / 8, 6 / 8, 1)
#: Writes before the one that is taken: until then nothing is prepared.
WARM = 12
#: A line that begins with a date ends the one before.
_END = r"\n(?=\d{4}-\d\d-\d\d )"
_COMMAND = re.compile(
    rf"LOG:  (?:statement|execute [^:]*): (.*?){_END}(?:[^\n]*DETAIL:  Parameters: (.*?){_END})?",
    re.DOTALL,
)
_NOW = "extract(epoch FROM clock_timestamp())"
_PARAMETER = re.compile(r"\$(\d+) = (NULL|'(?:[^']|'')*')")


def commands_of(log: str) -> list[str]:
    """Commands that a server has logged, with the values of their parameters."""
    found = []
    for command, parameters in _COMMAND.findall(log):
        values = dict(_PARAMETER.findall(parameters))
        found.append(re.sub(r"\$(\d+)", partial(_value, values), command))
    return found


def _value(values: dict[str, str], parameter: re.Match[str]) -> str:
    return values.get(parameter[1], parameter[0])


def record(server: Server, do: Callable[[], None]) -> list[str]:
    """The commands that something executes.

    Parameters
    ----------
    server : of whose log they are read
    do : done WARM times before, so that the connection is known to live and has prepared all
    """
    for _ in range(WARM):
        do()
    _log(server, "all")
    start = server.log.stat().st_size
    do()
    _log(server, "none")
    with server.log.open("rb") as file:
        file.seek(start)
        logged = file.read().decode()
    told = ("ALTER SYSTEM", "SELECT pg_reload_conf")
    return [one for one in commands_of(logged) if one.strip(" ;") and not one.startswith(told)]


def _log(server: Server, which: str) -> None:
    with psycopg.connect(server.url("commits").replace("+psycopg", ""), autocommit=True) as own:
        own.execute(f"ALTER SYSTEM SET log_statement = '{which}'")
        own.execute("SELECT pg_reload_conf()")
    time.sleep(0.5)


@dataclass(frozen=True)
class Replay:
    """What pgbench sends again and again; see `measure`."""

    server: Server
    folder: Path
    n_maps: int
    n_senders: int
    delay_ms: float
    commits: int

    def run(
        self, messages: Sequence[Sequence[str]], n_frames: int, *, own_maps: bool = False
    ) -> float:
        """Frames written in a second.

        Parameters
        ----------
        messages : commands of each, which are a transaction, and a round trip
        n_frames : that all messages write, each time others
        own_maps : whether each sender writes to maps of its own, as requests are routed to services
        """
        path = self.folder / "commit.sql"
        path.write_text(self.script(messages, n_frames, own_maps=own_maps))
        rounds = self.commits // self.n_senders // n_frames
        command = [
            str(binaries() / "pgbench"), "--no-vacuum", "-h", "127.0.0.1",
            "-p", str(self.server.port), "-U", "postgres", "-M", "prepared", "-D", "k=-1",
            "-c", str(self.n_senders), "-t", str(rounds), "-f", str(path), "commits",
        ]  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        said = re.search(r"failed transactions: 0 .*tps = ([\d.]+)", done.stdout, re.DOTALL)
        if said is None or done.returncode:
            raise RuntimeError(done.stderr[-2000:] + done.stdout[-500:])
        return n_frames * float(said[1])

    def script(self, messages: Sequence[Sequence[str]], n_frames: int, *, own_maps: bool) -> str:
        """What pgbench does again and again; a message is a pipeline, as the product sends it."""
        lines = ["\\set k :k + 1", f"\\set n :client_id + {self.n_senders} * :k"]
        any_ = f"random(0, {self.n_maps - 1})"
        if own_maps and self.n_maps > self.n_senders:
            any_ = f"random(0, {self.n_maps // self.n_senders - 1}) * {self.n_senders} + :client_id"
        for i in range(n_frames):
            lines += [f"\\set m{i} {any_}",
                      f"\\set r{i} random(1, 1000000000000000)"]  # fmt: skip
        for message in messages:
            lines += [f"\\sleep {round(2e3 * self.delay_ms)} us", "\\startpipeline"]
            lines += [f"{one};" for one in message] + ["\\endpipeline"]
        return "\n".join(line.replace("\n", " ") for line in lines) + "\n"


def uploads_together(commands: Sequence[str], frames_: Sequence[int]) -> list[str]:
    """Uploads that a service has written together, from the commands of one.

    Parameters
    ----------
    commands : of an upload to the first map
    frames_ : numbers of the variables that say which frames are written
    """
    [records] = {one for command in commands for one in re.findall(r"'(\[\{.*?\}\])'", command)}
    numbers = ", ".join(f"{FIRST['maps']} + :m{i}" for i in frames_)
    locks = f"(SELECT array_agg(n ORDER BY n) FROM unnest(ARRAY[{numbers}]) AS t (n))"
    made = "('[' || " + " || ',' || ".join(_record(records[1:-1], i) for i in frames_) + " || ']')"
    replaced = {f"'{records}'": made, f"'{{{FIRST['maps']}}}'": locks}
    return [_replaced(one, replaced) for one in commands]


def _replaced(command: str, replaced: dict[str, str]) -> str:
    for literal, expression in replaced.items():
        command = command.replace(literal, expression)
    return command


def _record(record: str, i: int) -> str:
    """A record of `new_frames` as an expression, of another frame each time."""
    values = {
        f'"{WARM:064x}"': f"'\"' || md5('c' || :r{i}) || md5('d' || :r{i}) || '\"'",
        str(FIRST["maps"]): f"{FIRST['maps']} + :m{i}",
        '"map-0"': f"'\"map-' || :m{i} || '\"'",
    }
    for j, one in enumerate(dict.fromkeys(re.findall(r'"[0-9a-f]{32}"', record))):
        values[one] = f"'\"' || md5('{j}' || :r{i}) || '\"'"
    for one in dict.fromkeys(re.findall(r"\b\d{10}\.\d+", record)):
        values[one] = _NOW
    text = record.replace("%", "%%").replace('"place": 0', f'"place": {i}')
    for n, literal in enumerate(values, 1):
        text = text.replace(literal, f"%{n}$s")
    return f"format('{text}', {', '.join(values.values())})"


def measure(
    n_maps: int, n_clients: int, delay_ms: float, commits: int
) -> tuple[float, float, Feed]:
    """Uploads and index commits in a second, and what a reader of the uploads' events saw; see
    `commits.measure`.
    """
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        server = Server(Path(folder) / "server", durable=True)
        server.start()
        stack.callback(server.kill)
        server.create("commits")
        database = open_database(server.url("commits"))
        stack.callback(database.close)
        _number_from(database)
        rows = make_maps(database, n_maps)
        number = iter(range(1_000_000))
        writer = Writer(database)
        uploaded = record(server, lambda: upload(writer, (rows[0], next(number))))
        indexed = record(server, lambda: index(writer, claim(database)))
        # what claimed it is not part of the commit
        begins = max(i for i, one in enumerate(indexed) if "lock_shared" in one)
        indexed = indexed[begins:]
        services = min(PROCESSES, n_clients)
        sizes = [max(1, round(one * n_clients / services)) for one in TOGETHER]
        round_ = lcm(services * sum(sizes), n_clients)
        written = commits // round_ * round_
        replay = Replay(server, Path(folder), n_maps, services, delay_ms, written)
        ends_ = accumulate(sizes)
        messages = [
            uploads_together(uploaded, range(end - size, end))
            for size, end in zip(sizes, ends_, strict=True)
        ]
        n = 2 * written + WARM + 1
        events = written + 2 * (WARM + 1)
        with in_process(follow, server.url("commits"), events) as reader:
            replay.run(messages, sum(sizes), own_maps=True)
            reader.send("over")
            feed: Feed = reader.recv()
        # the reader has a processor of its own, too
        uploads = replay.run(messages, sum(sizes), own_maps=True)
        with database.write() as connection:
            connection.execute(update(jobs).values(state="running", token=1, worker="commits"))
        last = FIRST["frames"] + WARM, FIRST["jobs"] + WARM
        first = FIRST["maps"]
        replaced = {f"'{first}'": f"({first} + :m0)", f"'{{{first}}}'": f"ARRAY[{first} + :m0]",
                    **{f"'{one}'": f"({one + 1} + :n)" for one in last}}  # fmt: skip
        indexed = [_replaced(one, replaced) for one in indexed]
        ends = replace(replay, n_senders=n_clients, commits=2 * written).run([indexed], 1)
        _require_written(database, n)
    return uploads, ends, feed


def _number_from(database: Database) -> None:
    with database.write() as connection:
        for table, first in FIRST.items():
            connection.exec_driver_sql(f"ALTER SEQUENCE {table}_number_seq RESTART WITH {first}")


def _require_written(database: Database, n: int) -> None:
    """See that all was written that was counted."""
    indexed = func.count().filter(frames.c.state == FrameState.INDEXED)
    with database.read() as connection:
        found = {
            "frames": connection.execute(select(func.count(frames.c.number))).scalar_one(),
            "indexed": connection.execute(select(indexed).select_from(frames)).scalar_one(),
            "signatures": connection.execute(
                select(func.count(signatures.c.frame_number))
            ).scalar_one(),
            "revisions": connection.execute(select(func.sum(maps.c.revision))).scalar_one(),
            "counted": connection.execute(select(func.sum(maps.c.used_frames))).scalar_one(),
        }
    if set(found.values()) != {n}:
        raise RuntimeError(f"{n} were to be written: {found}")


if __name__ == "__main__":
    sys.exit(tell(None, __doc__, 24320, measure, ", replayed"))
