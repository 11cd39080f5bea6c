"""Bundles: immutable states of a store, each a manifest and parts named by their digests."""
