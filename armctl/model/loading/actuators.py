"""What armctl makes of the actuators, springs and sensors of a file: a sentence for whatever is not what it was."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import mujoco
import numpy as np

from armctl.core.note import Note
from armctl.core.validation import shown
from armctl.model.loading.catalog import Source
from armctl.model.loading.joint_limits import torque_range
from armctl.model.mjmodel.dc_motor import DcMotor, dc_motor, is_dc_motor
from armctl.model.mjmodel.queries import Joints, actuator_name, is_powerless, joint_name
from armctl.model.mjmodel.sensor_timing import sensor_timing
from armctl.model.mjmodel.transmissions import Transmission, Transmissions

_WRONG_SOLVER = "4.0.0"  # the version whose Newton solver has a wrong Hessian for sparse Jacobians
_MIN_SPARSE_DOFS = 60  # from which `jacobian="auto"` means sparse
_MAX_INCLUDED_FILES = 100
_MAX_LISTED = 16
_JUDGE = "judge a controller by `armctl margins`, which includes {}"


def dc_motors(source: Source, model: mujoco.MjModel, transmissions: Sequence[Transmission]) -> tuple[DcMotor | None, ...]:
    """The DC motors of an arm's joints; None for a joint that has another actuator."""
    if not any(is_dc_motor(model, each.actuator) for each in transmissions):
        return tuple(None for _ in transmissions)
    nominal = [data for path in _files_of(source) for data in _nominal_data(path)]
    return tuple(
        dc_motor(model, each.actuator, each.gear, nominal) if is_dc_motor(model, each.actuator) else None
        for each in transmissions
    )


def _files_of(source: Source) -> list[Path]:
    """The file of a robot; of a specification, the files in the folder that MuJoCo read it from."""
    if source.path is not None:
        return [source.path]
    folder = "" if source.spec is None else source.spec.modelfiledir
    return sorted(Path(folder).glob("*.xml"))[:_MAX_INCLUDED_FILES] if folder else []


def actuator_notes(
    analysis: Transmissions, joints: Joints, transmissions: Sequence[Transmission], motors: Sequence[DcMotor | None]
) -> tuple[list[str], list[str]]:
    """What differs from the file or from what controllers model, one sentence each: those that need a warning, and others."""
    model = analysis.model
    names = [joint_name(model, each.joint) for each in transmissions]
    windings = [
        f"{name}: {' and '.join(motor.features)}" for name, motor in zip(names, motors, strict=True) if motor and motor.features
    ]
    delays = [
        f"{name} {1e3 * model.actuator_delay[each.actuator]:.3g} ms"
        for name, each in zip(names, transmissions, strict=True)
        if model.actuator_delay[each.actuator] > 0.0
    ]
    springs = [
        f"{joint_name(model, joint)} behind {joint_name(model, motor_joint)}, {model.jnt_stiffness[joint]:.3g} N m/rad"
        for joint, motor_joint in analysis.springs.items()
        if joint in joints and motor_joint in joints
    ]
    moved = {joint for each in transmissions for joint in each.coupled} | set(joints)
    yielding = [
        f"{joint_name(model, joint)} beyond {model.jnt_springyield[joint]:.3g} rad"
        for joint in sorted(moved)
        if model.jnt_plasticadr[joint] >= 0
    ]
    late = _late_sensors(analysis, transmissions, names)
    found = [
        (
            windings,
            "what DC motors have acts in simulation, but controllers do not model it ({})",
            _JUDGE.format("the motor's lag"),
        ),
        (delays, "the actuators delay commands ({}); simulations and margins include it", _JUDGE.format("the delay")),
        (
            springs,
            "elastic joints move in simulation and margins, but controllers take them as rigid ({})",
            _JUDGE.format("the spring") + ", or take ElasticFeedforward",
        ),
        (
            yielding,
            "springs yield in simulation (springyield), but controllers take them as elastic ({})",
            "remove springyield, or keep the motion inside it",
        ),
        (
            late,
            "the sensors of joints are late ({}); simulations and margins include it, but environments do not",
            _JUDGE.format("it"),
        ),
    ]
    warned: list[str] = [Note(sentence.format(_listed(names)), advice) for names, sentence, advice in found if names]
    warned += [
        f"joint {shown(name)} is moved by {_sum_of_torques(model, each)}: one motor with the sum of their torques replaces them"
        for name, each in zip(names, transmissions, strict=True)
        if each.added
    ]
    warned += _partly_on_arm(analysis, transmissions)
    servos = [
        name
        for name, each in zip(names, transmissions, strict=True)
        if any(_is_servo(model, actuator) for actuator in (each.actuator, *each.added))
    ]
    quiet = (
        [f"torque motors replace the servos of {_listed(servos)}: their gains are not used, and controls are torques"]
        if servos
        else []
    )
    quiet += [
        f"the file switches {_names(model, each.idle)} of joint {shown(name)} off: only "
        f"{_names(model, [each.actuator, *each.added])} counts"
        for name, each in zip(names, transmissions, strict=True)
        if each.idle
    ]
    return warned, quiet


