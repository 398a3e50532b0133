"""The peer of `regions.py`: sscbirrt on its own scene, in an environment of its own, for it needs another version of MuJoCo.

    PYTHON benchmarks/regions_peer.py FOLDER SEEDS

Into the folder go its scene as MJCF with the meshes, and `peer.json` with the regions, the start, the limits and its results.
"""

from __future__ import annotations

import json
import shutil
import sys
import time
from pathlib import Path

import mujoco
from sscbirrt.demo.scenarios import TIMING, pick
from sscbirrt.demo.scene import ACCELERATION_LIMIT, EE_SITE, HOME, UR5E_JOINTS, VELOCITY_LIMIT, menagerie_path
from sscbirrt.mujoco import plan


def main() -> None:
    folder = Path(sys.argv[1])
    specs: list[mujoco.MjSpec] = []
    compiled = mujoco.MjSpec.compile

    def compile_and_keep(spec: mujoco.MjSpec, *arguments: object) -> mujoco.MjModel:
        model = compiled(spec, *arguments)
        specs.append(spec)
        return model

    mujoco.MjSpec.compile = compile_and_keep
    problem = pick.problem()
    (folder / "scene.xml").write_text(specs[-1].to_xml(), encoding="utf-8")
    for robot in ("universal_robots_ur5e", "robotiq_2f85"):
        shutil.copytree(menagerie_path() / robot / "assets", folder / "assets", dirs_exist_ok=True)
    rows = []
    for seed in range(-1, int(sys.argv[2])):  # the first one loads what is needed
        begin = time.process_time()
        result = plan(
            problem.model,
            problem.data,
            problem.arm,
            config=problem.config,
            seed=max(seed, 0),
            trajectory=TIMING,
            **problem.kwargs,
        )
        seconds = time.process_time() - begin
        path = None if result.path is None else [list(map(float, q)) for q in result.path]
        duration = None if result.trajectory is None else result.trajectory.duration
        rows.append({"seconds": seconds, "path": path, "duration": duration})
    regions = [
        {"frame": each.T0_w.tolist(), "tip": each.Tw_e.tolist(), "bounds": each.Bw.tolist()} for each in problem.kwargs["goal"]
    ]
    found = {"regions": regions, "start": list(map(float, HOME)), "joints": UR5E_JOINTS, "site": EE_SITE}
    found |= {"speed": VELOCITY_LIMIT, "acceleration": ACCELERATION_LIMIT, "rows": rows[1:]}
    (folder / "peer.json").write_text(json.dumps(found), encoding="utf-8")


if __name__ == "__main__":
    main()
