"""Create the tables of version 1.0."""

from __future__ import annotations

import secrets

from alembic import context, op
from sqlalchemy import text

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None

_COLUMNS = "at, kind, map, frame_id, job_id, data"

#: The process that numbers events holds this lock until it commits, so that numbers are in commit
#: order. The lock's numbers are those of `LOCKS` and `EVENTS` in `sceneprint/store/postgres`.
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
#: Runs before other events are inserted, so that the events of a map stay in order.
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
    """Create the tables, and on PostgreSQL the trigger that numbers pending events."""
    connection = op.get_bind()
    context.config.attributes["metadata"].create_all(connection, checkfirst=False)
    connection.execute(text("INSERT INTO schema_range VALUES (:least)"), {"least": revision})
    connection.execute(
        text("INSERT INTO secrets (name, value) VALUES ('seals', :value)"),
        {"value": secrets.token_bytes(32)},
    )
    if connection.dialect.name == "postgresql":
        for statement in (_NUMBER, _BEFORE, _TRIGGER):
            op.execute(statement)
