"""The processes that sign frames."""
