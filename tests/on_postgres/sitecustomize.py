"""Redirection of tests and their child processes to PostgreSQL, by a folder on PYTHONPATH.

`Settings(data_dir=X)` without a database URL normally selects SQLite in X. Here it selects a
database of PostgreSQL for X, created at the first connection. A copy of the folder gets a copy of
the database, whose name is in a file of the folder. See tests/conftest.py.
"""

import fcntl
import os
import secrets
import sys
from importlib.abc import Loader, MetaPathFinder
from importlib.util import find_spec
from pathlib import Path

#: Whether all this is so, and the URL of the server, without a database.
SWITCH, SERVER = "SCENEPRINT_TEST_DATABASE", "SCENEPRINT_TEST_SERVER"
#: What stands in for a name of a database until somebody connects.
PREFIX = "folder:"
#: In a data folder: its database, and the folder that it was made for.
MARK = ".database"
#: The database that new ones are copied from.
TEMPLATE = "sceneprint_template"


def url_of(folder):
    """URL of the database of a data folder."""
    from sqlalchemy import make_url

    url = make_url(os.environ[SERVER]).set(database=f"{PREFIX}{folder.absolute()}")
    return url.render_as_string(hide_password=False)


def database_of(folder, execute):
    """Name of the database of a data folder, which is made where there is none."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / MARK).open("a+") as mark:
        fcntl.flock(mark, fcntl.LOCK_EX)
        mark.seek(0)
        name, _, place = mark.read().partition("\n")
        if place == str(folder.resolve()):
            return name
        database = f"f{secrets.token_hex(8)}"
        execute(f'CREATE DATABASE "{database}" TEMPLATE "{name or TEMPLATE}"')
        execute(f"INSERT INTO folders VALUES ('{database}', '{folder.absolute()}')")
        mark.truncate(0)
        mark.write(f"{database}\n{folder.resolve()}")
        return database


def _mend_settings(module):
    from pydantic import SecretStr

    settings = module.Settings
    init, copy = settings.__init__, settings.model_copy

    def begin(self, *args, **fields):
        init(self, *args, **fields)
        if self.database_url is None:
            self.__dict__["database_url"] = SecretStr(url_of(self.data_dir))

    def copied(self, *, update=None, deep=False):
        other = copy(self, update=update, deep=deep)
        if "data_dir" in (update or {}) and "database_url" not in (update or {}):
            other.__dict__["database_url"] = SecretStr(url_of(other.data_dir))
        return other

    settings.__init__, settings.model_copy = begin, copied


def _mend_psycopg(module):
    connect = module.Connection.connect.__func__
    parsed = module.conninfo.conninfo_to_dict

    def execute(statement):
        server = os.environ[SERVER].replace("+psycopg", "") + "postgres"
        with connect(module.Connection, server, autocommit=True) as connection:
            connection.execute(statement)

    def resolved(cls, conninfo="", **fields):
        name = fields.get("dbname") or parsed(conninfo).get("dbname") or ""
        if name.startswith(PREFIX):
            fields["dbname"] = database_of(Path(name.removeprefix(PREFIX)), execute)
        return connect(cls, conninfo, **fields)

    module.Connection.connect = classmethod(resolved)
    module.connect = module.Connection.connect


def _mend_store(module):
    from sqlalchemy import make_url

    exists = module.database_exists

    def database_exists(url):
        """Like that of a file: what new ones are copied from has a schema already."""
        name = "" if url.startswith("sqlite") else make_url(url).database or ""
        if name.startswith(PREFIX):
            return (Path(name.removeprefix(PREFIX)) / MARK).is_file()
        return bool(exists(url))

    module.database_exists = database_exists


_MENDED = {
    "psycopg": _mend_psycopg,
    "sceneprint.settings": _mend_settings,
    "sceneprint.store.database": _mend_store,
}


class _Mending(MetaPathFinder, Loader):
    """Mends the two modules when they are imported, and only then."""

    def find_spec(self, name, path=None, target=None):
        if name not in _MENDED:
            return None
        sys.meta_path.remove(self)
        try:
            spec = find_spec(name)
        finally:
            sys.meta_path.insert(0, self)
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def run(module):
                execute(module)
                _MENDED[name](module)

            spec.loader.exec_module = run
        return spec


if os.environ.get(SWITCH) == "postgresql":
    sys.meta_path.insert(0, _Mending())
