"""Jobs, their events and their samples, in SQLite or PostgreSQL."""
