"""Numbers that MuJoCo repairs by itself end a run with the reason, in the compiled loop and in Python."""

import mujoco
import numpy as np
import pytest
from motions import Still

import armctl
from armctl.run.sim import repairs


class Huge(armctl.PD):
    """A law in Python whose torque becomes huge at a time."""

    def __init__(self, arm: armctl.Arm, value: float, at: float):
        super().__init__(arm)
        self.value = value
        self.at = at
        self._n = arm.n

    def torque(self, state: armctl.State, setpoint: armctl.Setpoint) -> np.ndarray:
        return np.full(self._n, self.value) if state.t >= self.at else super().torque(state, setpoint)


@pytest.fixture
def arm(bundled) -> armctl.Arm:
    return bundled


@pytest.fixture
def quiet_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes MUJOCO_LOG.TXT


@pytest.mark.parametrize("value", [1e13, -3e14, 1e300])
def test_a_control_that_mujoco_would_set_to_zero_ends_the_run(arm, quiet_folder, value):
    sim = armctl.Simulation(arm, Huge(arm, value, 0.05))
    sim.model.actuator_ctrllimited[:] = 0  # MuJoCo limits a control before it judges it
    log = sim.run(Still(arm.home, 0.2))
    assert "control of actuator" in log.failure
    assert log.failure.startswith("MuJoCo stopped at 0.05")
    assert len(log) < 0.2 / sim.dt
    assert (np.abs(log.tau_cmd) < 1e10).all()
    result = sim.move_to([0.3, 0.1, 0.3])
    assert not result.ok
    assert "call reset() to start again" in result.reason
    sim.reset()
    sim.controller = "pd"
    assert not sim.run(Still(arm.home, 0.05)).failure


@pytest.mark.parametrize("law", ["pd", "computed-torque", "lqr"])
@pytest.mark.parametrize("python", [False, True])
def test_an_acceleration_after_which_mujoco_would_reset_ends_the_run(arm, quiet_folder, law, python):
    sim = armctl.Simulation(arm, Huge(arm, 0.0, np.inf) if python else law)
    sim.run(Still(arm.home, 0.05))
    sim.data.qfrc_applied[arm.dof_adr[0]] = 1e13
    log = sim.run(Still(arm.home, 0.1))
    assert "acceleration of joint" in log.failure
    assert "everything would be reset" in log.failure
    assert log.failure.startswith("MuJoCo stopped at 0.05")
    assert len(log) == 0
    plain = mujoco.MjData(sim.model)
    plain.qpos[:] = arm.home_qpos
    plain.qfrc_applied[arm.dof_adr[0]] = 1e13
    mujoco.mj_step(sim.model, plain)
    assert plain.warning[mujoco.mjtWarning.mjWARN_BADQACC].number == 1  # MuJoCo alone resets, and goes on


def test_the_counts_are_those_of_mujoco(arm):
    data = mujoco.MjData(arm.model)
    counts = repairs.repair_counts(data)
    assert not repairs.has_repaired(counts)
    kinds = ("BADQPOS", "BADQVEL", "BADQACC", "BADCTRL")
    for k, name in enumerate(kinds):
        data.warning[getattr(mujoco.mjtWarning, f"mjWARN_{name}")].number = k + 3
    assert [count.value for count in counts] == [3, 4, 5, 6]
    assert repairs.has_repaired(counts)
    mujoco.mj_resetData(arm.model, data)
    assert not repairs.has_repaired(counts)


@pytest.mark.parametrize("count", [1, 3])
def test_an_environment_says_what_mujoco_repaired(quiet_folder, bundled, count):
    pytest.importorskip("gymnasium", reason="pip install -e '.[envs]'")
    from armctl.envs import ArmVectorEnv

    env = ArmVectorEnv(bundled, num_envs=count)
    env.reset(seed=0)
    batch = env.batch
    batch.rows.simulated.data(count - 1).qfrc_applied[bundled.dof_adr[0]] = 1e13
    with pytest.raises(armctl.SimulationError, match="MuJoCo repaired"):
        env.step(np.zeros(env.action_space.shape))
    env.close()
