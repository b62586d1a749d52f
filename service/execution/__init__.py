"""Execution of a procedure: it is run on a loop, each sample is checked, and computations run in other processes."""
