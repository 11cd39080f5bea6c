"""`sceneprint audit`: who changed what, whether the log is whole, and a copy of it elsewhere."""

from __future__ import annotations

import argparse
import os
import socket
import sys
from collections.abc import Iterable, Iterator
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from sceneprint.cli import duration, whole_number
from sceneprint.cli.options import one_line, require_database
from sceneprint.cli.serve import add_data_option, settings_of

if TYPE_CHECKING:
    from sceneprint.engine import Engine
    from sceneprint_client.api.admin import Audited

#: Facility `log audit`, severity `notice`, as RFC 5424 numbers them.
_PRIORITY = 13 * 8 + 5
_PORT = 514
#: Seconds that a log server may take to answer.
_TIMEOUT_S = 10.0
#: Most lines that differ which `verify` names.
_MOST_NAMED = 10


def add_audit(commands: Any) -> None:
    """Describe the command to the parser."""
    command = commands.add_parser(
        "audit",
        help="print, verify and export the audit log",
        description="Print the audit log, newest entry first: who changed what, from which "
        "address, and who was refused. Frame uploads are not logged here; see the frames "
        "themselves. `verify` checks that no entry was changed or removed: each has a hash over "
        "the one before it. Exit code 1: one was.",
    )
    command.add_argument(
        "what", nargs="?", choices=("verify",), help="check the hashes instead of printing entries"
    )
    command.add_argument(
        "--against",
        metavar="FILE",
        type=Path,
        help="with verify: compare with an exported file too, which finds a log that was "
        "rewritten with all its hashes",
    )
    command.add_argument(
        "--export",
        metavar="TARGET",
        help="append the entries that FILE does not have yet to it, as JSON lines; or send all "
        "to syslog://HOST[:PORT] (UDP) or syslog+tcp://HOST[:PORT], as RFC 5424",
    )
    command.add_argument(
        "--since",
        type=duration,
        metavar="DURATION",
        help="with --export: only entries of the last 12h, 30d or 8w",
    )
    command.add_argument(
        "--actor",
        metavar="NAME",
        help="only entries of this key, or `command` for the command line",
    )
    command.add_argument("--map", metavar="MAP", help="only entries about this map")
    command.add_argument(
        "--limit",
        type=whole_number,
        default=100,
        metavar="N",
        help="maximum number of entries to print (default: 100)",
    )
    command.add_argument("--json", action="store_true", help="print one JSON object per line")
    add_data_option(command)
    command.set_defaults(run=run_audit)


def run_audit(options: argparse.Namespace) -> int:
    """Print the entries, verify them, or export them."""
    from sceneprint.engine import Engine

    _check_options(options)
    settings = settings_of(options)
    require_database(settings)
    with Engine(settings) as engine:
        if options.what == "verify":
            return _verify(engine, options.against)
        if options.export is not None:
            return _export(engine, options)
        cursor, left = None, options.limit
        while left > 0:
            page = engine.audit.page(cursor, min(left, 1000), options.actor, options.map)
            for one in page.items:
                print(one.model_dump_json() if options.json else _audit_line(one))
            cursor, left = page.next_cursor, left - len(page.items)
            if cursor is None:
                break
    return 0


def _check_options(options: argparse.Namespace) -> None:
    """InvalidRequest where an option would be ignored."""
    from sceneprint.errors import InvalidRequest

    if options.what == "verify" and options.export is not None:
        raise InvalidRequest("`verify` checks and --export copies. Run one after the other.")
    if options.against is not None and options.what != "verify":
        raise InvalidRequest("--against applies to a check only. Use it with `audit verify`.")
    if options.since is not None and options.export is None:
        raise InvalidRequest("--since applies to an export only. Use it with --export.")


def _audit_line(one: Audited) -> str:
    who = "no key" if one.actor is None else one.actor
    whence = "" if one.address is None else f" from {one.address}"
    what = " ".join(part for part in (one.action, one.map, one.target) if part)
    refused = " refused" if one.refused else ""
    return one_line(f"{one.at:%Y-%m-%dT%H:%M:%SZ}  {who}{whence}{refused}  {what}")


