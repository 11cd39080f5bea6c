"""Tenants: whom keys belong to, whose jobs take turns at the workers."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0014"
down_revision = "0013"
branch_labels = None
depends_on = None


def _string(length: int) -> sa.types.TypeEngine[str]:
    return sa.String(length).with_variant(sa.String(length, collation="C"), "postgresql")


_WHOLE = sa.BigInteger().with_variant(sa.Integer, "sqlite")


def upgrade() -> None:
    """Create a tenant for each key, and let jobs know whose they are."""
    op.create_table(
        "tenants",
        sa.Column("name", _string(128), nullable=False),
        sa.Column("created_at", sa.Float(), nullable=False),
        sa.Column("turn", _WHOLE, nullable=False, server_default="0"),
        sa.PrimaryKeyConstraint("name", name="pk_tenants"),
    )
    for table in ("keys", "jobs"):
        op.add_column(table, sa.Column("tenant", _string(128), nullable=False, server_default=""))
    op.add_column("jobs", sa.Column("turn", _WHOLE, nullable=True))
    op.execute("UPDATE keys SET tenant = name")
    op.execute("INSERT INTO tenants (name, created_at) SELECT name, created_at FROM keys")
    op.drop_index("ix_jobs_claimed", "jobs")
    op.create_index(
        "ix_jobs_claimed", "jobs",
        ["state", "tenant", sa.text("priority DESC"), "attempts", "number"],
    )  # fmt: skip
    op.create_index("ix_jobs_turn", "jobs", ["turn"])
    op.create_index("ix_jobs_tenant_turn", "jobs", ["tenant", "turn"])
    op.create_index("ix_keys_tenant", "keys", ["tenant"])
