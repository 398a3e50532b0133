"""From a name or a file to an Arm."""
