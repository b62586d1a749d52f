"""What every procedure moves on a live loop is made of: rest, a set-point step, settling, verification."""
