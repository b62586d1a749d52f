"""The procedure that moves the manual output by pulses."""
