"""Commands that the lab adds to `sceneprint`."""
