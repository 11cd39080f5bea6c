"""Where a snapshot is restored to: nothing is overwritten, and nothing is removed."""

from __future__ import annotations

import fcntl
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

from sceneprint.errors import SnapshotError
from sceneprint.maintenance.manifests import DATABASE
from sceneprint.maintenance.staging import left_behind, put_new, staging
from sceneprint.writing import make_folder, sync_folder

_STAGING, _ASIDE = ".restoring-", ".before-"
#: Where SQLite keeps the locks of its readers, in a file that never is so long: whoever has the
#: database open holds one of them. Offset and bytes; part of its file format.
_READERS = (0x40000002, 510)


class Target:
    """A data folder to be made.

    Parameters
    ----------
    folder : missing or empty
    replace : it may hold something, which is moved aside

    Raises
    ------
    SnapshotError : it holds something, or is in use, or is no folder.
    """

    def __init__(self, folder: Path, *, replace: bool) -> None:
        self._folder = Path(os.path.realpath(folder))  # a link stays one
        self._exists = self._folder.is_dir()
        self._replaced = False
        if not self._exists and os.path.lexists(self._folder):
            raise SnapshotError(f"{folder} is no folder. Name another with --data.")
        found = self._contents()
        if not found:
            return
        if not replace:
            raise SnapshotError(
                f"{folder} holds {_named(found)}, and nothing is overwritten. Name another folder "
                "with --data; with --replace what is there is moved aside and kept."
            )
        if os.path.ismount(self._folder):
            raise SnapshotError(
                f"{folder} is a mount of its own and cannot be moved aside. Move away what is in "
                f"it ({_named(found)}), or name a folder in it with --data."
            )
        self._check_unused()
        self._replaced = True

    @contextmanager
    def staging(self) -> Iterator[Path]:
        """A folder on the same file system to unpack into; it is gone at the end."""
        inside = self._exists and not self._replaced
        parent = self._folder if inside else self._folder.parent
        make_folder(parent)
        prefix = _STAGING if inside else f"{self._folder.name}{_STAGING}"
        with staging(parent, prefix) as folder:
            yield folder

    def put(self, made: Path, *, blobs: str, database: str) -> Path | None:
        """Let what was made be the target, in one step as far as anybody can see.

        Parameters
        ----------
        made : of `staging`
        blobs, database : what is in it

        Returns
        -------
        aside : where the folder is now that was there
        """
        if self._exists and not self._replaced:  # it may be a mount, or another user's: it stays
            self._fill(made, blobs, database)
            return None
        folder = self._folder
        aside = folder.with_name(f"{folder.name}{_ASIDE}{datetime.now(UTC):%Y%m%dT%H%M%S%fZ}")
        try:
            if self._replaced:
                self._check_unused()  # it may have come to be used
                made.chmod(stat.S_IMODE(folder.stat().st_mode))
                folder.rename(aside)
            made.rename(folder)  # fails where somebody has put something there
        except BaseException as error:
            if aside.exists() and not folder.exists():
                aside.rename(folder)
            if isinstance(error, OSError):
                raise self._overtaken(error) from error
            raise
        sync_folder(folder.parent)
        return aside if self._replaced else None

    def _fill(self, made: Path, blobs: str, database: str) -> None:
        """The database comes last: without it a service would take the folder for an empty one."""
        try:
            (made / blobs).rename(self._folder / blobs)
            try:
                put_new(made / database, self._folder / database)
            except OSError:
                (self._folder / blobs).rename(made / blobs)
                raise
        except OSError as error:
            raise self._overtaken(error) from error

    def _contents(self) -> list[str]:
        """What is in the folder but for what killed restores have left there."""
        if not self._exists:
            return []
        ours = {*left_behind(self._folder, _STAGING)}
        if os.path.ismount(self._folder):
            ours.add("lost+found")
        return sorted(set(os.listdir(self._folder)) - ours)  # noqa: PTH208

    def _check_unused(self) -> None:
        """See that nobody has the database open, as far as this machine can tell.

        Not for a process that has it open itself: its own locks would be gone.
        """
        path = self._folder / DATABASE
        if not path.is_file():
            return
        with path.open("r+b") as file:
            try:
                fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB, _READERS[1], _READERS[0])
            except (BlockingIOError, PermissionError) as error:
                raise SnapshotError(
                    f"{self._folder} is in use. Stop its service, its workers, and whatever else "
                    "has it open, and try again."
                ) from error

    def _overtaken(self, error: OSError) -> SnapshotError:
        return SnapshotError(
            f"{self._folder}: the snapshot cannot be put there ({error.strerror}). Nothing was "
            "changed; see what has come to be there, and its permissions."
        )


def _named(names: list[str]) -> str:
    shown = ", ".join(names[:3])
    return shown if len(names) <= 3 else f"{shown} and {len(names) - 3} more"
