"""Answers that are kept, inspected and computed again."""
