"""Mounting a tool, such as a gripper, at the flange of an arm."""

from __future__ import annotations

import mujoco

from armctl.core.pose import Pose
from armctl.loading.catalog import Source
from armctl.loading.tip import tip_on
from armctl.mjmodel.edit import copy_options

_FLANGE = "armctl_flange"


def mount(spec: mujoco.MjSpec, flange: mujoco.MjsBody, T_body_flange: Pose, tool: Source) -> str:
    """Mounts a tool at a frame of the body `flange`, in place, and returns the name of its tip in the robot's model.

    Its masses, joints and actuators become part of the robot's model; all of its names get the tool's own before them.
    """
    child, _ = tool.read()
    model = tool.compile(child)
    for joint in list(child.joints):
        if joint.type == mujoco.mjtJoint.mjJNT_FREE:
            child.delete(joint)
    # The better friction of the two: a gripper that holds by it says how it needs it.
    spec.option.cone = max(spec.option.cone, child.option.cone)
    spec.option.impratio = max(spec.option.impratio, child.option.impratio)
    copy_options(spec, child)
    prefix = f"{tool.name.replace('/', '_')}/"
    site = flange.add_site(name=_FLANGE, pos=T_body_flange.position, quat=T_body_flange.quat)
    spec.attach(child, site=site, prefix=prefix)
    root = next((body for body in range(1, model.nbody) if model.body_parentid[body] == 0), 0)
    return prefix + tip_on(model, root).name
