"""Command robot arms in MuJoCo from Python."""
