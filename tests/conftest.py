"""Fixtures and hooks that several folders of tests share."""

import fcntl
import gc
import os
import secrets
import shutil
import subprocess
import sys
import tempfile
import tomllib
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import cache
from importlib import util
from importlib.metadata import entry_points
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import hypothesis
import numpy as np
import pytest
from sqlalchemy import NullPool, create_engine
from xdist.scheduler import LoadFileScheduling

from benchmarks.postgres import NoServer, Server
from benchmarks.s3 import ObjectServer
from benchmarks.waiting import until as wait_until
from sceneprint.cli import main
from sceneprint.formats.dataset import write_depth_png
from sceneprint.formats.export import write_ply
from sceneprint.geometry.registration.patch_descriptors import (
    Compression,
    PatchDescriptorParameters,
)
from sceneprint.geometry.signature.fisher_vector import Whitening
from sceneprint.geometry.signature.mixture import Mixture
from sceneprint.geometry.signature.pair_features import Projection, TableLayout
from sceneprint.geometry.signature.segmentation import HierarchyParameters, SegmentationParameters
from sceneprint.models import Model, ModelParameters
from sceneprint.pipeline import open_signer
from sceneprint.settings import Settings
from sceneprint.store import open_database
from sceneprint.store.tables import metadata
from sceneprint.types import DepthFrame, Intrinsics
from sceneprint_client.api import CameraIntrinsics
from sceneprint_lab.cli.demo import serving, write_building
from sceneprint_lab.synth import KINECT, SynthRoom, synthesise_room
from sceneprint_lab.synth.rooms import make_room

#: Folders whose files share fixtures such as a service, and the unit of folders that runs in one
#: process. The longest units start first.
TOGETHER = {
    "dashboard": "dashboard", "service": "service", "client": "clients", "cli_service": "clients",
    "ros2": "clients", "scenes": "clients",
}  # fmt: skip
#: Long files in these folders that share nothing and run beside the others.
APART = (
    "service/test_lifecycle.py", "service/test_hostile.py",
    "service/test_connections.py",
    "service/test_tenancy.py", "service/test_server.py", "service/test_overload.py",
    "service/test_hostile_files.py", "service/test_faults.py", "client/test_tracker.py",
)  # fmt: skip
#: Long files that start next, so that no process ends up alone with one of them.
LONG = (
    "test_shared_index.py", "test_lifecycle.py", "test_survival.py", "test_surfaces.py",
    "test_restoration.py", "test_map_imports.py", "test_imports.py",
    "test_surface_decoder.py", "test_every_call.py", "test_map_copy.py", "test_sequences.py",
    "test_associations.py", "test_hostile.py", "test_decoders.py", "test_cli.py",
    "test_evaluate.py", "test_joined_scans.py", "test_reencoding.py", "test_fuzz.py",
    "test_failover.py", "test_purging.py", "test_work.py", "test_recovery.py",
    "test_connections.py", "test_tracker.py", "test_tenancy.py", "test_limits.py",
)  # fmt: skip

ROOT = Path(__file__).resolve().parent.parent
#: Timeout of slow tests, seconds; `timeout` of pyproject.toml applies to all others.
THOROUGH_S = 1800
#: Whether Settings without a database mean PostgreSQL: `make test-postgres`.
ON_POSTGRES = os.environ.get("SCENEPRINT_TEST_DATABASE") == "postgresql"
#: Name of the database that is copied for tests.
TEMPLATE = "sceneprint_template"
#: Property tests use the same examples in every run, without a deadline.
hypothesis.settings.register_profile(
    "suite", derandomize=True, deadline=None,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)  # fmt: skip
hypothesis.settings.load_profile("suite")


