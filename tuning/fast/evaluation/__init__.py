"""From a record to the proposal, or to the reason for which there is none."""
