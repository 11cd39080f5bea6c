"""Blobs that are removed after the turn that found nothing to refer to them: no table changes."""

from __future__ import annotations

revision = "0021"
down_revision = "0020"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Leave `schema_range`: processes of 0020 go on, and `sceneprint migrate --complete` ends it.

    They do not wait for a removal that is under way. So blobs are removed in the turn until then.
    """
