"""How fast along a path: time-optimal timing under joint limits."""
