"""What is looked at of PostgreSQL itself: what refers to what, and the pages where it can be.

Its foreign keys are enforced, but not while a dump is loaded without triggers. Pages are checked
by its extension amcheck, which only the server's administrator can make.
"""

from __future__ import annotations

from collections.abc import Iterator

from sqlalchemy import Connection, ForeignKeyConstraint, and_, select
from sqlalchemy.exc import DBAPIError

from sceneprint.errors import UnusableStore
from sceneprint.maintenance.columns import Form
from sceneprint.maintenance.findings import Finding, Folder, is_of_rows
from sceneprint.store.postgres import allow
from sceneprint.store.tables import metadata

#: Rows of one kind that are named.
_MOST = 20
_INDEXES = """
SELECT i.indexrelid::regclass::text FROM pg_index i
  JOIN pg_class c ON c.oid = i.indexrelid JOIN pg_am a ON a.oid = c.relam
WHERE a.amname = 'btree' AND i.indrelid = ANY(ARRAY[{tables}]::regclass[]) ORDER BY 1
"""
_CHECKS = (
    "to_regprocedure('bt_index_check(regclass,boolean)')",
    "to_regprocedure('verify_heapam(regclass,boolean,boolean,text,bigint,bigint)')",
)


def check_server(folder: Folder, restore: str) -> Iterator[Finding]:
    """Rows that refer to none, and pages that are damaged, as far as this user may look.

    Parameters
    ----------
    folder : see Folder
    restore : what to do about it
    """
    if folder.quick:
        return
    keys = [
        key for table in metadata.sorted_tables
        for key in sorted(table.foreign_key_constraints, key=lambda one: str(one.name))
    ]  # fmt: skip
    for done, key in enumerate(keys):
        folder.progress("database", done, len(keys))
        yield from _dangling(folder, key, restore)
    yield from _pages(folder, restore)
    folder.progress("database", len(keys), len(keys))


def _dangling(folder: Folder, key: ForeignKeyConstraint, restore: str) -> Iterator[Finding]:
    child, parent = key.table, key.referred_table
    form, pairs = Form(child), [(one.parent, one.column) for one in key.elements]
    lost = (
        select(*child.primary_key.columns)
        .join(parent, and_(*(own == its for own, its in pairs)), isouter=True)
        .where(*(own.is_not(None) for own, _ in pairs), *(its.is_(None) for _, its in pairs))
        .limit(_MOST)
    )
    with folder.store.database.read() as connection:
        allow(connection, 0)
        found = connection.execute(lost).all()
    for row in found:
        named = ", ".join(f"{value!r:.80}" for value in row)
        yield Finding(
            "dangling-row", f"row {named} of table {form.table.name}", "damage",
            f"it refers to a row of {parent.name} that is not there", restore,
        )  # fmt: skip


def _pages(folder: Folder, restore: str) -> Iterator[Finding]:
    tables = [table.name for table in metadata.sorted_tables]
    with folder.store.database.read() as connection:
        index, heap = (_usable(connection, check) for check in _CHECKS)
        quoted = ", ".join(f"'{name}'" for name in tables)
        found = connection.exec_driver_sql(_INDEXES.format(tables=quoted))
        indexes = list(found.scalars())
    if not (index and heap):
        yield Finding(
            "unchecked-pages", "the database", "note",
            "its tables and indexes were not checked page by page. Where that is wanted, have the "
            "server's administrator run CREATE EXTENSION amcheck in it and let this user use it",
        )  # fmt: skip
    for name in tables if heap else ():
        yield from _asked(
            folder,
            f"table {name}",
            restore,
            f"SELECT msg FROM verify_heapam('{name}'::regclass) LIMIT {_MOST}",
        )
    for name in indexes if index else ():
        yield from _asked(
            folder,
            f"index {name}",
            restore,
            f"SELECT NULL FROM bt_index_check('{name}'::regclass, true)",
        )


def _usable(connection: Connection, check: str) -> bool:
    asked = f"SELECT coalesce(has_function_privilege({check}::oid, 'EXECUTE'), false)"
    return bool(connection.exec_driver_sql(asked).scalar_one())


def _asked(folder: Folder, what: str, restore: str, statement: str) -> Iterator[Finding]:
    """What a check says in rows, or by an error."""
    try:
        with folder.store.database.read() as connection:
            allow(connection, 0)
            said = [*connection.exec_driver_sql(statement).scalars()]
    except (UnusableStore, DBAPIError) as error:
        if not is_of_rows(error):
            raise
        cause = error if isinstance(error, DBAPIError) else error.__cause__
        said = [str(getattr(cause, "orig", error))]
    for message in said:
        if message is not None:
            text = f"{what}: {' '.join(str(message).split())}"
            yield Finding("damaged-database", "the database", "damage", text, restore)
