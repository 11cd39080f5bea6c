"""Execution of jobs: claims, handlers, results and retries."""