def pytest_configure(config):
    """Start the database server of the run, if there is one; see tests/on_postgres."""
    # Also for child processes: automatic jobs would change counts.
    os.environ.setdefault("SCENEPRINT_BUILD_SURFACES", "on_request")
    os.environ.setdefault("SCENEPRINT_JOIN_SESSIONS", "on_request")
    # Decoder processes cost a second each, so only their own tests use them.
    os.environ.setdefault("SCENEPRINT_DECODERS", "0")
    # On a busy machine, requests wait instead of failing.
    os.environ.setdefault("SCENEPRINT_QUEUE_TIMEOUT_S", "600")
    config.addinivalue_line("markers", "sqlite_only(reason): of nothing that PostgreSQL does")
    config.addinivalue_line("markers", "thorough: takes long, and runs with `make test-thorough`")
    if not entry_points(group="sceneprint.commands"):
        metadata_folder = Path(tempfile.mkdtemp(prefix="sceneprint-"))
        config.add_cleanup(lambda: shutil.rmtree(metadata_folder))
        add_distributions(metadata_folder)
    if ON_POSTGRES and "PYTEST_XDIST_WORKER" not in os.environ:
        folder = Path(tempfile.mkdtemp(prefix="sceneprint-"))
        server = Server(folder)
        config.add_cleanup(lambda: shutil.rmtree(folder, ignore_errors=True))
        config.add_cleanup(lambda: server.stop("immediate"))
        server.start()
        open_database(server.create(TEMPLATE)).close()
        server.execute("CREATE TABLE folders (name text, place text)")
        # For this process, those of xdist and all child processes.
        os.environ["SCENEPRINT_TEST_SERVER"] = server.url("")


def add_distributions(folder):
    """Add the entry points of the lab and the viewers to this process and its children.

    Their metadata is written to `folder`.
    """
    for name in ("lab", "viewers"):
        project = tomllib.loads((ROOT / name / "pyproject.toml").read_text())["project"]
        info = folder / f"{project['name'].replace('-', '_')}.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Name: {project['name']}\nVersion: {project['version']}\n")
        lines = []
        for group, points in project["entry-points"].items():
            lines += [f"[{group}]", *(f"{key} = {value}" for key, value in points.items())]
        (info / "entry_points.txt").write_text("\n".join(lines))
    sys.path.append(str(folder))
    search_path = os.environ.get("PYTHONPATH")
    paths = (folder, ROOT / "lab", ROOT / "viewers", *([search_path] if search_path else []))
    os.environ["PYTHONPATH"] = os.pathsep.join(map(str, paths))


def unit_of(nodeid):
    """Return the unit whose tests run in one process: of TOGETHER, or a file."""
    file = nodeid.partition("::")[0]
    folder, _, name = file.removeprefix("tests/").partition("/")
    return TOGETHER[folder] if folder in TOGETHER and f"{folder}/{name}" not in APART else file


class UnitScheduling(LoadFileScheduling):
    """Hands out whole files, and whole units of TOGETHER."""

    def _split_scope(self, nodeid):
        return unit_of(nodeid)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Keep folders with a shared service together, with `--dist loadfile`."""
    return UnitScheduling(config, log) if config.getoption("dist") == "loadfile" else None


_folder = ExitStack()


@pytest.fixture(scope="session")
def folder_stack():
    """What is entered here ends with the last test of the unit: services would run on beside the
    tests of others, and take their time.
    """
    return _folder


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item, nextitem):
    """End what lasts as long as a unit."""
    if nextitem is None or unit_of(nextitem.nodeid) != unit_of(item.nodeid):
        _folder.close()


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """Exclude objects from before the collection from garbage collection."""
    gc.disable()
    result = yield
    gc.freeze()
    gc.enable()
    return result


def pytest_collection_modifyitems(items):
    """Put long folders and files first."""
    names = (*dict.fromkeys(TOGETHER.values()), *LONG)
    places = {name: place for place, name in enumerate(names)}

    def place(item):
        unit = unit_of(item.nodeid)
        return places.get(unit, places.get(item.path.name, len(places)))

    items.sort(key=place)
    for item in items:
        apart = f"{item.path.parent.name}/{item.path.name}" in APART
        if apart and "folder_stack" in getattr(item, "fixturenames", ()):
            raise pytest.UsageError(f"{item.nodeid} is of APART, and needs what its folder shares")
    for item in items if not ON_POSTGRES else ():
        params = getattr(getattr(item, "callspec", None), "params", {})
        if (
            item.path.parent.name in ("engine", "service")
            and params.get("store_url") == "postgresql"
        ):
            item.add_marker(pytest.mark.thorough)  # tests/store holds both databases to the same
    for item in items:
        if item.get_closest_marker("thorough") is not None:
            item.add_marker(pytest.mark.timeout(THOROUGH_S))
    for item in items if ON_POSTGRES else ():
        if (only := item.get_closest_marker("sqlite_only")) is not None:
            item.add_marker(pytest.mark.skip(reason=f"SQLite's own: {only.args[0]}"))


@pytest.fixture(autouse=True)
def _databases_go(request):
    """On PostgreSQL, drop the databases of a test's folders after the test."""
    if not ON_POSTGRES or "tmp_path" not in request.fixturenames:
        yield
        return
    place = f"{request.getfixturevalue('tmp_path')}"
    yield
    import psycopg

    server = os.environ["SCENEPRINT_TEST_SERVER"].replace("+psycopg", "")
    with psycopg.connect(f"{server}postgres", autocommit=True) as connection:
        statement = "DELETE FROM folders WHERE place = %s OR starts_with(place, %s) RETURNING name"
        for (name,) in connection.execute(statement, (place, f"{place}/")).fetchall():
            connection.execute(f'DROP DATABASE "{name}" WITH (FORCE)'.encode())


