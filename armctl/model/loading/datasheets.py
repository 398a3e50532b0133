"""What models leave out: rows of data for robots by their Menagerie name, each with its source.

Only what is particular to one robot stands here. A robot without a row works too: see `robots.py` for the defaults.
"""

from dataclasses import dataclass
from math import degrees, radians

from armctl.core.tables import Table

_DEG = radians(1.0)
_COLUMNS = ("robot", "payload, kg", "reach, m", "joint speeds, deg/s", "source")
_ARM_CATEGORIES = ("arm", "dual_arm")


@dataclass(frozen=True)
class Row:
    """One robot."""

    source: str  # where the numbers are published
    v_max: tuple[float, ...] | None = None  # rad/s, one for each joint; None where the source gives none
    a_max: tuple[float, ...] | None = None  # rad/s^2, likewise
    j_max: tuple[float, ...] | None = None  # rad/s^3, likewise
    tau_max: tuple[float, ...] | None = None  # N m, likewise
    payload: float | None = None  # kg, the rated payload
    reach: float | None = None  # m, the rated reach, as the maker measures it
    rating_source: str = ""  # where these two are published; empty for `source`
    tip: str | None = None  # the site or body that carries the tip; None for the one that armctl finds
    tip_offset: tuple[float, float, float] | None = None  # (3,) m, the tip in that site's or body's frame

    @property
    def sources(self) -> str:
        return "; ".join(dict.fromkeys(filter(None, [self.rating_source, self.source])))

    @property
    def rating(self) -> str:
        """The maker's rating in words; empty if the row has none."""
        if self.payload is None or self.reach is None:
            return ""
        return f"rated payload {self.payload:g} kg, reach {self.reach:g} m ({self.rating_source or self.source})"


def _deg(*values: float) -> tuple[float, ...]:
    return tuple(value * _DEG for value in values)


_FCI = "Franka Control Interface documentation, robot and interface specifications"

ROWS: dict[str, Row] = {
    "franka_emika_panda": Row(
        source=_FCI,
        v_max=(2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61),
        a_max=(15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0),
        j_max=(7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0),
        tau_max=(87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0),
        payload=3.0,
        reach=0.855,
        rating_source="Franka Emika Panda data sheet",
        tip="hand",
        tip_offset=(0.0, 0.0, 0.1034),
    ),
    "franka_fr3": Row(
        source=_FCI,
        v_max=(2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26),
        a_max=(10.0,) * 7,
        j_max=(5000.0,) * 7,
        tau_max=(87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0),
        payload=3.0,
        reach=0.855,
        rating_source="Franka Research 3 data sheet",
    ),
    "universal_robots_ur5e": Row(
        source="Universal Robots UR5e data sheet",
        v_max=_deg(180, 180, 180, 180, 180, 180),
        tau_max=(150.0, 150.0, 150.0, 28.0, 28.0, 28.0),
        payload=5.0,
        reach=0.85,
    ),
    "universal_robots_ur10e": Row(
        source="Universal Robots UR10e data sheet",
        v_max=_deg(120, 120, 180, 180, 180, 180),
        tau_max=(330.0, 330.0, 150.0, 56.0, 56.0, 56.0),
        payload=12.5,
        reach=1.3,
    ),
    "kuka_iiwa_14": Row(
        source="KUKA LBR iiwa 14 R820 data sheet",
        v_max=_deg(85, 85, 100, 75, 130, 135, 135),
        tau_max=(320.0, 320.0, 176.0, 176.0, 110.0, 40.0, 40.0),
        payload=14.0,
        reach=0.82,
    ),
    "ufactory_xarm7": Row(
        source="UFACTORY xArm 7 user manual", v_max=_deg(180, 180, 180, 180, 180, 180, 180), payload=3.5, reach=0.7
    ),
    "ufactory_lite6": Row(
        source="UFACTORY Lite 6 user manual", v_max=_deg(180, 180, 180, 180, 180, 180), payload=0.6, reach=0.44
    ),
    "kinova_gen3": Row(
        source="Kinova Gen3 user guide: joint speeds; table 33, actuator safety items: hard limits of torque, no ratings",
        v_max=(1.39, 1.39, 1.39, 1.39, 1.22, 1.22, 1.22),
        tau_max=(105.0, 105.0, 105.0, 105.0, 52.0, 52.0, 52.0),
        payload=4.0,
        reach=0.902,
        rating_source="Kinova Gen3 user guide, specifications",
    ),
    "rethink_robotics_sawyer": Row(
        source="Rethink Robotics Intera SDK, robot description",
        v_max=(1.74, 1.328, 1.957, 1.957, 3.485, 3.485, 4.545),
        tau_max=(80.0, 80.0, 40.0, 40.0, 9.0, 9.0, 9.0),
        payload=4.0,
        reach=1.26,
        rating_source="Rethink Robotics Sawyer data sheet",
    ),
    "unitree_z1": Row(source="Unitree Z1 documentation, specifications", payload=3.0, reach=0.74),
    "trossen_vx300s": Row(
        source="Interbotix X-Series documentation, ViperX-300 6DOF: payload up to half of the reach", payload=0.75, reach=0.75
    ),
    "trossen_wx250s": Row(
        source="Interbotix X-Series documentation, WidowX-250 6DOF: payload up to half of the reach", payload=0.25, reach=0.65
    ),
    "flexiv_rizon4": Row(
        source="Flexiv Rizon 4 data sheet",
        v_max=_deg(120, 120, 140, 140, 280, 280, 280),
        tau_max=(123.0, 123.0, 64.0, 64.0, 39.0, 39.0, 39.0),
        payload=4.0,
        reach=0.78,
    ),
}

