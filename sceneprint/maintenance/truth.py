"""The database as a whole: its pages, what refers to what, and the models in it.

Where these are damaged nothing is repaired: what the rows say cannot be relied upon, and a repair
by them might remove what is sound.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from sqlalchemy import select, text, update

from sceneprint.errors import UnreadableModel, UnusableStore
from sceneprint.maintenance.findings import Finding, Folder, is_of_rows
from sceneprint.maintenance.repairs import GONE
from sceneprint.maintenance.servers import check_server
from sceneprint.models import PRESETS, parse_model, read_model, write_model
from sceneprint.store.tables import models

#: Kinds of findings after which nothing is repaired.
FATAL = frozenset({"damaged-database", "dangling-row"})
#: Messages of one check of SQLite's that are shown.
_MOST = 20
_RESTORE = (
    "restore a snapshot of the data folder (`sceneprint restore`); nothing is repaired in a "
    "damaged database"
)


def check_database(folder: Folder) -> Iterator[Finding]:
    """What the database says of its own file, and rows that refer to none."""
    database = folder.store.database
    if not database.is_sqlite:
        yield from check_server(folder, _RESTORE)
        return
    subject = "database"
    folder.progress(subject, 0, 2)
    # it alone reads all indexes: where one differs from its table, rows are not to be relied upon
    pragma = "quick_check" if folder.quick else "integrity_check"
    try:
        with database.read() as connection:
            told = connection.execute(text(f"PRAGMA {pragma}({_MOST})")).scalars().all()
            folder.progress(subject, 1, 2)
            dangling = connection.execute(text("PRAGMA foreign_key_check")).all()
    except UnusableStore as error:
        if not is_of_rows(error):
            raise
        yield damaged_database(str(error.__cause__ and getattr(error.__cause__, "orig", error)))
        return
    folder.progress(subject, 2, 2)
    for each in told:
        if each != "ok":
            yield damaged_database(" ".join(each.split()))
    for table, row, parent, _ in dangling[:_MOST]:
        yield Finding(
            "dangling-row", f"row {row} of table {table}", "damage",
            f"it refers to a row of {parent} that is not there", _RESTORE,
        )  # fmt: skip


def damaged_database(message: str) -> Finding:
    """The finding that the database cannot read all of its files, or finds them contradict."""
    return Finding("damaged-database", "the database", "damage", message, _RESTORE)


def check_models(folder: Folder) -> Iterator[Finding]:
    """Models whose file is damaged: nothing can be signed or searched with them."""
    with folder.store.database.read() as connection:
        stored = connection.execute(select(models.c.id, models.c.content)).all()
    for done, (model_id, content) in enumerate(stored):
        folder.progress("models", done, len(stored))
        folder.counts["models"] += 1
        if _is_sound(model_id, bytes(content)):
            continue
        source = next((name for name in PRESETS if read_model(name).id == model_id), None)
        yield Finding(
            "damaged-model", f"model {model_id[:12]}", "damage",
            "its file is not the one that was stored: its maps can be neither signed nor searched",
            "restore a snapshot" if source is None else f"put the preset {source} in its place",
            repair=None if source is None else partial(_put_preset, folder, model_id, source),
        )  # fmt: skip
    folder.progress("models", len(stored), len(stored))


def _is_sound(model_id: str, content: bytes) -> bool:
    try:
        return parse_model(content, model_id).id == model_id
    except UnreadableModel:
        return False


def _put_preset(folder: Folder, model_id: str, source: str) -> str:
    content = write_model(read_model(source))
    with folder.store.database.write() as connection:
        found = connection.execute(
            update(models).where(models.c.id == model_id).values(content=content)
        )
    return f"the preset {source} is in its place" if found.rowcount else GONE
