"""Trajectories as piecewise polynomials: evaluation, limits, stopping, files."""
