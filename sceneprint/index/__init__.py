"""The index of a map: a cache on disk of the signatures in the database.

    blocks of (keys, signatures)  --publish-->  IndexVersion --\\
    newer frames                  ----------->  Tail        ---+--search-->  SearchHits

A published version never changes. It contains the signatures of the map in a few segments: FAISS
files that all processes of a machine map into memory, and that the next version usually reuses. A
search compares all signatures; in a map whose signatures exceed `segment.FLAT_BYTES`, sketches
select those to compare. A deleted index can be rebuilt from the database.
"""
