"""Events of writers of single maps, which get their numbers once they are committed."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0017"
down_revision = "0016"
branch_labels = None
depends_on = None


def _string(length: int) -> sa.types.TypeEngine[str]:
    return sa.String(length).with_variant(sa.String(length, collation="C"), "postgresql")


_WHOLE = sa.BigInteger().with_variant(sa.Integer, "sqlite")
_COLUMNS = "at, kind, map, frame_id, job_id, data"

#: Whoever numbers events holds this lock until its commit, so that numbers are in the order of the
#: commits. The lock's numbers are those of `LOCKS` and `EVENTS` in `sceneprint/store/postgres`.
_NUMBER = f"""
CREATE FUNCTION number_pending_events() RETURNS void LANGUAGE plpgsql AS $$
BEGIN
    PERFORM pg_advisory_xact_lock(380542, 8);
    PERFORM set_config('sceneprint.numbering', 'on', true);
    WITH pending AS (DELETE FROM pending_events RETURNING *)
    INSERT INTO events ({_COLUMNS}) SELECT {_COLUMNS} FROM pending ORDER BY number;
    PERFORM set_config('sceneprint.numbering', '', true);
END $$
"""
#: Before other events, so that those of a map stay in order; also for processes of the version
#: before, which know nothing of this.
_BEFORE = """
CREATE FUNCTION number_pending_events_first() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    PERFORM number_pending_events();
    RETURN NULL;
END $$
"""
_TRIGGER = """
CREATE TRIGGER number_pending_events_first BEFORE INSERT ON events FOR EACH STATEMENT
WHEN (current_setting('sceneprint.numbering', true) IS DISTINCT FROM 'on')
EXECUTE FUNCTION number_pending_events_first()
"""


def upgrade() -> None:
    """Create the table and, on PostgreSQL, what moves its rows."""
    op.create_table(
        "pending_events",
        sa.Column("number", _WHOLE, nullable=False),
        sa.Column("at", sa.Float(), nullable=False),
        sa.Column("kind", _string(32), nullable=False),
        sa.Column("map", _string(63), nullable=True),
        sa.Column("frame_id", _string(64), nullable=True),
        sa.Column("job_id", _string(32), nullable=True),
        sa.Column("data", sa.JSON(), nullable=False),
        sa.PrimaryKeyConstraint("number", name="pk_pending_events"),
        sqlite_autoincrement=True,
    )
    if op.get_bind().dialect.name == "postgresql":
        for statement in (_NUMBER, _BEFORE, _TRIGGER):
            op.execute(statement)
