"""The index of one map: a cache on disk of the signatures that the database holds.

    blocks of (keys, signatures)  --publish-->  IndexVersion --\\
    frames newer than that        ----------->  Tail       ---+--search-->  Hits

A published index is numbered and never changes: the signatures of the map in a few segments, each
a FAISS file that all processes of a machine share in memory, and that the next one most often
shares too. A search compares all of them; a map of more than `segment.FLAT_BYTES` has sketches as
well, which select the frames that are compared. The database is the truth: deleting the folder
loses nothing but the time to publish it again.
"""

from sceneprint.index.index_manifest import manifests, newest_number, scrub
from sceneprint.index.index_version import (
    IndexVersion,
    SearchHits,
    Tail,
    clear,
    newest,
    publish,
    search,
    signatures_of,
)

__all__ = [
    "IndexVersion",
    "SearchHits",
    "Tail",
    "clear",
    "manifests",
    "newest",
    "newest_number",
    "publish",
    "scrub",
    "search",
    "signatures_of",
]
