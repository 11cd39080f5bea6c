"""Commits in a second that PostgreSQL takes where its clients have processors of their own.

`python -m benchmarks.fleet.replayed_commits [--maps N] [--clients N] [--delay-ms X] [--commits N]`:
as `commits`, but the statements of an upload and of an index commit are taken from the server's log
while the product executes them, and pgbench executes them from then on, each time for another frame
of any map. It needs little of the processors, which our clients in a fleet have of their own. For
each round trip it waits as long as a network would take.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import psycopg
from sqlalchemy import func, select, update

from benchmarks.fleet.commits import (
    Feed,
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
    """Commands that pgbench executes again and again; see `measure`."""

    server: Server
    folder: Path
    n_maps: int
    n_clients: int
    delay_ms: float
    commits: int

    def run(self, commands: Sequence[str], replaced: dict[str, str]) -> float:
        """Transactions in a second, each of another frame.

        Parameters
        ----------
        commands : of one transaction
        replaced : by literals, what is put in their place
        """
        for literal, expression in replaced.items():
            commands = [one.replace(literal, expression) for one in commands]
        path = self.folder / "commit.sql"
        path.write_text(self.script(commands))
        command = [
            str(binaries() / "pgbench"), "--no-vacuum", "-h", "127.0.0.1",
            "-p", str(self.server.port), "-U", "postgres", "-M", "prepared",
            "-c", str(self.n_clients), "-t", str(self.commits // self.n_clients),
            "-D", "k=-1", "-D", f"maps={self.n_maps}", "-f", str(path), "commits",
        ]  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        said = re.search(r"failed transactions: 0 .*tps = ([\d.]+)", done.stdout, re.DOTALL)
        if said is None or done.returncode:
            raise RuntimeError(done.stderr[-2000:] + done.stdout[-500:])
        return float(said[1])

    def script(self, commands: Sequence[str]) -> str:
        """What pgbench does for a transaction: commands that begin none are one pipeline, as the
        product sends them; of others each is a round trip, however many statements it has.
        """
        if commands[0].startswith("BEGIN"):
            trips = [[f"{part};" for part in one.split("; ")] for one in commands]
        else:
            trips = [[f"{one};" for one in commands]]
        lines = [
            "\\set m random(0, :maps - 1)", "\\set r random(1, 1000000000000000)",
            "\\set k :k + 1", f"\\set n :client_id + {self.n_clients} * :k",
        ]  # fmt: skip
        for trip in trips:
            lines += [f"\\sleep {round(2e3 * self.delay_ms)} us"]
            lines += ["\\startpipeline", *trip, "\\endpipeline"]
        return "\n".join(line.replace("\n", " ") for line in lines) + "\n"


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
        uploaded = record(server, lambda: upload(database, (rows[0], next(number))))
        indexed = record(server, lambda: index(database, claim(database)))
        # what claimed it is not part of the commit
        begins = max(i for i, one in enumerate(indexed) if "advisory" in one)
        begins -= indexed[begins - 1].startswith("BEGIN")
        indexed = indexed[begins:]
        content, map_, map_name = f"'{WARM:064x}'", f"'{FIRST['maps']}'", "'map-0'"
        ids = dict.fromkeys(re.findall(r"'[0-9a-f]{32}'", " ".join(uploaded)))
        times = dict.fromkeys(re.findall(r"'\d{10}\.\d+'", " ".join(uploaded)), _NOW)
        replaced = {
            content: "(md5('c' || :r) || md5('d' || :r))",
            map_: f"({FIRST['maps']} + :m)", map_name: "('map-' || :m)",
            **{one: f"md5('{i}' || :r)" for i, one in enumerate(ids)}, **times,
        }  # fmt: skip
        replay = Replay(server, Path(folder), n_maps, n_clients, delay_ms, commits)
        written = commits // n_clients * n_clients + WARM + 1
        with in_process(follow, server.url("commits"), written + WARM + 1) as reader:
            uploads = replay.run(uploaded, replaced)
            reader.send("over")
            feed: Feed = reader.recv()
        with database.write() as connection:
            connection.execute(update(jobs).values(state="running", token=1, worker="commits"))
        last = FIRST["frames"] + WARM, FIRST["jobs"] + WARM
        taken = {f"'{one}'": f"({one + 1} + :n)" for one in last}
        ends = replay.run(indexed, {map_: replaced[map_], **taken})
        _require_written(database, written)
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
    sys.exit(tell(None, __doc__, 6400, measure, ", replayed"))
