"""Where the answers of queries are kept: beside the blobs, so that who shares those finds them."""

from __future__ import annotations

from sceneprint.engine.kept import KeptQueries, Stands
from sceneprint.engine.kept_folder import KeptFolder
from sceneprint.engine.kept_objects import KeptObjects
from sceneprint.settings import Settings
from sceneprint.store import Blobs
from sceneprint.store.object_blobs import ObjectBlobs


def open_kept(settings: Settings, blobs: Blobs, stands: Stands = lambda _: True) -> KeptQueries:
    """Answers as the settings want them kept.

    Parameters
    ----------
    settings : see Settings
    blobs : of the store
    stands : whether one that is found may still be looked at
    """
    if isinstance(blobs, ObjectBlobs):
        return KeptObjects(
            blobs.objects, settings.query_s, settings.query_bytes, settings.purge_s, stands
        )
    return KeptFolder(settings.query_dir, settings.query_s, settings.query_bytes, stands)
