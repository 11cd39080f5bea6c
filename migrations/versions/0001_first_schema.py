"""Name the schema of version 1.0.

`create_schema` in `sceneprint/store/database.py` creates the tables of a new database, so this
revision changes nothing. Migrations bring databases of earlier versions to that schema.
"""

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Change nothing."""
