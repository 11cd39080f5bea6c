"""Jobs from claim to outcome."""
