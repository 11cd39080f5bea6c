"""Bundles: immutable states of a store, listed by manifests and kept as parts named by digest."""
