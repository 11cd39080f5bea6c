"""Conversion of depth images and clouds to oriented surfaces."""
