"""The audit log: who changed what, and who was refused, in lines that are chained by their hashes.

    KeyChange  --note-->  line of a chain  --verify_chains-->  whether one was changed or removed

Each tenant has two chains, of its changes and of what it was refused, so that none can push out
the lines of another, nor its own changes with refusals. A line has the SHA-256 of the hash of the
line before it in its chain and of its own content. Only the oldest lines of a chain are ever
removed; the hash of the last of them stays as the chain's anchor.

Who can write to the database can make all hashes anew: a copy elsewhere (`sceneprint audit
--export`) tells.
"""

from __future__ import annotations

import hashlib
import json
import time
from dataclasses import dataclass
from typing import Any

from sqlalchemy import (
    ColumnElement,
    Connection,
    RowMapping,
    String,
    and_,
    delete,
    func,
    insert,
    select,
    update,
)

from sceneprint.store.tables import audit, audit_chains, count_rows

#: Lines that are kept of each chain at most, some 300 bytes each.
KEPT_LINES = 200_000
#: What stands before the first line of a chain.
BEGINNING = "0" * 64
#: Lines that are read, or removed, at once.
BLOCK = 1000


@dataclass(frozen=True)
class KeyChange:
    """A change, or an attempt at one that was refused.

    Parameters
    ----------
    action : the operation
    actor : name of the key that was shown; "" where none was asked for
    address : where the request came from
    map, target : what was changed
    request_id : as in the log
    data : more about it
    at : seconds since 1970; None: now
    number : of the line; 0 before it is one
    tenant : in whose chain the line is; None: the actor's
    refused : whether it was refused
    sequence, hash : place in the chain, and hash; None: not yet a line, or of before version 0.3
    """

    action: str
    actor: str
    address: str | None = None
    map: str | None = None
    target: str | None = None
    request_id: str | None = None
    data: dict[str, Any] | None = None
    at: float | None = None
    number: int = 0
    tenant: str | None = None
    refused: bool | None = False
    sequence: int | None = None
    hash: str | None = None


#: Columns whose texts may be whatever somebody asked for.
_TEXTS = ("actor", "address", "action", "map", "target", "request_id", "tenant")


def _cut(name: str, text: str | None) -> str | None:
    """As much of a text as its column takes, as both databases keep it."""
    kind = audit.c[name].type
    if text is None or not isinstance(kind, String):
        return text
    text = text.replace("\0", "\ufffd").encode(errors="replace").decode()
    return text[: kind.length]


def line_hash(before: str, line: KeyChange) -> str:
    """Hash of a line, 64 digits.

    Parameters
    ----------
    before : hash of the line before it in its chain
    line : with its tenant and its place; its number is not part of it
    """
    content = [
        line.tenant, line.refused, line.sequence, line.at, line.actor, line.address, line.action,
        line.map, line.target, line.request_id, line.data,
    ]  # fmt: skip
    canonical = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(f"{before}{canonical}".encode()).hexdigest()


def note(connection: Connection, change: KeyChange, kept: int = KEPT_LINES) -> None:
    """Add a line to its chain; the oldest of the chain go where there are too many.

    Parameters
    ----------
    connection : of a writing transaction in its turn: two lines never have one predecessor
    change : the line
    kept : lines of the chain that stay
    """
    texts = {name: _cut(name, getattr(change, name)) for name in _TEXTS}
    tenant = texts["tenant"] if texts["tenant"] is not None else str(texts["actor"])
    chain = _chain(connection, tenant, bool(change.refused))
    line = KeyChange(
        **{
            **texts,
            "tenant": tenant,
            "refused": bool(change.refused),
            "data": json.loads(json.dumps(change.data or {})),
            "at": time.time() if change.at is None else change.at,
            "sequence": chain["last"] + 1,
        }
    )
    own = line_hash(chain["head"], line)
    values = {column: getattr(line, column) for column in _COLUMNS}
    connection.execute(insert(audit).values(**values | {"hash": own}))
    connection.execute(update(audit_chains).where(*_of(chain)).values(last=line.sequence, head=own))
    if line.sequence is not None and line.sequence - chain["pruned"] > kept:
        _prune(connection, chain, line.sequence - kept)


_COLUMNS = [one.name for one in audit.columns if one.name != "number"]


