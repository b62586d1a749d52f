"""Gains from normal operation: the set-point changes that operators make anyway identify the plant."""
