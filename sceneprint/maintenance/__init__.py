"""Tasks of an operator on a data folder: check, repair, copy and restore it."""
