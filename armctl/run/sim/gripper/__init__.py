"""Grippers of simulated arms: how they move, and what they hold."""
