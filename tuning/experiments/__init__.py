"""The experiments on a live loop that every procedure is made of: rest, a set-point step, settling, verification."""