def _sum_of_torques(model: mujoco.MjModel, transmission: Transmission) -> str:
    """The actuators of a joint and what each can give."""
    unit = "N" if model.jnt_type[transmission.joint] == mujoco.mjtJoint.mjJNT_SLIDE else "N m"
    phrases = []
    for actuator, gear in {transmission.actuator: transmission.gear, **transmission.added}.items():
        source, low, high = torque_range(model, actuator, gear)
        bounds = f"{high:.4g}" if low == -high else f"{low:.4g} to {high:.4g}"
        phrases.append(shown(actuator_name(model, actuator)) + (f" ({bounds} {unit})" if source else ""))
    return " and ".join(phrases)


def _names(model: mujoco.MjModel, actuators: Sequence[int]) -> str:
    return " and ".join(shown(actuator_name(model, actuator)) for actuator in actuators)


def _partly_on_arm(analysis: Transmissions, transmissions: Sequence[Transmission]) -> list[str]:
    """Actuators that act on joints of the arm in another way than its motors do: on several joints, or on a body."""
    model = analysis.model
    names = {joint: joint_name(model, joint) for each in transmissions for joint in each.coupled}
    replaced = {actuator for each in transmissions for actuator in analysis.acting_on(set(each.coupled))}
    others = [a for a in range(model.nactuator) if a not in replaced and not is_powerless(model, a)]
    if not others:
        return []
    data = mujoco.MjData(model)
    mujoco.mj_fwdPosition(model, data)
    moments = np.zeros((model.nout, model.nv))
    mujoco.mju_sparse2dense(moments, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind)
    sentences = []
    for actuator in others:
        first = int(model.actuator_outadr[actuator])
        outputs = moments[first : first + int(model.actuator_outnum[actuator])]
        acted_on = [name for joint, name in names.items() if outputs[:, model.jnt_dofadr[joint]].any()]
        if acted_on and model.actuator_trntype[actuator] != mujoco.mjtTrn.mjTRN_BODY:
            sentences.append(
                f"the actuator {shown(actuator_name(model, actuator))} also acts on {_listed(acted_on)}: it stays as it is in "
                "the file, and controllers do not use or model it"
            )
    return sentences


def mend_solver(model: mujoco.MjModel, option: mujoco.MjOption) -> list[str]:
    """Makes the Jacobians dense in `option` if this version of MuJoCo solves constraints wrongly with sparse ones.

    One sentence if it was so, or none. From the model follows what "auto" means.
    """
    is_sparse = model.opt.jacobian == mujoco.mjtJacobian.mjJAC_SPARSE or (
        model.opt.jacobian == mujoco.mjtJacobian.mjJAC_AUTO and model.nv >= _MIN_SPARSE_DOFS
    )
    uses_newton = model.opt.solver == mujoco.mjtSolver.mjSOL_NEWTON
    if mujoco.__version__ != _WRONG_SOLVER or not (is_sparse and uses_newton):
        return []
    option.jacobian = int(mujoco.mjtJacobian.mjJAC_DENSE)
    return ["MuJoCo 4.0.0 computes wrong accelerations with sparse Jacobians, so they are dense; 4.0.1 takes less time"]


def _late_sensors(analysis: Transmissions, transmissions: Sequence[Transmission], names: Sequence[str]) -> list[str]:
    """The joints whose sensors have a delay or an interval, with both."""
    joints = {each.joint: i for i, each in enumerate(transmissions)}
    joints |= {joint: joints[motor] for joint, motor in analysis.springs.items() if motor in joints}
    timing = sensor_timing(analysis.model, joints, {each.actuator: i for i, each in enumerate(transmissions)}, len(names))
    found = []
    for name, delay, interval in zip(names, timing.delay, timing.interval, strict=True):
        phrases = [f"{1e3 * delay:.3g} ms" if delay else "", f"every {1e3 * interval:.3g} ms" if interval else ""]
        if any(phrases):
            found.append(" ".join([name, *filter(None, phrases)]))
    return found


def _is_servo(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether the force of an actuator is more than its control times a constant."""
    if is_dc_motor(model, actuator):
        return bool(model.actuator_gainprm[actuator, 4:7].any())
    is_fixed = model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_FIXED
    has_bias = model.actuator_biastype[actuator] != mujoco.mjtBias.mjBIAS_NONE
    return bool(not is_fixed or has_bias or model.actuator_actnum[actuator] or model.actuator_plugin[actuator] >= 0)


def _nominal_data(path: Path) -> Iterator[tuple[float, float, float]]:
    """Every `nominal` in a file and in the files that it includes: voltage, stall torque, no-load speed."""
    waiting = [path]
    read: set[Path] = set()
    while waiting and len(read) < _MAX_INCLUDED_FILES:
        here = waiting.pop()
        if here in read or not here.is_file():
            continue
        read.add(here)
        text = re.sub(r"<!--.*?-->", "", here.read_text(errors="replace"), flags=re.DOTALL)
        for found in re.findall(r"""\bnominal\s*=\s*["']([^"']*)["']""", text):
            values = np.array([float(x) for x in found.split()])
            if len(values) == 3 and (values > 0.0).all():
                yield float(values[0]), float(values[1]), float(values[2])
        waiting += [path.parent / name for name in re.findall(r"""\bfile\s*=\s*["']([^"']*\.xml)["']""", text)]


def _listed(names: Sequence[str]) -> str:
    more = [f"and {len(names) - _MAX_LISTED} more"] if len(names) > _MAX_LISTED else []
    return "; ".join([f"{name:.100}" for name in names[:_MAX_LISTED]] + more)
