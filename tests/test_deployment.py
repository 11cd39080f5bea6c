"""Tests of the commands of docs/deployment.md, run in order on real servers."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.postgres import Server, binaries, nobody_prefix
from benchmarks.waiting import PATIENCE_S
from sceneprint.engine.admin.operations import list_keys
from sceneprint.settings import Settings
from sceneprint_client.api import NewMap
from tests.whole_engine import Engine

PAGE = (Path(__file__).resolve().parent.parent / "docs" / "deployment.md").read_text()
#: Folders that commands of the product run from, and that of PostgreSQL's.
PATH = f"{Path(sys.executable).parent}:{os.environ['PATH']}"


def blocks(title):
    """Blocks of commands below a heading, up to the next one."""
    section = re.split(r"^#+ ", PAGE.split(f"# {title}\n", 1)[1], maxsplit=1, flags=re.MULTILINE)
    return re.findall(r"^```sh\n(.*?)^```", section[0], re.DOTALL | re.MULTILINE)


@pytest.fixture(scope="module")
def primary(tmp_path_factory):
    # as many as a standby has whose configuration nobody has written
    folder = tmp_path_factory.mktemp("primary")
    server = Server(folder, durable=True, options={"max_connections": "100"})
    server.start()
    yield server
    server.kill()


@pytest.fixture
def run(primary, bucket, tmp_path):
    """Run a block with the environment of a node, and of the database's administrator."""

    def shell(block, **more):
        variables = {
            **os.environ, "PATH": f"{binaries()}:{PATH}", "PGHOST": "127.0.0.1",
            "PGPORT": str(primary.port), "PGUSER": "postgres", "PGPASSWORD": "not a default",
            "SCENEPRINT_BLOB_URL": bucket, "SCENEPRINT_DATA_DIR": str(tmp_path / "caches"), **more,
        }  # fmt: skip
        done = subprocess.run(
            [*nobody_prefix(), "bash", "-euo", "pipefail", "-c", block],
            env=variables, cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE_S,
        )  # fmt: skip
        assert done.returncode == 0, f"{block}\n{done.stdout}\n{done.stderr}"
        return done.stdout

    return shell


def database(*ports):
    """The URL of a fleet's database on servers of this machine, as the environment file has it."""
    hosts = "".join(f"host=127.0.0.1:{port}&" for port in ports)
    return f"postgresql+psycopg://sceneprint@/sceneprint?{hosts}target_session_attrs=read-write"


@pytest.mark.thorough
def test_commands_in_their_order(primary, run, tmp_path):
    (commands,) = blocks("The database")
    run(commands)
    one, there_and, back = tmp_path / "one", *blocks("From one machine to a fleet, and back")
    with Engine(Settings(data_dir=one)) as engine:
        engine.create_map(NewMap(name="building", model="depth"))
    url = database(primary.port)
    run(there_and, ONE_MACHINE=str(one), SCENEPRINT_DATABASE_URL=url)
    assert primary.execute("SELECT name FROM maps", "sceneprint") == [("building",)]

    (follow,) = blocks("A standby")
    standby = Server(tmp_path / "standby-server")  # only for the port that it would take
    standby_data = tmp_path / "standby"
    variables = {"STANDBY_DATA": str(standby_data), "STANDBY_PORT": str(standby.port)}
    said = run(follow, PRIMARY_HOST="127.0.0.1", PRIMARY_PORT=str(primary.port), **variables)
    assert re.search(r"standby1 +\| streaming \| sync ", said)
    try:
        (node,) = blocks("Every node")
        url = database(primary.port, standby.port)
        said = run(node, SCENEPRINT_DATABASE_URL=url)
        assert "WRONG" not in said, said
        assert len(re.findall(r"\bsp_[\w-]+", said)) == 2, said
        primary.kill()
        (promote,) = blocks("When the primary dies")
        assert re.findall(r"^ (t|on|off)$", run(promote, **variables), re.MULTILINE) == ["t", "off"]
        names = "SELECT name FROM keys ORDER BY name"
        command = f'psql --port {standby.port} --dbname sceneprint -Atc "{names}"'
        assert run(command).split() == ["operator", "robot-7"]

        (backup,) = blocks("Backup")
        run(backup.replace("/backup", str(tmp_path / "backup")), SCENEPRINT_DATABASE_URL=url)
        run(back, SCENEPRINT_DATABASE_URL=url, FOLDER=str(tmp_path / "again"))
        with Engine(Settings(data_dir=tmp_path / "again")) as engine:
            assert [map_.name for map_ in engine.list_maps()] == ["building"]
            assert [key.name for key in list_keys(engine.store).items] == ["operator", "robot-7"]
    finally:
        run(f"pg_ctl stop --mode immediate --silent --pgdata {standby_data}")


def test_what_root_does_is_at_least_a_shells():
    scripts = re.findall(r"^```bash\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
    assert scripts
    for block in scripts:
        done = subprocess.run(["bash", "-n", "-c", block], capture_output=True, text=True)
        assert (done.returncode, done.stderr) == (0, "")
