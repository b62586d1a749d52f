"""The five-stage procedure: relay, ultimate gain, Ziegler-Nichols PI, FOPDT estimate, robust optimisation."""
