"""DcMotor: a `dcmotor` actuator of MuJoCo, and the torque that it gives at a speed."""

from dataclasses import dataclass
from typing import Any

import mujoco

from armctl.core.validation import Array

# Where mjs_setToDCMotor puts the numbers: MuJoCo 4.0, "DC motor technical note".
# In gainprm:
_RESISTANCE = 0
_CONSTANT = 1
_CONTROLLER = slice(4, 7)
_MAX_VOLTAGE = 7
TORQUE_COMMAND = int(mujoco.mjtCtrlInput.mjINPUT_FF)  # the input of a `dcmotor` whose command is its torque
# In biasprm:
_COGGING = 0
_COULOMB = 3
# In dynprm:
_ELECTRICAL_TIME = 0
_HEAT_RESISTANCE = 2
_BRISTLE_STIFFNESS = 5
_SLEW = slice(7, 9)
_NO_STIFFNESS = 1e-30  # of bristles; MuJoCo requires a number above 0 where there was one


@dataclass(frozen=True)
class DcMotor:
    """A motor with a winding, seen from its joint. It gives the torque |tau + tau_stall v / v_no_load| <= tau_stall."""

    actuator: int  # its number
    voltage: float  # V, the greatest one at its terminals; infinite if nothing limits it
    stall_torque: float  # N m, at rest and full voltage
    no_load_speed: float  # rad/s, at full voltage without a load
    # What else the file gives it, one phrase each: it acts in simulation, and no controller models it
    features: tuple[str, ...]


def is_dc_motor(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether an actuator is a `dcmotor` that converts a voltage to a torque."""
    is_one = model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_DCMOTOR
    return bool(is_one and model.actuator_gainprm[actuator, _CONSTANT] > 0.0)


def dc_motor(model: mujoco.MjModel, actuator: int, gear: float, nominal: list[tuple[float, float, float]]) -> DcMotor:
    """A `dcmotor` actuator behind a gear.

    `nominal` has voltage, stall torque and no-load speed of the motors in the file: MuJoCo keeps only what they imply, the
    resistance and the motor constant.
    """
    resistance = float(model.actuator_gainprm[actuator, _RESISTANCE])
    constant = float(model.actuator_gainprm[actuator, _CONSTANT])
    voltages = [
        volts
        for volts, torque, speed in nominal
        if _agree(constant, volts / speed) and _agree(resistance, constant * volts / torque)
    ]
    control = int(model.actuator_ctrladr[actuator])
    takes_voltage = model.actuator_ctrlspec[actuator] & int(mujoco.mjtCtrlInput.mjINPUT_VOLTAGE)
    if takes_voltage and model.actuator_ctrlnum[actuator] == 1 and model.actuator_ctrllimited[control]:
        voltages.append(float(abs(model.actuator_ctrlrange[control]).min()))
    if model.actuator_gainprm[actuator, _MAX_VOLTAGE] > 0.0:
        voltages.append(float(model.actuator_gainprm[actuator, _MAX_VOLTAGE]))
    voltage = min(voltages, default=float("inf"))
    size = abs(gear)
    return DcMotor(
        actuator=actuator,
        voltage=voltage,
        stall_torque=size * constant * voltage / resistance,
        no_load_speed=voltage / constant / size,
        features=_features(model, actuator),
    )


def set_current_controller(motor: Any, voltage: float) -> None:
    """Gives a `dcmotor`, of a specification or a model, a current controller without gains; winding and friction stay."""
    gains = motor.gainprm
    dynamics = motor.dynprm
    gains[_CONTROLLER] = 0.0
    gains[_MAX_VOLTAGE] = voltage if voltage < float("inf") else 0.0
    dynamics[_SLEW] = 0.0
    motor.gainprm = gains
    motor.dynprm = dynamics


def set_time_constant(motor: Any, seconds: float) -> None:
    """Sets the electrical time constant of a `dcmotor` of a specification or a model."""
    dynamics = motor.dynprm
    dynamics[_ELECTRICAL_TIME] = seconds
    motor.dynprm = dynamics


def set_friction(
    model: mujoco.MjModel, actuator: int, stiffness: float, damping: float, coulomb: float, static: float, stribeck_speed: float
) -> None:
    """Sets the LuGre friction of a `dcmotor` that has some, in place; none for a Coulomb friction of 0."""
    is_on = coulomb > 0.0
    model.actuator_dynprm[actuator, _BRISTLE_STIFFNESS] = stiffness if is_on else _NO_STIFFNESS
    model.actuator_dynprm[actuator, _BRISTLE_STIFFNESS + 1] = damping if is_on else 0.0
    model.actuator_biasprm[actuator, _COULOMB : _COULOMB + 3] = (coulomb, static, stribeck_speed) if is_on else 1.0


def current_state(model: mujoco.MjModel, actuator: int) -> int:
    """The address of a winding's current in `MjData.act`; -1 if its actuator has none."""
    if not (is_dc_motor(model, actuator) and model.actuator_dynprm[actuator, _ELECTRICAL_TIME] > 0.0):
        return -1
    return int(model.actuator_actadr[actuator] + model.actuator_actnum[actuator] - 1)  # after temperature and bristle


def current_for(model: mujoco.MjModel, actuator: int, torque: float) -> float:
    """The current, A, with which a `dcmotor` gives a torque."""
    return torque / float(model.actuator_gainprm[actuator, _CONSTANT])


def remove_bristles(model: mujoco.MjModel) -> None:
    """Switches the LuGre friction of all actuators off, in place."""
    with_bristle = model.actuator_dyntype == mujoco.mjtDyn.mjDYN_DCMOTOR
    with_bristle &= model.actuator_dynprm[:, _BRISTLE_STIFFNESS] > 0.0
    model.actuator_dynprm[with_bristle, _BRISTLE_STIFFNESS] = _NO_STIFFNESS
    model.actuator_dynprm[with_bristle, _BRISTLE_STIFFNESS + 1] = 0.0


def state_count(dynamics: Array) -> int:
    """How many states a `dcmotor` with this dynprm has whose command is its torque: current, temperature, bristle."""
    return sum(bool(dynamics[k] > 0.0) for k in (_ELECTRICAL_TIME, _HEAT_RESISTANCE, _BRISTLE_STIFFNESS))


def _agree(a: float, b: float) -> bool:
    return abs(a - b) <= 1e-9 * abs(a)


def _features(model: mujoco.MjModel, actuator: int) -> tuple[str, ...]:
    dynamics = model.actuator_dynprm[actuator]
    bias = model.actuator_biasprm[actuator]
    found = {
        f"inductance ({1e3 * dynamics[_ELECTRICAL_TIME]:.3g} ms)": dynamics[_ELECTRICAL_TIME],
        "heating (thermal)": dynamics[_HEAT_RESISTANCE],
        f"LuGre friction ({bias[_COULOMB]:.3g} N m)": dynamics[_BRISTLE_STIFFNESS],
        f"cogging ({bias[_COGGING]:.3g} N m)": bias[_COGGING],
    }
    return tuple(phrase for phrase, value in found.items() if value)
