"""Register two frames: correspondences, hypotheses, refinement, overlap."""
