"""The report of a job on paper: one HTML file."""
