"""Tidy a table: a Panda picks what lies around and puts it on a board, without a pose of the arm in the program."""

import numpy as np

import armctl

TABLE, BOARD = armctl.Box([0.6, 1.0, 0.2]), armctl.Box([0.18, 0.3, 0.02])
BOARD_AT = [0.5, -0.3, 0.21]
FRUSTUM = armctl.Mesh([[x, y, z] for z, r in ((-0.03, 0.022), (0.03, 0.012)) for x in (-r, r) for y in (-r, r)])
THINGS = {  # shape, half its height in m, where it lies
    "brick": (armctl.Box([0.1, 0.04, 0.05]), 0.025, [0.45, 0.25]),
    "can": (armctl.Cylinder(0.03, 0.11), 0.055, [0.6, 0.1]),
    "weight": (FRUSTUM, 0.03, [0.4, 0.05]),
}

scene = armctl.World().add("table", TABLE, [0.55, 0, 0.1]).add("board", BOARD, BOARD_AT)
for k, (name, (shape, half, place)) in enumerate(THINGS.items()):
    scene.add(name, shape, armctl.Pose([*place, 0.2 + half], rpy=[0, 0, 0.5 * k]), mass=0.1)
sim = armctl.Simulation(armctl.load("panda", scene=scene))

for name, (_, half, _) in THINGS.items():
    print(sim.pick(name))
    print(sim.place(name, armctl.Region.on(BOARD, BOARD_AT, height=half, margin=0.05, upright=True)))

for name in THINGS:
    x, y, z = np.round(1e3 * sim.data.body(name).xpos)
    print(f"{name} at {x:.0f}, {y:.0f}, {z:.0f} mm")
