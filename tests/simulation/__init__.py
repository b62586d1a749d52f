"""Deterministic simulation: controller, plant, bus and gateways with the real code, in one thread, on a simulated
clock; faults drawn from a seed. `python -m tests.simulation --help`."""
