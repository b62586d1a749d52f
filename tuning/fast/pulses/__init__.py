"""The procedure that moves the set-point by pulses."""
