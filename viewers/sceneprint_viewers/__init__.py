"""Scenes of answers and maps, as MCAP files for Foxglove and Rerun."""
