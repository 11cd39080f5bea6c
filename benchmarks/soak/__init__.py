"""`make soak`: the service killed and crowded for as long as it takes, and what was lost."""
