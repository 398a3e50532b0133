"""CollisionChecker and distances of an arm at a configuration."""
