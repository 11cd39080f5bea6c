"""Pure functions of arrays; the folders follow the sections of the paper."""
