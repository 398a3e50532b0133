"""Draws the pictures of README and docs afresh: `make pictures`."""

import os
from pathlib import Path

if not os.environ.get("DISPLAY"):
    os.environ.setdefault("MUJOCO_GL", "egl")

import matplotlib.image
import mujoco

import armctl

HERE = Path(__file__).parent


def reach(path: Path) -> None:
    """The bundled arm on its way to the green target; where it was before shines through."""
    sim = armctl.Simulation("robot_arm_3dof")
    sim.reset([-1.2, -0.7, -0.4])
    log = sim.move_to(sim.target).log
    model, data = sim.model, mujoco.MjData(sim.model)
    model.vis.global_.offwidth, model.vis.global_.offheight = 1280, 720
    camera = mujoco.MjvCamera()
    camera.lookat, camera.distance, camera.azimuth, camera.elevation = (0.15, 0.05, 0.38), 1.4, 168, -18
    everything, moving, hand = mujoco.MjvOption(), mujoco.mjtCatBit.mjCAT_DYNAMIC, mujoco.MjvPerturb()
    with mujoco.Renderer(model, 720, 1280) as renderer:
        for share, alpha in ((0.75, 1.0), (0.55, 0.3), (0.35, 0.2), (0.0, 0.15)):
            data.qpos[sim.arm.qpos_adr] = log.q[int(share * len(log))]
            data.mocap_pos[:] = sim.data.mocap_pos
            mujoco.mj_forward(model, data)
            first = renderer.scene.ngeom
            if first == 0:
                renderer.update_scene(data, camera)
                continue
            mujoco.mjv_addGeoms(model, data, everything, hand, moving, renderer.scene)
            for geom in renderer.scene.geoms[first : renderer.scene.ngeom]:
                geom.rgba[3] *= alpha
        matplotlib.image.imsave(path, renderer.render())


def four_panels(path: Path) -> None:
    """The same motion as curves over time."""
    sim = armctl.Simulation("robot_arm_3dof")
    armctl.Report.from_log(sim.move_to([0.3, 0.2, 0.3]).log).plot(path)


if __name__ == "__main__":
    reach(HERE / "reach.png")
    four_panels(HERE / "four_panels.png")
