"""Motors for robots whose file has none: simulators of learning tasks move the tip by a weld to a mocap body instead."""

import itertools
from collections.abc import Iterator

import mujoco

from armctl.core.note import Note

_SCALAR = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
_NAMES_IN_A_NOTE = 12


def add_missing_motors(spec: mujoco.MjSpec) -> list[str]:
    """Makes a robot movable by motors, in place; a sentence for each change.

    A weld of a moving body to a mocap body is removed, and the joints above that body get motors. If nothing in the file
    has an actuator, all hinge and slide joints get motors, except those that an equality makes follow another.
    """
    try:
        return _added_motors(spec)
    except UnicodeDecodeError:  # a name that is not in UTF-8; the compiler's error says so
        return []


def _added_motors(spec: mujoco.MjSpec) -> list[str]:
    notes: list[str] = []
    driven = {actuator.target for actuator in spec.actuators}
    added: list[str] = []
    for weld, body in list(_mocap_welds(spec)):
        notes.append(f"the weld of {body.name} to a mocap body was removed: motors move the joints instead")
        spec.delete(weld)
        added += _add_motors(spec, _joints_above(body), driven)
    if not len(spec.actuators):
        added += _add_motors(spec, list(spec.joints), driven)
    if added:
        names = ", ".join(added[:_NAMES_IN_A_NOTE]) + (", ..." if len(added) > _NAMES_IN_A_NOTE else "")
        advice = "add <actuator><motor joint=.../></actuator> for each joint"
        notes.append(Note(f"no actuator in the file moves {names:.200}: armctl added motors", advice))
    return notes


def _mocap_welds(spec: mujoco.MjSpec) -> Iterator[tuple[mujoco.MjsEquality, mujoco.MjsBody]]:
    """The welds between a mocap body and a body that joints move, and the latter body."""
    for equality in spec.equalities:
        if equality.type != mujoco.mjtEq.mjEQ_WELD or equality.objtype != mujoco.mjtObj.mjOBJ_BODY:
            continue
        bodies = [spec.body(name) for name in (equality.name1, equality.name2) if name]
        for body in bodies:
            others_are_mocap = any(other is not None and other.mocap for other in bodies)
            if body is not None and not body.mocap and others_are_mocap and _joints_above(body):
                yield equality, body


def _joints_above(body: mujoco.MjsBody | None) -> list[mujoco.MjsJoint]:
    joints: list[mujoco.MjsJoint] = []
    while body is not None and body.name != "world":
        joints = [*body.joints, *joints]
        body = body.parent
    return joints


def _add_motors(spec: mujoco.MjSpec, joints: list[mujoco.MjsJoint], driven: set[str]) -> list[str]:
    """Adds a motor to each scalar joint that neither has one nor follows another; the names of these joints."""
    followers = {equality.name1 for equality in spec.equalities if equality.type == mujoco.mjtEq.mjEQ_JOINT and equality.name2}
    taken = {joint.name for joint in spec.joints}
    added = []
    for joint in joints:
        if joint.type not in _SCALAR or joint.name in driven or joint.name in followers:
            continue
        if not joint.name:
            joint.name = next(name for number in itertools.count() if (name := f"joint{number}") not in taken)
            taken.add(joint.name)
        spec.add_actuator(name=f"motor of {joint.name}", target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        driven.add(joint.name)
        added.append(joint.name)
    return added
