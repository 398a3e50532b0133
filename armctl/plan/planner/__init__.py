"""Paths around obstacles, and motions along them that are proved to keep their distance."""