# What armctl can do with a robot, by its category in Menagerie's registry.
BY_CATEGORY: dict[str, str] = {
    "arm": "an arm: load",
    "dual_arm": "two arms: load",
    "quadruped": "four legs: load",
    "biped": "legs, as far as no rod couples them: load",
    "humanoid": "arms and legs: load",
    "mobile_manipulator": "an arm on a base: load",
    "end_effector": "a tool: load(ARM, tool=...); fingers with a motor at each joint are chains",
    "mobile_base": "nothing: wheels, but no arm",
    "drone": "nothing: thrusters, but no arm",
    "biomechanical": "nothing: muscles or tendons instead of motors at the joints",
    "misc": "nothing: no joints",
}

# Where a robot differs from its category, by its own MJCF.
BY_ROBOT: dict[str, str] = {
    "hello_robot_stretch": "an arm: load; its four slides, tied to each other, count as one joint",
    "hello_robot_stretch_3": "an arm: load; its four slides, tied to each other, count as one joint",
    "google_robot": "an arm: load",
    "robotiq_2f85": "a tool: load(ARM, tool=...), then sim.gripper",
    "robotiq_2f85_v4": "a tool: load(ARM, tool=...), then sim.gripper",
    "boston_dynamics_spot": "legs, and an arm in its entry point spot_arm: load",
    "stanford_tidybot": "an arm on a base that slides and turns, ten joints in all: load",
}

ALIASES: dict[str, str] = {
    "panda": "franka_emika_panda",
    "fr3": "franka_fr3",
    "ur5e": "universal_robots_ur5e",
    "ur10e": "universal_robots_ur10e",
    "iiwa": "kuka_iiwa_14",
    "iiwa14": "kuka_iiwa_14",
    "xarm7": "ufactory_xarm7",
    "lite6": "ufactory_lite6",
    "gen3": "kinova_gen3",
    "sawyer": "rethink_robotics_sawyer",
    "rizon4": "flexiv_rizon4",
    "so_arm100": "trs_so_arm100",
    "so101": "robotstudio_so101",
    "piper": "agilex_piper",
    "l5": "arx_l5",
    "yam": "i2rt_yam",
    "z1": "unitree_z1",
    "vx300s": "trossen_vx300s",
    "wx250s": "trossen_wx250s",
    "wxai": "trossen_wxai",
    "omy": "robotis_omy_3m",
}


def rated_arms() -> dict[str, Row]:
    """Every arm of Menagerie with its data sheet; without one, its row is empty and its speeds are the default of 2 rad/s."""
    import mujoco_menagerie as menagerie

    arms = [robot.name for robot in menagerie.robots() if robot.category in _ARM_CATEGORIES]
    return {name: ROWS.get(name, Row(source="")) for name in sorted({*arms, *ROWS})}


def ratings_table() -> Table:
    cells = []
    for name, row in rated_arms().items():
        speeds = " ".join(f"{degrees(v):.0f}" for v in row.v_max or ())
        figures = ["" if figure is None else f"{figure:g}" for figure in (row.payload, row.reach)]
        cells.append([name, *figures, speeds, row.sources or "no data sheet"])
    return Table(_COLUMNS, cells)
