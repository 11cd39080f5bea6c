"""Readers for files of a whole map, such as a cloud of a SLAM system or a mesh of a scanner."""
