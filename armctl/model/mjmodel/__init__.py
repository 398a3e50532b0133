"""Queries and edits of MuJoCo models. Knows no robot."""
