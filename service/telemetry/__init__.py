"""What the service tells of itself: logs, counters, how late it is."""
