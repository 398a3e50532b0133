"""Grippers of simulated arms: which joints close, how they are driven, and what they hold."""
