"""The index of one map: a cache on disk of the signatures that the database holds.

    blocks of (keys, signatures)  --publish-->  Generation --\\
    frames newer than that        ----------->  Tail       ---+--search-->  Hits

A generation is numbered and never changes: memory-mapped segments of signatures, and FAISS over
a compact code of them. The code proposes a shortlist, the signatures themselves give the exact
distances. The database is the truth: deleting the folder loses nothing but the time to publish
it again.
"""

from sceneprint.index.codes import Code, draw, fit_code, read_code, write_code
from sceneprint.index.generations import Generation, newest, newest_number
from sceneprint.index.manifests import manifests
from sceneprint.index.publishing import clear, publish
from sceneprint.index.scrubbing import scrub
from sceneprint.index.search import SHORTLIST, Hits, is_compared, search
from sceneprint.index.segments import Segment, open_segment, write_segment
from sceneprint.index.tails import Tail, signatures_of

__all__ = [
    "SHORTLIST",
    "Code",
    "Generation",
    "Hits",
    "Segment",
    "Tail",
    "clear",
    "draw",
    "fit_code",
    "is_compared",
    "manifests",
    "newest",
    "newest_number",
    "open_segment",
    "publish",
    "read_code",
    "scrub",
    "search",
    "signatures_of",
    "write_code",
    "write_segment",
]
