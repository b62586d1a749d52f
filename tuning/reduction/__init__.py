"""The reduction of any model to the few parameters that a rule asks for."""
