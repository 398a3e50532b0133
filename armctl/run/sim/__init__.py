"""The simulated plant, its tick loop, and the commands that run on it."""