def _verify(engine: Engine, copy: Path | None) -> int:
    """Check all chains, and a copy against them; returns 1 where something does not fit."""
    found = engine.audit.verify()
    for one in found.broken:
        chain = f"{'refusals' if one.refused else 'changes'} of {one.tenant or 'no key'}"
        place = "" if one.sequence is None else f" {one.sequence}"
        number = "" if one.number is None else f" (line {one.number})"
        print(one_line(f"entry{place} of the {chain}{number}: {one.why}"))
    differing = 0
    if copy is not None:
        for line, why in engine.audit.differences(_read_copy(copy)):
            differing += 1
            if differing <= _MOST_NAMED:
                print(one_line(f"{copy}: {_audit_line(line)}: {why}"))
    if found.broken or differing:
        print("the audit log was changed; compare it with an exported copy", file=sys.stderr)
        return 1
    chains = f"{found.chains} chain{'s' * (found.chains != 1)}"
    print(f"no change found in {_entries(found.lines)} of {chains}; head {found.head}")
    if found.unchained:
        print(f"without a hash, from before version 0.3: {_entries(found.unchained)}")
    return 0


def _export(engine: Engine, options: argparse.Namespace) -> int:
    since = None
    if options.since is not None:
        since = (datetime.now(UTC) - options.since).timestamp()
    lines = (
        one
        for one in engine.audit.lines(since)
        if options.actor in (None, one.actor) and options.map in (None, one.map)
    )
    scheme = options.export.partition("://")[0]
    if scheme in ("syslog", "syslog+tcp"):
        count = _send(options.export, lines)
    else:
        count = _append(Path(options.export), lines)
    print(f"{_entries(count)} exported to {options.export}")
    return 0


def _entries(count: int) -> str:
    return f"{count} entr{'y' if count == 1 else 'ies'}"


def _read_copy(path: Path) -> Iterator[Audited]:
    from pydantic import ValidationError

    from sceneprint.errors import InvalidRequest
    from sceneprint_client.api.admin import Audited

    with path.open(encoding="utf-8") as file:
        for number, text in enumerate(file, 1):
            try:
                yield Audited.model_validate_json(text)
            except ValidationError:
                raise InvalidRequest(
                    f"{path}, line {number}: it is not an exported audit entry. Name a file that "
                    "`sceneprint audit --export` wrote."
                ) from None


def _append(path: Path, lines: Iterable[Audited]) -> int:
    """Write those lines that a file does not have yet, durably; returns how many."""
    last: dict[tuple[str | None, bool], int] = {}
    unchained: set[str] = set()
    if path.exists():
        _cut_unfinished(path)
        for one in _read_copy(path):
            if one.sequence is None:
                unchained.add(one.model_dump_json())
            else:
                last[one.tenant, one.refused] = one.sequence
    count = 0
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
    with os.fdopen(descriptor, "a", encoding="utf-8") as file:
        for one in lines:
            if one.sequence is None:
                known = one.model_dump_json() in unchained
            else:
                known = one.sequence <= last.get((one.tenant, one.refused), 0)
            if not known:
                file.write(f"{one.model_dump_json()}\n")
                count += 1
        file.flush()
        os.fsync(file.fileno())
    return count


def _cut_unfinished(path: Path) -> None:
    """Remove the end of a line that was being written when its writer died."""
    with path.open("rb+") as file:
        size = file.seek(0, os.SEEK_END)
        while size > 0:
            start = max(size - 65536, 0)
            file.seek(start)
            end = file.read(size - start).rfind(b"\n")
            if end >= 0:
                size = start + end + 1
                break
            size = start
        file.truncate(size)


def _send(url: str, lines: Iterable[Audited]) -> int:
    """Send lines to a log server, each as a message of RFC 5424; returns how many.

    Over TCP each has its length before it (RFC 6587); over UDP nobody learns what was lost.
    """
    from sceneprint.errors import InvalidRequest

    asked = urlsplit(url)
    try:
        address = (asked.hostname, asked.port or _PORT)
    except ValueError:
        address = (None, _PORT)
    if address[0] is None:
        raise InvalidRequest(f"{url!r:.80} names no host. Use syslog://HOST or syslog+tcp://HOST.")
    count, stream = 0, asked.scheme == "syslog+tcp"
    try:
        if stream:
            connection = socket.create_connection(address, _TIMEOUT_S)
        else:
            family, kind, _, _, found = socket.getaddrinfo(*address, type=socket.SOCK_DGRAM)[0]
            connection = socket.socket(family, kind)
            connection.connect(found)
        with closing(connection):
            for one in lines:
                said = _message(one)
                connection.sendall(b"%d %b" % (len(said), said) if stream else said)
                count += 1
    except OSError as error:
        raise InvalidRequest(
            f"{url:.80}: {error.strerror or error} after {_entries(count)}. Check host and port of "
            "the log server, and export again."
        ) from error
    return count


def _message(one: Audited) -> bytes:
    time = one.at.astimezone(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
    host = socket.gethostname() or "-"
    return f"<{_PRIORITY}>1 {time} {host} sceneprint - audit - {one.model_dump_json()}".encode()
