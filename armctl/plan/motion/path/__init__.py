"""Geometric paths of the tip, and the joint paths that realize them."""
