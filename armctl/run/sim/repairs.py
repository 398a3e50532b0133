"""What MuJoCo repairs by itself: numbers that are NaN, infinite or huge, after which it goes on from another state.

mj_step resets the simulation after such a position, velocity or acceleration, and sets all controls to zero after such a
control. It counts both in `MjData.warning`.
"""

import ctypes

import mujoco

RepairCounts = tuple[ctypes.c_int32, ctypes.c_int32, ctypes.c_int32, ctypes.c_int32]
_LARGEST = "NaN, infinite or above 1e10"  # mjMAXVAL
_ADVICE = "check masses, gains and the time step of the model"
_KINDS = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
    mujoco.mjtWarning.mjWARN_BADCTRL,
)


def repair_counts(data: mujoco.MjData) -> RepairCounts:
    """How many positions, velocities, accelerations and controls MuJoCo repaired since the last reset by the caller.

    They are read in MjData itself, as long as it exists: its Python attributes take a microsecond.
    """
    from armctl.run.sim.mujoco_structs import repair_layout

    layout = repair_layout()
    first = data._address + layout.first
    return (
        ctypes.c_int32.from_address(first),
        ctypes.c_int32.from_address(first + layout.stride),
        ctypes.c_int32.from_address(first + 2 * layout.stride),
        ctypes.c_int32.from_address(first + 3 * layout.stride),
    )


def has_repaired(counts: RepairCounts) -> bool:
    """Whether one of the counts is not 0."""
    position, velocity, acceleration, control = counts
    return bool(position.value or velocity.value or acceleration.value or control.value)


def repair(model: mujoco.MjModel, data: mujoco.MjData) -> str:
    """What MuJoCo repaired, in a sentence."""
    for kind in _KINDS:
        if data.warning[kind].number:
            where = _where(model, kind, int(data.warning[kind].lastinfo))
            if kind == mujoco.mjtWarning.mjWARN_BADCTRL:
                return f"the control of {where} is {_LARGEST}, so that all controls would be zero; {_ADVICE}"
            return f"the {_QUANTITIES[kind]} of {where} is {_LARGEST}, so that everything would be reset; {_ADVICE}"
    return ""


_QUANTITIES = {
    mujoco.mjtWarning.mjWARN_BADQPOS: "position",
    mujoco.mjtWarning.mjWARN_BADQVEL: "velocity",
    mujoco.mjtWarning.mjWARN_BADQACC: "acceleration",
}


def _where(model: mujoco.MjModel, kind: mujoco.mjtWarning, number: int) -> str:
    """The actuator or joint of a number that MuJoCo names: a control, a position, or a degree of freedom."""
    if kind == mujoco.mjtWarning.mjWARN_BADCTRL:
        return f"actuator {model.actuator(number).name or number!r}" if 0 <= number < model.nu else f"actuator {number}"
    if kind == mujoco.mjtWarning.mjWARN_BADQPOS:
        joints = [joint for joint in range(model.njnt) if model.jnt_qposadr[joint] <= number]
        joint = joints[-1] if joints else -1
    else:
        joint = int(model.dof_jntid[number]) if 0 <= number < model.nv else -1
    return f"joint {model.joint(joint).name or joint!r}" if joint >= 0 else f"number {number}"
