"""The procedure "fast": one short biased relay record is fitted as a whole, then gains are designed on the model."""
