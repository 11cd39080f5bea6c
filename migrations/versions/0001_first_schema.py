"""Revision of the schema of version 1.0.

`create_schema` in `sceneprint/store/database.py` creates the tables of a new database, so this
revision changes nothing.
"""

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Change nothing."""
