"""Readers of untrusted point clouds: PLY, PCD, KITTI, NPY, LAS, LAZ and E57."""
