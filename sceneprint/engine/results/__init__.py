"""The log of queries, and what can be looked at after one."""
