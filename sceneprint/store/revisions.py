"""The schemas that this version knows: the revisions of `migrations/`."""

from __future__ import annotations

from pathlib import Path

from alembic.config import Config
from alembic.script import ScriptDirectory


def migration_config() -> Config:
    """What Alembic needs to find `migrations/`."""
    import migrations

    config = Config()
    config.set_main_option("script_location", str(Path(migrations.__file__).parent))
    return config


def known_revisions() -> tuple[str | None, frozenset[str]]:
    """The revision that this version works with, and all that it can bring there."""
    scripts = ScriptDirectory.from_config(migration_config())
    return scripts.get_current_head(), frozenset(one.revision for one in scripts.walk_revisions())
