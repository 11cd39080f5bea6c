"""Pure functions that take and return arrays; the folders follow the sections of the paper."""
