"""The loop that a plan acts on, on the bus or in memory, and its restoration after a test."""
