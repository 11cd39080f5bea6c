"""Commands that work on what is there make nothing that is not."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sceneprint.errors import UnusableStore

if TYPE_CHECKING:
    from sceneprint.settings import Settings


def require_database(settings: Settings) -> None:
    """See that a data folder has a database: a mistyped --data would make a new, empty one.

    Raises
    ------
    UnusableStore : it has none.
    """
    if settings.database_url is None and not (settings.data_dir / "sceneprint.db").is_file():
        raise UnusableStore(
            f"{settings.data_dir}: there is no database. Name the data folder with --data."
        )
