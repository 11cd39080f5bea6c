"""Query log, and inspection of stored answers."""
