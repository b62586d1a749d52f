"""The states of a job, with the moves between them, and the state of a loop."""
