"""Live: an arm that follows a target in real time, in the browser or in MuJoCo's own viewer."""
