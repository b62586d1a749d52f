"""Control mathematics: models, experiment plans, estimation, robust optimisation. Pure: no clock, no I/O."""
