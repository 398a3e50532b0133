"""Comparison on a robot: the same motion under several laws on the robot behind a link, beside its simulation."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from armctl.control.interface import Controller, traits
from armctl.core.errors import ArmctlError, InputError, LinkError
from armctl.core.log import LogSource, LogTorques
from armctl.core.validation import flag, instance, integer, number
from armctl.lab.comparison import DEFAULT_CONFIGURATIONS, Comparison, compare, distinct_names, out_and_back, remarks
from armctl.lab.identification.arm_estimate import ArmEstimate
from armctl.lab.identification.excitation import excitation
from armctl.lab.identification.identify import identify
from armctl.lab.loops.link_margins import plant_behind_link
from armctl.model.arm.arm import Arm, check_arm
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.report.report import Report
from armctl.run.execution.move import NO_TARGET, read_controller
from armctl.run.execution.recorder import Recorder, ReferenceTips, RunInfo
from armctl.run.links.link import Link, check_link
from armctl.run.links.robot import Robot
from armctl.run.sim.plant import WITH_ENCODER, Plant

_LAWS_OF_MODEL = ""
_LAWS_OF_IDENTIFIED = "; laws of the identified arm"
_FURTHER_LAWS = "not run, because the robot has a fault since an earlier run"


class RobotComparison(Comparison):
    """The reports of `compare_on_robot`: those of the robot, then those of its simulation, and both again after `identified`.

    Attributes:
        delay: s, the greatest of the link that was measured, which the simulation has; NaN if no law was run.
        estimate: What was identified from a run of the robot; None without such a run.
        not_identified: Why the arm was not identified although it was to be; empty otherwise.
    """

    def __init__(self, reports: Iterable[Report], delay: float, estimate: ArmEstimate | None, not_identified: str):
        """A comparison of some reports.

        Args:
            reports: The reports, those of the robot first.
            delay: As the attribute.
            estimate: As the attribute.
            not_identified: As the attribute.
        """
        super().__init__(reports)
        self.delay = delay
        self.estimate = estimate
        self.not_identified = not_identified

    def __str__(self) -> str:
        """Remarks, and a table."""
        return "\n".join([*self.remarks(), super().__str__()])

    def remarks(self) -> list[str]:
        """Remarks on the figures: why laws were not run or failed, and why nothing was identified; one sentence each."""
        found = remarks(self)
        if self.not_identified:
            found.append(f"the arm was not identified: {self.not_identified}")
        return found


def compare_on_robot(
    arm: Arm,
    link: Link,
    controllers: Sequence[Controller | str],
    trajectory: JointTrajectory | None = None,
    *,
    identified: bool = False,
    speed: float = 0.2,
    tip_speed: float = 0.25,
    payload: float = 0.0,
    error_max: float | None = None,
    configurations: int = DEFAULT_CONFIGURATIONS,
    dwell: float = 1.0,
    recover: Callable[[str], bool] | None = None,
) -> RobotComparison:
    """Follows one motion under several laws on the robot behind a link, and in a simulation with the delay of the link.

    Before each run the robot's own servo brings the arm to the start of the motion, on a path that is proved free of contact.
    The robot is opened anew for each law. One that the link cannot bear, or that the robot cannot have, is not run: its report
    says why. After a fault the other laws are not run, unless `recover` says that the robot may move again.

    With `identified`, the arm is identified from one more run, under the law with the least error that follows it, of a motion
    that excites its parameters. The simulation then has the identified arm, and all laws that are given by name run again with
    it as their model, on the robot and in the simulation.

    Args:
        arm: The model.
        link: A link that takes torques, such as `armctl.links.Franka(host)` or `armctl.links.PlantLink(arm, plant)`.
        controllers: Controllers or names of controllers.
        trajectory: The motion; it is slowed down as far as the robot demands. By default all joints move out and back.
        identified: Whether to identify the arm and compare again.
        speed: Share of the full speed, as of a Robot, of all motions but a trajectory that is given.
        tip_speed: m/s, the greatest speed of the tip.
        payload: kg at the tip, which the robot is set to; controllers do not know it.
        error_max: rad, as of a Robot.
        configurations: Number of configurations at which delay margin and peak sensitivity are computed, with the model of
            the simulation; 0 for neither.
        dwell: s to hold the end of each motion.
        recover: A function that takes a fault of the robot, and returns whether it may move again, such as one that asks a
            person. By default it may not.

    Returns:
        A list with one report per run. Reports of the robot have its name as their plant.

    Raises:
        InputError: There is no controller, an argument of another type, or a number out of its bounds.
        UnknownNameError: There is no such controller.
        PlanError: Every motion touches something, or with `identified` every one that excites the parameters.
        ModelError: With `identified`: a joint follows another one, or no clearance can be proved.
        LinkError: The connection failed, or the robot does not come to the start of the motion.
    """
    check_arm(arm)
    check_link(link)
    if not isinstance(controllers, Sequence) or isinstance(controllers, str) or not controllers:
        raise InputError("controllers: expected a list of at least one, such as ['pd-gravity', 'computed-torque']")
    if trajectory is not None:
        instance("trajectory", trajectory, JointTrajectory, "armctl.move_j returns one")
    if recover is not None and not callable(recover):
        raise InputError("recover: expected a function that takes the fault and returns whether the robot may move again")
    identified = flag("identified", identified)
    configurations = integer("configurations", configurations, 0)
    dwell = number("dwell", dwell, 0.0)
    laws = _laws(arm, controllers)
    bench = _Bench(arm=arm, link=link, speed=speed, tip_speed=tip_speed, payload=payload, error_max=error_max, recover=recover)
    with bench.robot(None) as robot:
        motion = robot.slowed(out_and_back(robot.arm) if trajectory is None else trajectory)
    runs = bench.runs(laws, motion, dwell)
    estimate, not_identified = bench.identified(runs, motion) if identified else (None, "")
    known = arm if estimate is None or not estimate else estimate.applied_to(arm)
    name = "simulation" if known is arm else "simulation of the identified arm"
    plant = bench.plant(max((run.delay for run in runs if run.delay >= 0.0), default=0.0), payload if known is arm else 0.0)
    reports = _beside(runs, _LAWS_OF_MODEL, known, motion, replace(plant, name=name), configurations, dwell)
    if known is not arm:
        again = bench.runs(_laws(known, [given for given in controllers if isinstance(given, str)]), motion, dwell)
        plant = replace(plant, name=name + _LAWS_OF_IDENTIFIED)
        reports += _beside(again, _LAWS_OF_IDENTIFIED, known, motion, plant, configurations, dwell)
        runs += again
    delay = max((run.delay for run in runs if run.delay >= 0.0), default=np.nan)
    return RobotComparison(reports, delay, estimate, not_identified)


class _NamedLaw(NamedTuple):
    label: str  # tells apart what has the same name
    law: Controller


def _laws(arm: Arm, controllers: Sequence[Controller | str]) -> list[_NamedLaw]:
    """Controllers whose model is an arm, unless they are given as objects."""
    laws = [read_controller(each, arm) for each in controllers]
    return [_NamedLaw(*each) for each in zip(distinct_names(traits(law).name for law in laws), laws, strict=True)]


class _RobotRun(NamedTuple):
    named: _NamedLaw
    report: Report
    delay: float  # s, of the link, jitter included; NaN if it was not measured


@dataclass
class _Bench:
    """A robot on which one law after the other is tried."""

    arm: Arm
    link: Link
    speed: float
    tip_speed: float
    payload: float
    error_max: float | None
    recover: Callable[[str], bool] | None
    fault: str = ""  # why no further law may be run; empty if it may

    def robot(self, law: Controller | None) -> Robot:
        """The robot under a law, or else its own servo."""
        error_max = None if law is None else self.error_max
        return Robot(
            self.arm,
            self.link,
            speed=self.speed,
            tip_speed=self.tip_speed,
            payload=self.payload,
            allow_contact=False,
            controller=law,
            error_max=error_max,
        )

    def runs(self, laws: Sequence[_NamedLaw], motion: JointTrajectory, dwell: float) -> list[_RobotRun]:
        """A motion under each law, one after the other."""
        return [self._run(named, motion, dwell) for named in laws]

    def _run(self, named: _NamedLaw, motion: JointTrajectory, dwell: float) -> _RobotRun:
        if self.fault:
            return _RobotRun(named, self._not_run(named, motion, f"{_FURTHER_LAWS}: {self.fault}"), np.nan)
        self._go_to(motion(0.0).q)
        try:
            robot = self.robot(named.law)
        except ArmctlError as error:  # such as a law that this link cannot bear
            return _RobotRun(named, self._not_run(named, motion, str(error)), np.nan)
        with robot:
            # Under the law, so that the run begins where the law holds the arm.
            result = robot.move_j(motion(0.0).q)
            log = result.log if robot.fault else robot.run(motion, dwell)
            if robot.fault:
                self._ask(robot)
            failure = log.failure if log is not None else result.reason
            if log is None or not len(log):
                return _RobotRun(named, self._not_run(named, motion, failure), robot.delay)
            report = replace(Report.from_log(log), controller=named.label)
            return _RobotRun(named, report, robot.delay)

    def _ask(self, robot: Robot) -> None:
        """Recovers the robot after a fault, if that is allowed."""
        self.fault = robot.fault
        if self.recover is not None and self.recover(robot.fault):
            robot.recover()
            self.fault = robot.fault

    def _go_to(self, q: np.ndarray) -> None:
        """Brings the arm to a configuration with the robot's own servo, whose errors there do not count."""
        with self.robot(None) as robot:
            result = robot.move_j(q)
            if robot.fault or result.log is None or result.log.failure:
                raise LinkError(f"{self.link.name:.60} did not come to the start of the motion: {result.reason:.250}")

    def _not_run(self, named: _NamedLaw, motion: JointTrajectory, reason: str) -> Report:
        """The report of a run that did not begin."""
        run = RunInfo(
            controller=named.label,
            plant=f"robot: {self.link.name}",
            source=LogSource.ROBOT,
            continuous=True,
            torques=LogTorques.BOTH,
            dt=self.link.dt,
            motion_duration=motion.duration,
            target=NO_TARGET,
            wall_time=0.0,
            failure=reason,
        )
        arm = self.arm
        return Report.not_run(Recorder(arm.model, arm.actuation, ReferenceTips()).log(arm, run))

    def identified(self, runs: Sequence[_RobotRun], motion: JointTrajectory) -> tuple[ArmEstimate | None, str]:
        """What the robot's run of a motion that excites its parameters tells of the arm, and why it tells nothing if so."""
        followed = [run for run in runs if not run.report.log.failure]
        if self.fault or not followed:
            return None, self.fault or "no law followed the motion to its end"
        with self.robot(None) as robot:
            exciting = robot.slowed(excitation(robot.arm, for_="arm", start=motion(0.0).q))
        failure = ""
        for run in sorted(followed, key=lambda run: float(np.abs(run.report.log.q_ref - run.report.log.q).max())):
            if not self.fault:
                log = self._run(run.named, exciting, 0.0).report.log
                if not log.failure:
                    estimate = identify(self.arm, log)
                    return estimate, estimate.reason
                failure = log.failure
        return None, f"the run of a motion that excites its parameters failed: {failure}"

    def plant(self, delay: float, payload: float) -> Plant:
        """The plant that is like the robot, as far as its link tells; with the encoder of every comparison."""
        lag = 0.0 if self.link.torque is None else self.link.torque.lag
        plant = plant_behind_link(self.link.dt, delay, lag)
        return replace(plant, encoder_noise=WITH_ENCODER.encoder_noise, payload=payload)


def _beside(
    runs: Sequence[_RobotRun],
    laws: str,
    arm: Arm,
    motion: JointTrajectory,
    plant: Plant,
    configurations: int,
    dwell: float,
) -> list[Report]:
    """Reports of the robot, with the margins of the simulation, and then the reports of the simulation."""
    begun = [run for run in runs if len(run.report.log)]
    simulated: dict[str, Report] = {}
    if begun:
        found = compare(arm, [run.named.law for run in begun], motion, [plant], configurations=configurations, dwell=dwell)
        simulated = {
            run.named.label: replace(report, controller=run.named.label) for run, report in zip(begun, found, strict=True)
        }
    return [_of_robot(run, laws, simulated) for run in runs] + list(simulated.values())


def _of_robot(run: _RobotRun, laws: str, simulated: dict[str, Report]) -> Report:
    report = replace(run.report, plant=run.report.plant + laws)
    like = simulated.get(run.named.label)
    if like is None:
        return report
    return replace(
        report,
        delay_margin_s=like.delay_margin_s,
        peak_sensitivity=like.peak_sensitivity,
        damping_ratio=like.damping_ratio,
        slowest_pole_per_s=like.slowest_pole_per_s,
    )
