"""`python franky_server.py ADDRESS`: franky-sim, a simulated controller of a Franka Research 3, on one loopback address."""

import sys


def main() -> None:
    from franky_sim import SimulationServer
    from franky_sim.mujoco_simulator import MujocoSimulator

    with MujocoSimulator(enable_visualization=False) as simulator:
        simulator.add_robot()
        with SimulationServer(simulator, hostname_candidates=[sys.argv[1]]) as server:
            print("ready", flush=True)
            server.run_forever()


if __name__ == "__main__":
    main()
