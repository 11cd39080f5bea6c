"""Measurements: accuracy by the protocol of docs/performance.md, speed beside a yardstick."""
