"""Control loops as linear systems: margins, stability, tuning and filters."""
