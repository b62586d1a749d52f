"""Every printed table and example of the five papers, recomputed: `make validate`, or python -m validation.

Reads the printed numbers from tests/data, computes its own with `tuning`, and writes docs/validation.md with plots.
"""
