"""PlantModel: a plant as a simulation has it, with the places of its joints and motors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np

from armctl import _core
from armctl.core.validation import Array, IntArray
from armctl.model.arm.actuation import Actuation
from armctl.model.arm.arm import Arm
from armctl.run.sim.drivetrain import Drivetrain, Structure, drivetrain_of, new_model, structure_of
from armctl.run.sim.plant import Brake, Plant, apply_plant, held_dofs


@dataclass(frozen=True, eq=False)
class PlantModel:
    """The MuJoCo model of a plant of some arms, its state, and where their joints and motors are.

    It keeps no reference to an Arm, so that arms can be forgotten while a simulation waits for the next run.
    """

    plant: Plant
    structure: Structure  # what the plant adds to the arms' model
    model: mujoco.MjModel
    data: mujoco.MjData
    drivetrain: Drivetrain
    held: IntArray  # addresses in qvel of the joints that belong to none of the arms
    brake: Brake  # of these
    pushed_arm: _core.ArmModel  # the first one, at whose tip payload and pushes act
    dt: float  # s, the tick
    continuous: bool  # whether the arms move almost continuously during a tick
    substeps: int  # steps of MuJoCo in a tick

    @classmethod
    def from_arms(cls, arms: Sequence[Arm], plant: Plant, before: PlantModel | None = None) -> PlantModel:
        """The model of a plant; that of another plant of the same arms becomes it, if it has the same structure."""
        structure = structure_of(arms, plant)
        if before is not None and before.structure == structure:
            model = before.model
            data = before.data
            drivetrain = before.drivetrain
        else:
            model = new_model(arms, plant)
            data = mujoco.MjData(model)
            drivetrain = drivetrain_of(arms, plant)
        apply_plant(model, data, plant, arms, drivetrain)
        held = held_dofs(*arms) if before is None else before.held
        dt = arms[0].dt if plant.timestep is None else plant.timestep
        return cls(
            plant=plant,
            structure=structure,
            model=model,
            data=data,
            drivetrain=drivetrain,
            held=held,
            brake=Brake(model, held),
            pushed_arm=arms[0].core_model,
            dt=dt,
            continuous=bool(model.opt.integrator == int(mujoco.mjtIntegrator.mjINT_RK4)),
            substeps=round(dt / model.opt.timestep),
        )

    @cached_property
    def description(self) -> str:
        """The plant in words."""
        return str(self.plant)

    @property
    def actuation(self) -> Actuation:
        """The driven joints of all arms."""
        return self.drivetrain.actuation

    @property
    def q(self) -> Array:
        """(n,) rad, of the links."""
        return self.drivetrain.link_positions(self.data.qpos)

    @property
    def v(self) -> Array:
        """(n,) rad/s, of the links."""
        return self.drivetrain.link_speeds(self.data.qvel)

    @property
    def motor_torque(self) -> Array:
        """(n,) N m at the joints, of the motors in the last tick."""
        return self.data.actuator_force[self.actuation.motor_adr] * self.actuation.gear

    def tick_times(self, ticks: int) -> Array:
        """(ticks,) s, contiguous: the times of the coming ticks, to the bit. MuJoCo adds its time step at every step."""
        times = np.full(ticks * self.substeps, float(self.model.opt.timestep))
        times[0] = self.data.time
        return np.add.accumulate(times)[:: self.substeps].copy()
