"""A session in real time, as the pages of the viewer show it: clock, history, status and the follower of a target."""
