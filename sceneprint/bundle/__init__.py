"""Bundles: immutable snapshots of a store. A manifest lists parts, named by their digests."""
