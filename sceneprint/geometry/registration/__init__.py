"""Registration of two frames: correspondences, hypotheses, refinement, overlap."""
