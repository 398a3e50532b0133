"""Grippers: which joints close, how they are driven, and where what they hold is."""
