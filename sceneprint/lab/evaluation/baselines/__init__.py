"""Other ways to find a place again, measured in the same run: what the signature is held against.

One file each: `thumbnails` (the depth image made small), `fpfh` (local features, aggregated),
`rings` (heights about a scanner). `comparison` asks them the queries of an evaluation.
"""
