"""Plots of jobs, tunings and identified models, written to files without a display."""
