"""Snapshots put back: every byte is verified before anything of it gets its name.

archive  --verify_snapshot-->  Snapshot
archive  --restore_snapshot-->  data folder
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from sceneprint.maintenance.manifests import BLOBS, DATABASE
from sceneprint.maintenance.snapshots import Progress, Snapshot
from sceneprint.maintenance.staging import full_disk_explained
from sceneprint.maintenance.targets import Target
from sceneprint.maintenance.unpacking import unpack


def verify_snapshot(archive: Path, progress: Progress | None = None) -> Snapshot:
    """Read all of an archive and check it; its database is unpacked in a temporary folder.

    Parameters
    ----------
    archive : of `take_snapshot`
    progress : told of bytes done and bytes in all

    Raises
    ------
    SnapshotError : it is none, of a later version, or damaged; or there is no room to check it.
    NewerSchema : a later version wrote its database.
    """
    with TemporaryDirectory(prefix="sceneprint-verify-") as name:
        folder = Path(name)
        with full_disk_explained(folder):
            return unpack(archive, folder, progress, with_blobs=False)


def restore_snapshot(
    archive: Path, folder: Path, *, replace: bool = False, progress: Progress | None = None
) -> tuple[Snapshot, Path | None]:
    """Make a data folder of an archive, all of it or nothing.

    Parameters
    ----------
    archive : of `take_snapshot`
    folder : to be made, or empty
    replace : move what is there aside; it is never removed
    progress : told of bytes done and bytes in all

    Returns
    -------
    snapshot : what was restored
    aside : where the folder is now that was there

    Raises
    ------
    SnapshotError : as for `verify_snapshot`; or the folder holds something that is to be kept, or
        is in use.
    NewerSchema : a later version wrote its database.
    OSError : the folder cannot be made.
    """
    target = Target(folder, replace=replace)
    with full_disk_explained(folder), target.staging() as made:
        snapshot = unpack(archive, made, progress, with_blobs=True)
        return snapshot, target.put(made, blobs=BLOBS.rstrip("/"), database=DATABASE)
