"""The live service as a process: put together, started and ended."""
