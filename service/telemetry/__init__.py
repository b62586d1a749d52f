"""The service's information about itself: logs, counters, delays."""