def _chain(connection: Connection, tenant: str, refused: bool) -> RowMapping:
    """A chain, begun where there is none."""
    own = (audit_chains.c.tenant == tenant) & (audit_chains.c.refused == refused)
    found = connection.execute(select(audit_chains).where(own)).mappings().first()
    if found is not None:
        return found
    begun = insert(audit_chains).values(
        tenant=tenant, refused=refused, pruned=0, anchor=BEGINNING, last=0, head=BEGINNING
    )
    return connection.execute(begun.returning(*audit_chains.columns)).mappings().one()


def _of(chain: RowMapping) -> tuple[ColumnElement[bool], ...]:
    return (
        audit_chains.c.tenant == chain["tenant"],
        audit_chains.c.refused == chain["refused"],
    )


def _in(chain: RowMapping) -> ColumnElement[bool]:
    """That a line is one of a chain."""
    return and_(audit.c.tenant == chain["tenant"], audit.c.refused == chain["refused"])


def _prune(connection: Connection, chain: RowMapping, until: int) -> None:
    """Remove the lines of a chain up to a place, and keep the hash of the last of them."""
    last = select(audit.c.hash).where(_in(chain), audit.c.sequence == until)
    anchor = connection.execute(last).scalar()
    if anchor is None:
        return  # somebody has removed it: `verify_chains` is to find that
    connection.execute(delete(audit).where(_in(chain), audit.c.sequence <= until))
    connection.execute(update(audit_chains).where(*_of(chain)).values(pruned=until, anchor=anchor))


def list_changes(
    connection: Connection, before: int | None, limit: int, actor: str | None, map_name: str | None
) -> list[KeyChange]:
    """Lines of all chains, the newest first, from below number `before` on."""
    asked = select(audit).order_by(audit.c.number.desc()).limit(limit)
    if before is not None:
        asked = asked.where(audit.c.number < before)
    if actor is not None:
        asked = asked.where(audit.c.actor == actor)
    if map_name is not None:
        asked = asked.where(audit.c.map == map_name)
    return [KeyChange(**row) for row in connection.execute(asked).mappings()]


def lines_in_order(
    connection: Connection, after: int, since: float | None = None
) -> list[KeyChange]:
    """A block of lines of all chains, the oldest first, from above number `after` and a time on."""
    asked = select(audit).where(audit.c.number > after).order_by(audit.c.number).limit(BLOCK)
    if since is not None:
        asked = asked.where(audit.c.at >= since)
    return [KeyChange(**row) for row in connection.execute(asked).mappings()]


# Lines that are older than they are kept: the oldest of each chain, some at a time.


def has_old_lines(connection: Connection, before: float) -> bool:
    """Whether there is a line of before a time; costs no lock."""
    asked = select(audit.c.number).where(audit.c.at < before).limit(1)
    return connection.execute(asked).first() is not None


def prune_old_lines(connection: Connection, before: float, most: int = BLOCK) -> int:
    """Remove lines of before a time, from the beginning of each chain; returns how many.

    A line that a later one of its chain is older than stays until its own time is over: clocks may
    be set back.

    Parameters
    ----------
    connection : of a writing transaction
    before : seconds since 1970
    most : lines of each chain that are removed
    """
    removed = 0
    chains = connection.execute(select(audit_chains)).mappings().all()
    for chain in chains:
        young = select(func.min(audit.c.sequence)).where(_in(chain), audit.c.at >= before)
        first = connection.execute(young).scalar()
        end = chain["last"] if first is None else first - 1
        until = min(end, chain["pruned"] + most)
        if until > chain["pruned"]:
            _prune(connection, chain, until)
            removed += until - chain["pruned"]
    loose = select(audit.c.number).where(audit.c.sequence.is_(None), audit.c.at < before)
    numbers = connection.execute(loose.order_by(audit.c.number).limit(most)).scalars().all()
    if numbers:
        connection.execute(
            delete(audit).where(audit.c.sequence.is_(None), audit.c.number.in_(numbers))
        )
    return removed + len(numbers)


# Whether the chains are whole.


