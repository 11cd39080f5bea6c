"""Worker processes, which sign frames and run other jobs."""
