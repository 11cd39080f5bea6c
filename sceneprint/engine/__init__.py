"""The one place that joins computation and storage: frames in, answers out.

frame  --Engine.add_frame-->  store  --Engine.run-->  signature  --Queries.upload-->  Answer
"""

from sceneprint.engine.engine import Engine
from sceneprint.engine.jobs.lifecycle import Work

__all__ = ["Engine", "Work"]
