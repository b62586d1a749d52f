"""One short biased relay record, fitted as a whole: identification, design and verdict of the procedure "fast"."""
