"""Depth images and clouds to oriented surfaces."""
