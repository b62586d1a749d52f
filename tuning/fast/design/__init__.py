"""From a model to the gains with the least J for a robustness, and how well their Ms is known."""
