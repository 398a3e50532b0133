"""A study on a Dask cluster, `python 81_on_a_cluster.py tcp://10.0.0.1:8786`; without an address, on two local processes."""

import sys

from dask.distributed import Client, LocalCluster

import armctl

if __name__ == "__main__":  # a worker imports this file again
    study = armctl.Study(
        "on-a-cluster",
        robot="robot_arm_3dof",
        controllers=["pd-gravity", "computed-torque-observer"],
        factors={"payload": armctl.Range(0.0, 1.0), "friction": armctl.Range(0.0, 0.02)},
        samples=16,
    )
    cluster = sys.argv[1] if len(sys.argv) > 1 else LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None)
    with Client(cluster) as client:
        result = study.run(client.get_executor(pure=False), folder="out")
    print(f"{len(result)} runs")
    print(result.summary(["tip_rms_m"]))
