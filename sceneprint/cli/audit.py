"""`sceneprint audit`: who changed what, whether the log is whole, and a copy of it elsewhere."""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import socket
import sys
from bisect import bisect_right
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
    from sceneprint.store.blobs.object_client import Objects
    from sceneprint_client.api.admin import Audited

#: Facility `log audit`, severity `notice`, as RFC 5424 numbers them.
_PRIORITY = 13 * 8 + 5
_PORT = 514
#: Seconds that a log server may take to answer.
_TIMEOUT_S = 10.0
#: Most lines of an object.
_OBJECT_LINES = 1000
#: Objects by their names: a hash of the tenant and which chain, first and last place in it.
_OBJECT = re.compile(r"audit/([0-9a-f]{32})-(changes|refusals)/(\d{12})-(\d{12})\.jsonl")
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
        metavar="COPY",
        help="with verify: compare with an exported file or object store too, which finds a log "
        "that was rewritten with all its hashes",
    )
    command.add_argument(
        "--export",
        metavar="TARGET",
        help="append the entries that FILE does not have yet to it, as JSON lines; or put those "
        "that an object store does not have yet into new objects (s3://BUCKET/PREFIX, gs://..., "
        "az://...); or send all to syslog://HOST[:PORT] (UDP) or syslog+tcp://HOST[:PORT], as RFC "
        "5424",
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
    if options.export is not None and _is_object_store(options.export):
        for name in ("since", "actor", "map"):
            if getattr(options, name) is not None:
                raise InvalidRequest(
                    f"--{name} would leave gaps in the chains of an object store. Export all."
                )


def _audit_line(one: Audited) -> str:
    who = "no key" if one.actor is None else one.actor
    whence = "" if one.address is None else f" from {one.address}"
    what = " ".join(part for part in (one.action, one.map, one.target) if part)
    refused = " refused" if one.refused else ""
    return one_line(f"{one.at:%Y-%m-%dT%H:%M:%SZ}  {who}{whence}{refused}  {what}")


def _verify(engine: Engine, copy: str | None) -> int:
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
    elif _is_object_store(options.export):
        count = _put(_open_objects(options.export), lines)
    else:
        count = _append(Path(options.export), lines)
    print(f"{_entries(count)} exported to {options.export}")
    return 0


def _entries(count: int) -> str:
    return f"{count} entr{'y' if count == 1 else 'ies'}"


def _read_copy(copy: str | Path) -> Iterator[Audited]:
    """Entries of an exported file, or of an object store."""
    if isinstance(copy, str) and _is_object_store(copy):
        yield from _read_objects(_open_objects(copy))
        return
    with Path(copy).open(encoding="utf-8") as file:
        yield from _entries_of(str(copy), file)


def _entries_of(place: str, texts: Iterable[str]) -> Iterator[Audited]:
    from pydantic import ValidationError

    from sceneprint.errors import InvalidRequest
    from sceneprint_client.api.admin import Audited

    for number, text in enumerate(texts, 1):
        try:
            yield Audited.model_validate_json(text)
        except ValidationError:
            raise InvalidRequest(
                f"{place}, line {number}: it is not an exported audit entry. Name what "
                "`sceneprint audit --export` wrote."
            ) from None


def _is_object_store(target: str) -> bool:
    from sceneprint.store.blobs.object_client import VARIABLES

    scheme, found, _ = target.partition("://")
    return bool(found) and scheme.lower() in VARIABLES


def _open_objects(url: str) -> Objects:
    from sceneprint.store.blobs.object_client import open_objects

    return open_objects(url, "--export")


def _put(objects: Objects, lines: Iterable[Audited]) -> int:
    """Put those entries that an object store does not have yet into new objects; returns how many.

    An object holds successive entries of one chain and is named after them. It is put in one step
    and never changed, so an export that was killed goes on with the first entry that is missing.
    """
    there: dict[str, list[tuple[int, int]]] = {}
    for chain, first, last, _ in _objects(objects):  # each with the greatest end up to it
        ranges = there.setdefault(chain, [])
        ranges.append((first, max(last, ranges[-1][1] if ranges else 0)))
    count = 0
    waiting: dict[str, list[Audited]] = {}
    for one in lines:
        if one.sequence is None:
            continue  # of before version 0.3: in no chain, and without a place to name it by
        chain = _chain_name(one)
        part = waiting.get(chain, [])
        ranges = there.get(chain, [])
        below = bisect_right(ranges, one.sequence, key=lambda ends: ends[0])
        held = below > 0 and one.sequence <= ranges[below - 1][1]
        if part and (held or len(part) == _OBJECT_LINES or part[-1].sequence != one.sequence - 1):
            count += _put_object(objects, chain, waiting.pop(chain))
        if not held:
            waiting.setdefault(chain, []).append(one)
    return count + sum(_put_object(objects, chain, part) for chain, part in waiting.items())


def _put_object(objects: Objects, chain: str, lines: list[Audited]) -> int:
    """Put entries of one chain, unless they are there; returns how many were put."""
    key = f"audit/{chain}/{lines[0].sequence:012d}-{lines[-1].sequence:012d}.jsonl"
    text = "".join(f"{one.model_dump_json()}\n" for one in lines)
    return len(lines) if objects.put(key, text.encode(), create=True) else 0


def _chain_name(one: Audited) -> str:
    """Folder of a chain: names of tenants hold what keys of objects must not."""
    digest = hashlib.sha256((one.tenant or "").encode()).hexdigest()[:32]
    return f"{digest}-{'refusals' if one.refused else 'changes'}"


def _objects(objects: Objects) -> list[tuple[str, int, int, str]]:
    """Chain, first and last place, and key of each object, in this order."""
    found = []
    for one in objects.list("audit/"):
        name = _OBJECT.fullmatch(one.key)
        if name is not None:
            found.append((f"{name[1]}-{name[2]}", int(name[3]), int(name[4]), one.key))
    return sorted(found)


def _read_objects(objects: Objects) -> Iterator[Audited]:
    """All entries of an object store, each once.

    Raises
    ------
    InvalidRequest : an object does not hold what its name says, or one is missing between others.
    """
    from sceneprint.errors import InvalidRequest

    before, end = "", 0
    for chain, first, last, key in _objects(objects):
        place = f"{objects.url}/{key}"
        lines = list(_entries_of(place, objects.get(key).decode("utf-8", "replace").splitlines()))
        wanted = list(range(first, last + 1))
        if [one.sequence for one in lines] != wanted or {*map(_chain_name, lines)} != {chain}:
            raise InvalidRequest(
                f"{place}: it does not hold the entries that its name says. Restore the object "
                "from a version or copy of it."
            )
        if chain == before and first > end + 1:
            raise InvalidRequest(
                f"{place}: the {first - end - 1} entries before it are missing. Export again; "
                "where the log has them no longer, restore the object, or begin with another "
                "prefix."
            )
        end = end if chain == before else 0
        yield from (one for one in lines if one.sequence is not None and one.sequence > end)
        before, end = chain, max(end, last)


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
