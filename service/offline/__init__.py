"""Tunings of a model and recorded tests, which need neither a loop nor a service."""
