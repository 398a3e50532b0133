"""Grasps: how a gripper can hold a body, and which of these grasps an arm can make."""
