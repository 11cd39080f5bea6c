"""Maps: their lifecycle, frames, surfaces, plans and copies."""
