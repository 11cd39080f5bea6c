"""The schemas that this version knows: the revisions of `migrations/`, and that of a database.

Alembic makes schemas; it is not asked which there are. To import it and every migration takes a
quarter of a second, and each process that opens a store would wait for it.
"""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from sqlalchemy import Connection, inspect

import migrations

if TYPE_CHECKING:
    from alembic.config import Config

_FOLDER = Path(migrations.__file__).parent
#: How each file of `migrations/versions` says what it makes of what.
_SAYS = re.compile(r'^(revision|down_revision) = (?:"(\w+)"|None)$', re.MULTILINE)


def migration_config() -> Config:
    """What Alembic needs to find `migrations/`."""
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(_FOLDER))
    return config


@cache
def known_revisions() -> tuple[str, frozenset[str]]:
    """The revision that this version works with, and all that it can bring there."""
    made: dict[str, str] = {}
    for path in _FOLDER.glob("versions/*.py"):
        said = dict(_SAYS.findall(path.read_text(encoding="utf-8")))
        if "revision" in said:
            made[said["revision"]] = said["down_revision"]
    (head,) = made.keys() - made.values()
    return head, frozenset(made)


def revision_of(connection: Connection) -> str | None:
    """Revision of a database; None: nobody has made a schema in it."""
    if not inspect(connection).has_table("alembic_version"):
        return None
    found: str | None = connection.exec_driver_sql(
        "SELECT version_num FROM alembic_version"
    ).scalar_one_or_none()
    return found
