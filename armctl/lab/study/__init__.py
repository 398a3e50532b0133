"""Studies: many closed-loop runs over payloads, friction, delays and controllers, on any executor."""
