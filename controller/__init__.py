"""The controller device: ISA PI(D), its modes and safety net, and the process that serves it over CANopen."""
