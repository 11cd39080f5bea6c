"""Two frames to a transform: correspondences, hypotheses, refinement, overlap."""
