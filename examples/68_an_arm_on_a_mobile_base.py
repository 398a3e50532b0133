"""An arm on a base that moves in the plane reaches points far out of its own reach, around a wall."""

import numpy as np

import armctl

wall = armctl.World().add("wall", armctl.Box([0.1, 2.0, 1.0]), [1.0, 0.0, 0.5])
arm = armctl.load("panda", base="planar", scene=wall)
simulation = armctl.Simulation(arm)
for point in ([2.2, 0.4, 0.5], [-2.0, -1.0, 0.4], [2.0, -0.8, 0.6]):
    result = simulation.move_to(point)
    base = simulation.state.q[:3]
    touched = {contact.other for contact in result.log.contacts}
    print(f"{point}: {result}; base at {np.round(base[:2], 2).tolist()} m, {base[2]:+.2f} rad; touched {touched or 'nothing'}")
