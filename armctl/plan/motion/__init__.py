"""Motion: from joint positions, tip lines and waypoints to jerk-limited trajectories within every joint's limits."""