@dataclass(frozen=True)
class BrokenLine:
    """A place where a chain does not fit.

    Parameters
    ----------
    tenant, refused : which chain
    sequence : place in it; None: of a line that is in no chain
    number : of the line; None where it is missing
    why : in words
    """

    tenant: str
    refused: bool
    sequence: int | None
    number: int | None
    why: str


@dataclass(frozen=True)
class ChainsVerified:
    """What a look at all chains found.

    Parameters
    ----------
    lines, chains : how many were looked at
    unchained : lines of before version 0.3, which have no hash
    broken : the first of each chain, in the order in which they were written
    head : 64 digits of the newest lines of all chains together: note it elsewhere
    """

    lines: int
    chains: int
    unchained: int
    broken: list[BrokenLine]
    head: str


def verify_chains(connection: Connection) -> ChainsVerified:
    """Look at every line of every chain, in one reading transaction."""
    asked = select(audit_chains).order_by(audit_chains.c.tenant, audit_chains.c.refused)
    chains = connection.execute(asked).mappings().all()
    found = [_first_break(connection, chain) for chain in chains]
    found += [_loose_line(connection)]
    broken = [one for one in found if one is not None]
    broken.sort(key=lambda one: (one.number is None, one.number or 0, one.tenant))
    heads = [[one["tenant"], one["refused"], one["last"], one["head"]] for one in chains]
    return ChainsVerified(
        count_rows(connection, audit.c.sequence.is_not(None)),
        len(chains),
        count_rows(connection, audit.c.sequence.is_(None)),
        broken,
        hashlib.sha256(json.dumps(heads).encode()).hexdigest(),
    )


def _first_break(connection: Connection, chain: RowMapping) -> BrokenLine | None:
    """The first place of a chain that does not fit; None: all do."""
    place, before = chain["pruned"], chain["anchor"]

    def at(number: int | None, why: str) -> BrokenLine:
        return BrokenLine(chain["tenant"], chain["refused"], place + 1, number, why)

    while True:
        asked = select(audit).where(_in(chain), audit.c.sequence > place)
        block = connection.execute(asked.order_by(audit.c.sequence).limit(BLOCK)).mappings().all()
        for row in block:
            line = KeyChange(**row)
            if line.sequence != place + 1:
                return at(None, "it was removed")
            if place >= chain["last"]:
                return at(line.number, "it was added behind the newest line")
            if line.hash != line_hash(before, line):
                return at(line.number, "its content or its hash was changed")
            place, before = place + 1, line.hash
        if not block:
            break
    if place < chain["last"]:
        return at(None, "it was removed")
    return None if before == chain["head"] else at(None, "the chain ends with another line")


def _loose_line(connection: Connection) -> BrokenLine | None:
    """A line that is in no chain, though it was written when there were chains."""
    known = select(audit_chains.c.tenant).where(
        audit_chains.c.tenant == audit.c.tenant, audit_chains.c.refused == audit.c.refused
    )
    first = select(func.min(audit.c.number)).where(audit.c.sequence.is_not(None)).scalar_subquery()
    loose = audit.c.sequence.is_(None) & (audit.c.number > first)
    stray = audit.c.sequence.is_not(None) & ~known.exists()
    asked = select(audit).where(loose | stray).order_by(audit.c.number).limit(1)
    row = connection.execute(asked).mappings().first()
    if row is None:
        return None
    return BrokenLine(
        row["tenant"] or "", bool(row["refused"]), row["sequence"], row["number"],
        "it is in no chain",
    )  # fmt: skip


def differs_from_copy(connection: Connection, copy: KeyChange) -> str | None:
    """How a line of a copy differs from what is stored, in words; None where it does not.

    Of lines that were pruned since only the last can be compared.
    """
    own = (audit_chains.c.tenant == copy.tenant) & (audit_chains.c.refused == copy.refused)
    chain = connection.execute(select(audit_chains).where(own)).mappings().first()
    if chain is None:
        return "its chain is gone"
    if copy.sequence is None or copy.sequence < chain["pruned"]:
        return None
    stored = chain["anchor"]
    if copy.sequence > chain["pruned"]:
        asked = select(audit.c.hash).where(_in(chain), audit.c.sequence == copy.sequence)
        stored = connection.execute(asked).scalar()
    if stored is None:
        return "it is gone"
    return None if stored == copy.hash else "it has another hash"
