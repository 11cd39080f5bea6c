"""Keys, statistics, events and the audit log."""
