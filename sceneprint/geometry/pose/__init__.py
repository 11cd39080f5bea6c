"""Rigid transforms: averaging, loops, sessions joined."""
