"""A loop as a plan sees it, on the bus or in memory, and how it comes home."""
