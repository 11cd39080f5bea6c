"""Administration of a store: keys, tenants, statistics, events and the audit log."""
