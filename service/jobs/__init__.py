"""The jobs: they are started by a durable engine, run, supervised after their end, and decided."""
