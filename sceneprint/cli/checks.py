"""What `sceneprint doctor` looks at on this machine; nothing is changed by looking."""

from __future__ import annotations

import ctypes
import errno
import os
import shutil
import sqlite3
import sys
import tempfile
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from sceneprint import __version__
from sceneprint.cli.checks_database import database
from sceneprint.cli.checks_objects import object_stores
from sceneprint.cli.checks_server import server
from sceneprint.cli.findings import Finding

if TYPE_CHECKING:
    from sceneprint.settings import Settings

#: The oldest SQLite with all that the store asks for (UPDATE ... RETURNING).
OLDEST_SQLITE = (3, 35, 0)
#: Free space below which uploads are soon refused, and below which it is time to look, bytes.
LEAST_FREE, LITTLE_FREE = 100 << 20, 5 << 30
#: What open3d loads of the system, and the Debian packages that bring it.
OPEN3D_LIBRARIES = {
    "libGL.so.1": "libgl1",
    "libEGL.so.1": "libegl1",
    "libX11.so.6": "libx11-6",
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libgomp.so.1": "libgomp1",
}


def machine(settings: Settings) -> Iterator[Finding]:
    """Findings about this machine.

    Parameters
    ----------
    settings : whose folders are looked at
    """
    yield _python()
    yield _sqlite()
    yield _kernels()
    yield from _tables(settings.cache_dir)
    yield from _folder(settings.data_dir)
    found = database(settings)
    yield found
    if found.verdict != "WRONG":
        yield from server(settings)
    yield from object_stores(settings)
    yield _embree()
    yield _open3d()


def _python() -> Finding:
    version = ".".join(map(str, sys.version_info[:3]))  # an older than 3.11 cannot install this
    return Finding("ok", "python", f"{version}, sceneprint {__version__}")


def _sqlite() -> Finding:
    if sqlite3.sqlite_version_info < OLDEST_SQLITE:
        least = ".".join(map(str, OLDEST_SQLITE))
        text = f"{sqlite3.sqlite_version} is too old. Use a Python with SQLite {least} or later."
        return Finding("WRONG", "sqlite", text)
    return Finding("ok", "sqlite", sqlite3.sqlite_version)


def _kernels() -> Finding:
    from sceneprint.geometry.counting import compiled_at

    folder, pattern = compiled_at()
    if folder and any(Path(folder).glob(pattern)):
        return Finding("ok", "kernels", f"compiled, in {folder}")
    if folder and _may_write(Path(folder)):
        return Finding("note", "kernels", "not compiled yet; the first use does it, in a minute")
    text = (
        f"{folder or 'no folder'} cannot be written, so that every process compiles for a "
        "minute. Set NUMBA_CACHE_DIR to a folder that can."
    )
    return Finding("note", "kernels", text)


def _tables(cache_dir: Path) -> Iterator[Finding]:
    from sceneprint.models import PRESETS, read_model
    from sceneprint.models.tables import CACHE_VERSION

    for preset in PRESETS:
        subject, model = f"table {preset}", read_model(preset)
        path = cache_dir / f"table-v{CACHE_VERSION}-{model.id}.bin"
        if path.is_file():
            yield Finding("ok", subject, str(path))
        elif _may_write(cache_dir):
            yield Finding("note", subject, "not built yet; the first use does it, in seconds")
        else:
            text = (
                f"{cache_dir} cannot be written, so that every process builds it anew. "
                "Set SCENEPRINT_CACHE_DIR to a folder that can."
            )
            yield Finding("note", subject, text)


def _folder(data_dir: Path) -> Iterator[Finding]:
    there = _nearest(data_dir)
    why = _unwritable(data_dir)
    if why == errno.ENOSPC:
        text = f"{data_dir} is on a full disk. Free some space: until then nothing is taken."
        yield Finding("WRONG", "data folder", text)
    elif why is not None and (data_dir / "sceneprint.db").is_file():
        text = (
            f"{data_dir} is read-only ({os.strerror(why)}): `sceneprint serve` answers queries of "
            "it, and takes nothing. Make it writable, or name another with --data."
        )
        yield Finding("WRONG", "data folder", text)
    elif why is not None:
        text = (
            f"{data_dir} cannot be written ({os.strerror(why)}). Check its permissions, or name "
            "another with --data."
        )
        yield Finding("WRONG", "data folder", text)
    else:
        text = f"{data_dir} can be written" if there == data_dir else f"{data_dir} can be made"
        yield Finding("ok", "data folder", text)
    free = shutil.disk_usage(there).free
    text = f"{free / 1e9:.1f} GB free; a frame takes about 0.8 MB"
    if free < LEAST_FREE:
        yield Finding("WRONG", "disk", f"{text}. Make room, or uploads will be refused.")
    else:
        yield Finding("note" if free < LITTLE_FREE else "ok", "disk", text)


def _embree() -> Finding:
    try:
        import_module("embreex.rtcore_scene")
    except ImportError as error:
        text = f"cannot be imported ({error}); only `synth`, `train` and `demo` need it"
        return Finding("note", "embreex", text)
    return Finding("ok", "embreex", "can be imported, for synthetic rooms")


def _open3d() -> Finding:
    missing = []
    for library, package in OPEN3D_LIBRARIES.items():
        try:
            ctypes.CDLL(library)
        except OSError:
            missing.append(package)
    if missing:
        packages = " ".join(missing)
        text = f"only reconstructions and benchmarks need them: apt-get install {packages}"
        return Finding("note", "open3d libraries", text)
    return Finding("ok", "open3d libraries", "all there")


def _nearest(folder: Path) -> Path:
    """The folder, or the first above it that is there."""
    folder = folder.absolute()
    return next(one for one in (folder, *folder.parents) if one.is_dir())


def _may_write(folder: Path) -> bool:
    """Whether a file can be made in the folder, or where the folder is missing, above it."""
    return _unwritable(folder) is None


def _unwritable(folder: Path) -> int | None:
    """Why no file can be made there, as `errno`; None where one can."""
    try:  # tried, as permissions say little of read-only disks and to root; leaves no trace
        with tempfile.TemporaryFile(dir=_nearest(folder)) as file:
            file.write(b"x")  # a full disk may still have room for a name
            file.flush()
        return None
    except OSError as error:
        return error.errno or errno.EIO
