"""The stages of an experiment on a live loop, each a plan (see tuning.plan)."""
