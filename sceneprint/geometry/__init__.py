"""Pure functions of arrays, with one file per section of the paper."""
