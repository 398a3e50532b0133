"""A law of armctl.jax with MJX as the plant: 64 arms with contacts and joint limits, in one program for CPUs and GPUs."""

import jax
import jax.numpy as jnp

import armctl
from armctl import jax as aj

try:
    from mujoco import mjx
except ImportError:
    raise SystemExit("MJX is not installed; pip install mujoco-mjx") from None

jax.config.update("jax_enable_x64", True)
ARMS = 64

arm = armctl.load("robot_arm_3dof")
model = aj.arm_model(arm)
gains = aj.ComputedTorqueGains.from_controller(armctl.ComputedTorque(arm), arm.dt)
reference = aj.tick_reference(armctl.move_j(arm, arm.home, arm.home + 0.2), arm.dt, ticks=300)
plant = mjx.put_model(arm.model)


def run(q):
    """The largest error (mrad) of an arm that starts at q, in the last tenth of the motion."""

    def tick(data, row):
        tau = aj.computed_torque(model, gains, data.qpos[arm.qpos_adr], data.qvel[arm.dof_adr], row)
        data = data.replace(ctrl=data.ctrl.at[arm.ctrl_adr].set(tau / arm.gear))
        return mjx.step(plant, data), data.qpos[arm.qpos_adr] - row.q

    start = mjx.make_data(plant)
    start = start.replace(qpos=jnp.asarray(arm.home_qpos).at[arm.qpos_adr].set(q))
    errors = jax.lax.scan(tick, start, reference)[1]
    return 1e3 * jnp.abs(errors[-len(errors) // 10 :]).max()


starts = arm.home + 0.1 * jax.random.normal(jax.random.key(0), (ARMS, arm.n))
worst = jax.jit(jax.vmap(run))(starts)
print(f"{ARMS} arms, {len(reference.q)} ticks each: errors of at most {worst.max():.2g} mrad at the end")
