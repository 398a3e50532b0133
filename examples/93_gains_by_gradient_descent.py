"""Gradients through the simulation: the PD gains of an arm with unknown loads and noisy encoders."""

import jax
import jax.numpy as jnp

import armctl
from armctl import jax as aj

jax.config.update("jax_enable_x64", True)
arm = armctl.load("robot_arm_3dof")
model = aj.arm_model(arm)
default = aj.PDGains.from_controller(armctl.PD(arm), arm.dt)
reference = aj.tick_reference(armctl.move_j(arm, arm.home, arm.home + 0.2), arm.dt)
noise = 5e-5 * jax.random.normal(jax.random.key(0), (len(reference.q), 2, arm.n))  # rad


def run(bandwidth, load):
    gains = aj.PDGains(default.stiffness * bandwidth**2, default.damping * bandwidth)

    def tick(state, row):
        (q, v), (wanted, (now, before)) = state, row
        tau = jnp.clip(aj.pd(gains, q + now, v + (now - before) / arm.dt, wanted), -arm.limits.tau_max, arm.limits.tau_max)
        after = v + arm.dt * aj.forward_dynamics(model, q, v, tau + aj.tip_jacobian(model, q)[2] * load)  # as MuJoCo
        return (q + arm.dt * after, after), (q, tau)

    q, tau = jax.lax.scan(jax.checkpoint(tick), (reference.q[0], reference.v[0]), (reference, noise))[1]
    return 1e3 * jnp.std(q - reference.q), jnp.std(jnp.diff(tau, axis=0))


def cost(bandwidth):
    error, chatter = jax.vmap(run, in_axes=(None, 0))(bandwidth, -9.81 * jnp.array([0.0, 0.2, 0.4]))  # N
    return jnp.mean(error) + jnp.mean(chatter), (error, chatter)


slope = jax.jit(jax.value_and_grad(cost, has_aux=True))
bandwidth = jnp.ones(arm.n)  # relative to the default gains
for _ in range(9):
    (value, (error, chatter)), gradient = slope(bandwidth)
    print(f"{bandwidth.round(2)}: worst error {error.max():.1f} mrad, chatter {chatter.mean():.1f} N m")
    bandwidth = bandwidth * jnp.exp(-0.3 * bandwidth * gradient / value)
