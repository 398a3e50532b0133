"""Compiled parts of `ComputedTorqueQP`: the limits of the next control period, and the quadratic program that respects them."""

from __future__ import annotations

# The parameters begin with these, then follow q_min, q_max, v_max, a_max and tau_max, each (n,), and the model.
PERIOD = 0  # s
LENGTH = 1  # m, by which rotations of the tip and motions of the joints are converted to distances
MEAN_SPEED = 2  # 0.5 if the arm moves at the mean speed of a period, 0 if at the one at its end
HEADER = 3
"""
"""
