"""Migrations of the database schema; `sceneprint.store` runs them when it opens a database."""
