"""What `sceneprint doctor` says of object stores: a small object is written, read and removed."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from sceneprint.cli.findings import Finding

if TYPE_CHECKING:
    from sceneprint.settings import Settings


def object_stores(settings: Settings) -> Iterator[Finding]:
    """Findings about the stores of blobs and of snapshots, where they are in none of the folders.

    Parameters
    ----------
    settings : whose stores are looked at
    """
    blobs = None if settings.blob_url is None else settings.blob_url.get_secret_value()
    for subject, setting, url in (
        ("blobs", "SCENEPRINT_BLOB_URL", blobs),
        ("snapshots", "SCENEPRINT_SNAPSHOT_URL", settings.snapshot_url),
    ):
        if url is not None:
            yield _looked_at(subject, setting, url)


def _looked_at(subject: str, setting: str, url: str) -> Finding:
    from sceneprint.errors import SceneprintError
    from sceneprint.store.object_urls import VARIABLES, check_objects, open_objects

    try:
        objects = open_objects(url, setting)
        seconds = check_objects(objects)
    except SceneprintError as error:
        return Finding("WRONG", subject, str(error))
    begin = VARIABLES[url.partition(":")[0].lower()]
    of = f", with what {begin}... of the environment say" if begin else ""
    text = f"{objects.url}: written, read and removed in {seconds:.2f} s{of}"
    return Finding("ok", subject, text)
