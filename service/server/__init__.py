"""The live service as a process: its assembly, start and end."""
