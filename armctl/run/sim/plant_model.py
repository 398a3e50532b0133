"""PlantModel: a plant as a simulation has it, with the places of its joints and motors."""

from __future__ import annotations

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
    """The MuJoCo model of a plant of an arm, its state, and where its joints and motors are.

    It keeps no reference to the Arm, so that it can be forgotten while a simulation waits for the next run.
    """

    plant: Plant
    structure: Structure  # what the plant adds to the arm's model
    model: mujoco.MjModel
    data: mujoco.MjData
    drivetrain: Drivetrain
    held: IntArray  # addresses in qvel of the joints outside the arm
    brake: Brake  # of these
    pushed_arm: _core.ArmModel  # at whose first tip payload and pushes act
    dt: float  # s, the tick
    continuous: bool  # whether the arm moves almost continuously during a tick
    substeps: int  # steps of MuJoCo in a tick

    @classmethod
    def from_arm(cls, arm: Arm, plant: Plant, before: PlantModel | None = None) -> PlantModel:
        """The model of a plant; that of another plant of the same arm becomes it, if it has the same structure."""
        structure = structure_of(arm, plant)
        if before is not None and before.structure == structure:
            model = before.model
            data = before.data
            drivetrain = before.drivetrain
        else:
            model = new_model(arm, plant)
            data = mujoco.MjData(model)
            drivetrain = drivetrain_of(arm, plant)
        apply_plant(model, data, plant, arm, drivetrain)
        held = held_dofs(arm) if before is None else before.held
        dt = arm.dt if plant.timestep is None else plant.timestep
        return cls(
            plant=plant,
            structure=structure,
            model=model,
            data=data,
            drivetrain=drivetrain,
            held=held,
            brake=Brake(model, held),
            pushed_arm=arm.core_model,
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
        """The driven joints."""
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
