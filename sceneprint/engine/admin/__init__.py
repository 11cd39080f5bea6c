"""Keys, statistics and the tasks of an operator."""
