"""The schema of the database, step by step; run by `sceneprint.store` when it opens one."""
