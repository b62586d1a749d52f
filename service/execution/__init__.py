"""A procedure carried out: pumped through a loop, guarded at every sample, computing in processes of its own."""
