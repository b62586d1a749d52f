"""The simulated plant: pure models with exact dead time, and the process that serves them over CANopen."""
