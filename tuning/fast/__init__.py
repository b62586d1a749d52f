"""The procedure "fast": one short record of a biased relay is fitted as a whole, then gains are designed on the model."""
