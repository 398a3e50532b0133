"""What a robot is: its model, chains, limits and collision geometry, from a name or a file."""
