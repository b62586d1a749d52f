"""The analysis of a loop of model and controller: stability, margins, step responses and their figures."""
