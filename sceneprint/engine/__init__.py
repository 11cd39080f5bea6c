"""The one place that joins numbers and truth: frames in, answers out.

Engine.add_frame  -->  store  --Engine.work-->  signature in the store  --Engine.query-->  Answer
"""

from sceneprint.engine.engine import Engine
from sceneprint.engine.jobs.lifecycle import Work

__all__ = ["Engine", "Work"]