@pytest.fixture(scope="session")
def data_folder(tmp_path_factory):
    """Return the folder of the service at `service_url`."""
    return tmp_path_factory.mktemp("service")


@pytest.fixture(scope="session")
def service_url(data_folder, folder_stack):
    """Start one service with one worker for all clients of it; each test uses maps of its own."""
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("SCENEPRINT_MAX_UPLOAD_BYTES", f"{2 << 20}")
        return folder_stack.enter_context(serving(data_folder, 1))


@pytest.fixture(scope="session")
def until():
    """The function `benchmarks.waiting.until`, which waits for a true value of a condition."""
    return wait_until


@pytest.fixture(scope="session")
def once(tmp_path_factory):
    """A function that creates a read-only folder once for all processes of the run."""
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base

    def folder(name, make):
        with (shared / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            result, begun = shared / name, shared / f"{name}.begun"
            if not result.exists():
                make(begun)
                begun.rename(result)
        return result

    return folder


@pytest.fixture(scope="session")
def building(once):
    """A read-only room of the demo with 30 map frames and 20 query frames of a walk."""
    return once("building", lambda folder: list(write_building(folder, 1)))


@pytest.fixture(scope="session")
def postgres(tmp_path_factory):
    """A PostgreSQL server of this process; its `TEMPLATE` has the schema and no rows."""
    try:
        server = Server(tmp_path_factory.mktemp("postgres"))
    except NoServer as error:
        pytest.skip(str(error))
    server.start()
    try:
        open_database(server.create(TEMPLATE)).close()
        yield server
    finally:
        server.stop("immediate")  # its data is not needed any more
        shutil.rmtree(server.folder, ignore_errors=True)  # the folder is large


#: Clean databases to reuse, since cleaning is twenty times as fast as creating.
_clean = []


@pytest.fixture
def postgres_url(postgres):
    """URL of an empty database with the schema of this version."""
    if _clean:
        name = _clean.pop()
    else:
        name = f"t{secrets.token_hex(6)}"
        postgres.create(name, TEMPLATE)
    yield postgres.url(name)
    takes_callers = "SELECT 1 FROM pg_database WHERE datallowconn AND datname = "
    if postgres.execute(f"{takes_callers}'{name}'") and _cleaned(postgres, name):
        _clean.append(name)
    else:
        postgres.drop(name)


#: Query for parts of a database, other than rows, that a test may change.
_SHAPE = """
SELECT md5(concat(
    (SELECT string_agg(concat_ws(' ', c.relname, c.relkind, a.attname, a.atttypid, a.attnotnull,
                                 a.attcollation, c.reloptions), ',' ORDER BY c.relname, a.attnum)
     FROM pg_class c JOIN pg_attribute a ON a.attrelid = c.oid AND NOT a.attisdropped
     WHERE c.relnamespace = 'public'::regnamespace),
    (SELECT string_agg(conname, ',' ORDER BY conname) FROM pg_constraint),
    (SELECT string_agg(tgname, ',' ORDER BY tgname) FROM pg_trigger WHERE NOT tgisinternal),
    (SELECT string_agg(proname, ',' ORDER BY proname) FROM pg_proc
     WHERE pronamespace = 'public'::regnamespace),
    (SELECT string_agg(extname, ',' ORDER BY extname) FROM pg_extension),
    (SELECT string_agg(nspname, ',' ORDER BY nspname) FROM pg_namespace
     WHERE NOT starts_with(nspname, 'pg_')),
    (SELECT string_agg(setconfig::text, ',') FROM pg_db_role_setting s JOIN pg_database d
     ON d.oid = s.setdatabase WHERE d.datname = current_database()),
    (SELECT string_agg(version_num, ',') FROM alembic_version),
    (SELECT string_agg(least_revision, ',') FROM schema_range),
    (SELECT string_agg(concat(name, value), ',') FROM secrets)
))"""


@cache
def _shape_of_new(server):
    return server.execute(_SHAPE, TEMPLATE)


def _cleaned(server, name):
    """Clean a database; return False if more than its rows was changed."""
    import psycopg

    with psycopg.connect(server.url(name).replace("+psycopg", ""), autocommit=True) as connection:
        connection.execute(
            "SELECT pg_terminate_backend(pid, 10000) FROM pg_stat_activity "
            "WHERE datname = current_database() AND pid <> pg_backend_pid()"
        )
        if connection.execute(_SHAPE.encode()).fetchall() != _shape_of_new(server):
            return False
        tables = [f"DELETE FROM {table.name}" for table in reversed(metadata.sorted_tables)
                  if table.name not in ("schema_range", "secrets")]  # fmt: skip
        numbers = "SELECT setval(oid::regclass, 1, false) FROM pg_class WHERE relkind = 'S'"
        connection.execute("; ".join(["BEGIN", *tables, numbers, "COMMIT"]).encode())
    return True


@pytest.fixture(scope="session")
def truth():
    """A function that opens a transaction on the database of a data folder, bypassing our code."""

    @contextmanager
    def opened(folder):
        url = Settings(data_dir=folder, database_url=None).database
        patience = {"timeout": 30} if url.startswith("sqlite") else {}
        engine = create_engine(url, poolclass=NullPool, connect_args=patience)
        with engine.begin() as connection:
            yield connection

    return opened


@pytest.fixture(scope="session")
def rows(truth):
    """A function that returns the rows of a query on the database of a data folder."""

    def ask(folder, statement):
        with truth(folder) as connection:
            return [tuple(row) for row in connection.exec_driver_sql(statement)]

    return ask


@pytest.fixture(scope="session")
def object_server():
    """An S3 server of this process."""
    with ObjectServer() as server:
        yield server


@pytest.fixture
def bucket(object_server, monkeypatch):
    """URL of a new bucket, with its server in the environment."""
    for name, value in object_server.env.items():
        monkeypatch.setenv(name, value)
    return object_server.bucket(f"t{secrets.token_hex(6)}")


@pytest.fixture(params=["sqlite", "postgresql"])
def store_url(request, tmp_path):
    """URL of a new database; the test runs with each of the two kinds."""
    if request.param == "postgresql":
        return str(request.getfixturevalue("postgres_url"))
    return f"sqlite:///{tmp_path / 'sceneprint.db'}"


@pytest.fixture(scope="session")
def data_root():
    """Folder of the real recordings; tests that need them are skipped without it."""
    root = Path(os.environ.get("SCENEPRINT_DATA", ROOT.parent / "shared" / "data"))
    if not root.is_dir():
        pytest.skip(f"no real recordings at {root} (set SCENEPRINT_DATA)")
    return root


@pytest.fixture(scope="session")
def ros():
    """Functions that write ROS messages and bags."""
    spec = util.spec_from_file_location("bag_writer", ROOT / "tests" / "bag_writer.py")
    module = util.module_from_spec(spec)
    spec.loader.exec_module(module)  # importing rosbags takes half a second
    return SimpleNamespace(
        write=module.write, transform=module.transform, camera=module.T_BASE_CAMERA,
        start=module.START, k=module.K, size=(module.WIDTH, module.HEIGHT),
        containers=module.CONTAINERS, messages=module.MessageWriter,
    )  # fmt: skip


@pytest.fixture(scope="session")
def with_open3d():
    """Skip a test if Open3D's system libraries are missing."""
    done = subprocess.run([sys.executable, "-c", "import open3d"], capture_output=True, text=True)
    if done.returncode != 0:
        pytest.skip(f"Open3D cannot be imported: {done.stderr.strip().splitlines()[-1]}")


@pytest.fixture(scope="session")
def small_model():
    """A model with eight components and two levels, which is fast to load."""
    rng = np.random.default_rng(5)
    bins = PatchDescriptorParameters().dimension
    axes = np.linalg.qr(rng.normal(size=(bins, 16)))[0].T.astype(np.float32)
    matrix = np.asfortranarray(rng.normal(size=(12, 13)) / 3)  # as in scikit-learn
    return Model(
        name="small",
        parameters=ModelParameters(
            segmentation=SegmentationParameters(n_patches=150),
            hierarchy=HierarchyParameters(n_levels=2),
            table=TableLayout(8, 9, 8),
        ),
        projection=Projection(rng.normal(size=13), matrix),
        mixture=Mixture(np.full(8, 0.125), rng.normal(size=(8, 12)), np.full((8, 12), 0.7)),
        compression=Compression(np.full(bins, 0.01, np.float32), axes),
        quantiser_step=0.002,
        psi_unrelated_distance=1000.0,
        provenance={"made": "by a test"},
    )


@pytest.fixture(scope="session")
def small_whitened(small_model):
    """The small model with whitened signatures of 24 bytes."""
    rng = np.random.default_rng(6)
    basis = rng.integers(-127, 128, (24, small_model.level_length)).astype(np.int8)
    own = Whitening((1,), basis, np.full(24, 1e-6), np.zeros(24), 500_000.0)
    return replace(small_model, name="small-whitened", whitening=own)


@pytest.fixture(scope="session")
def small_signer(small_model):
    return open_signer(small_model, cached=False)


@pytest.fixture(scope="session")
def room_views(once):
    """The function `synthesise_room` with noise, cached for all processes of the run."""

    def views(seed, index, n, *, along_path=False, step=1):
        def make(folder):
            folder.mkdir()
            frames = synthesise_room(seed, index, n, along_path=along_path, step=step).frames
            np.save(folder / "depth.npy", [frame.depth for frame in frames])
            np.save(folder / "poses.npy", np.array([frame.pose for frame in frames]))

        kind = "path" if along_path else "room"
        folder, name = once(f"{kind}-{seed}-{index}-{n}-{step}", make), f"room-{index:03d}"
        both = np.load(folder / "depth.npy"), np.load(folder / "poses.npy")
        frames = (
            DepthFrame(depth, KINECT, f"{name}/frame-{k:06d}", pose)
            for k, (depth, pose) in enumerate(zip(*both, strict=True))
        )
        return SynthRoom(name, seed, index, tuple(frames))

    return views


def halved(frame):
    """Return a frame with every second sample of each row and column."""
    k = frame.intrinsics
    lens = Intrinsics(k.width // 2, k.height // 2, k.fx / 2, k.fy / 2, k.cx / 2, k.cy / 2)
    return replace(frame, depth=np.ascontiguousarray(frame.depth[::2, ::2]), intrinsics=lens)


@pytest.fixture(scope="session")
def room_frames(room_views):
    """Three views of each of two synthetic rooms."""
    rooms = [room_views(21, i, 3) for i in range(2)]
    return tuple(
        replace(frame, name=f"{room.name}-{i}")
        for room in rooms
        for i, frame in enumerate(room.frames)
    )


@pytest.fixture(scope="session")
def small_image(tmp_path_factory):
    """A function that returns every fourth sample of a frame as an image, with an offset."""
    path = tmp_path_factory.mktemp("png") / "small.png"

    def make(frame, y, x):
        k = frame.intrinsics
        write_depth_png(path, np.ascontiguousarray(frame.depth[y::4, x::4]), 1000.0)
        camera = CameraIntrinsics(
            width=160, height=120, fx=k.fx / 4, fy=k.fy / 4, cx=(k.cx - x) / 4, cy=(k.cy - y) / 4
        )
        return path.read_bytes(), camera

    return make


class Said(NamedTuple):
    """Output of a command."""

    stdout: str
    stderr: str


@pytest.fixture
def run_command(capsys):
    """A function that runs a command in this process and checks its exit code."""

    def run(*arguments, expect=0):
        capsys.readouterr()
        code = main([str(argument) for argument in arguments])
        said = Said(*capsys.readouterr())
        assert code == expect, said
        return said

    return run


@pytest.fixture(scope="session")
def room_mesh():
    """Mesh of a furnished room as a PLY file, in metres, z up."""
    room = make_room(np.random.default_rng(3))
    return write_ply(room.vertices, faces=room.faces)
