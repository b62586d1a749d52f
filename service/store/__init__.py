"""Jobs, their events and their samples, in SQLite."""
