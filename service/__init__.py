"""The autotune service: loops, jobs, REST, CLI, rehearsal."""
