"""Streams: timed targets from a policy, a joystick or a topic become setpoints within all limits."""
