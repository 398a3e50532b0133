"""A tour of armctl on one robot: a self-contained page of programs, each beside what it gave."""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from armctl.core.atomic import write_text
from armctl.core.errors import ArmctlWarning
from armctl.core.plotting import figure_svg
from armctl.core.progress import progress_bar
from armctl.lab.comparison import marked_table
from armctl.lab.loops.loop_figures import LOOP_SIZE_INCHES, draw_loop
from armctl.lab.loops.margins_html import margins_table
from armctl.model.arm.arm import Arm
from armctl.report import html_page
from armctl.report.film_html import film_html
from armctl.report.plot import draw_overlay

_TURN_RAD = 1.2  # of the first joint, around the obstacle
_OBSTACLE_SHARE = 0.2  # its width as a share of the way of the tip
_PAYLOAD_SHARE = 0.05  # of the mass of the arm
_FILM_PX = (480, 360)
_OVERLAY_SIZE_INCHES = (13.0, 5.0)


class Stop(NamedTuple):
    """A program of the tour, and the elements of the page that show what its variables hold after it."""

    title: str
    sentence: str
    program: str
    show: Callable[[Mapping[str, Any]], list[str]]
    has_table: bool = False  # a table of the page stands for what the program prints


def write_tour(arm: Arm, robot: str, path: Path) -> Path:
    """Runs the programs of the tour and writes the page atomically.

    Args:
        arm: The arm of the tour.
        robot: What the programs load: the name or the file of the arm.
        path: The page, .html.
    """
    stops = tour_of(arm, robot)
    elements = []
    with progress_bar("tour", len(stops), "programs") as bar:
        for stop in stops:
            variables: dict[str, Any] = {}
            printed = io.StringIO()
            with contextlib.redirect_stdout(printed), warnings.catch_warnings():
                warnings.simplefilter("ignore", ArmctlWarning)  # they were shown when the arm was loaded
                exec(compile(stop.program, f"<{stop.title}>", "exec"), variables)  # the page shows what ran
            elements += [html_page.heading(stop.title), html_page.paragraph(stop.sentence), *stop.show(variables)]
            elements.append(html_page.program(stop.program))
            if not stop.has_table:
                elements += [html_page.paragraph("prints"), html_page.program(printed.getvalue())]
            bar.update()
    last = f"Drag the target yourself: armctl view {robot}"
    write_text(path, html_page.page(f"armctl on {arm.name}", *elements, html_page.heading(last)))
    return path


def tour_of(arm: Arm, robot: str) -> list[Stop]:
    """The stops of a tour with an arm, which the programs load by the name or the file `robot`."""
    goal = _turned(arm)
    middle = arm.fk(0.5 * (arm.home + goal)).position
    width = _OBSTACLE_SHARE * float(np.linalg.norm(arm.fk(goal).position - arm.fk(arm.home).position))
    payload = _PAYLOAD_SHARE * float(arm.model.body_subtreemass[arm.model.body_rootid[arm.tip_body]])
    load = f"import armctl\n\narm = armctl.load({robot!r})\n"
    return [
        Stop(
            "Reach",
            "The tip goes to the green target, within all limits.",
            f"import armctl\n\nsim = armctl.Simulation({robot!r})\nresult = sim.move_to(sim.target)\nprint(result)\n",
            lambda found: [film_html(found["sim"].log, found["sim"].arm, size=_FILM_PX)],
        ),
        Stop(
            "Around an obstacle",
            "move_free plans a motion without contact, and proves it for the whole time.",
            "import armctl\n\n"
            "world = armctl.World()\n"
            f'world.add("box", armctl.Box({_rounded(np.full(3, width))}), at={_rounded(middle)})\n'
            f"arm = armctl.load({robot!r}, scene=world)\n"
            f"motion = armctl.move_free(arm, arm.home, {_rounded(goal)})\n"
            'log = armctl.simulate(arm, "computed-torque", motion)\n'
            "print(armctl.check_clearance(arm, motion))\n",
            lambda found: [film_html(found["log"], found["arm"], size=_FILM_PX)],
        ),
        Stop(
            "An unknown payload",
            f"Neither controller knows of {payload:.2g} kg at the tip. The second one observes it.",
            f"{load}plant = armctl.Plant(payload={payload:.2g}, encoder_noise=1e-5)\n"
            'controllers = ["computed-torque", "computed-torque-observer"]\n'
            "reports = armctl.compare(arm, controllers, armctl.out_and_back(arm), [plant], configurations=0)\n"
            "print(reports)\n",
            _compared,
            has_table=True,
        ),
        Stop(
            "PD beside computed torque",
            "Both follow the same motion with their default gains, whose delay margins are in the table. For equal margins: "
            "armctl compare --delay-margin.",
            f"{load}plant = armctl.Plant(encoder_noise=1e-5)\n"
            'controllers = ["pd-gravity", "computed-torque"]\n'
            "reports = armctl.compare(arm, controllers, armctl.out_and_back(arm), [plant])\n"
            "print(reports)\n",
            _compared,
            has_table=True,
        ),
        Stop(
            "Margins",
            "How much delay, gain and phase a controller bears before the arm vibrates, over the workspace.",
            f'{load}found = armctl.margins(arm, "computed-torque")\n'
            "loop = armctl.linearize(arm, found.controller, found.delay.q)\n"
            "print(found)\n",
            lambda found: [
                html_page.table(margins_table([found["found"]])),
                figure_svg(lambda figure: draw_loop(figure, found["loop"]), LOOP_SIZE_INCHES),
            ],
            has_table=True,
        ),
    ]


def _turned(arm: Arm) -> np.ndarray:
    """Joint angles (n,) with the first joint turned, to the side on which there is more room."""
    q = np.array(arm.home)
    room = np.array([arm.limits.q_min[0] - q[0], arm.limits.q_max[0] - q[0]])
    farther = room[np.argmax(np.abs(room))]
    q[0] += np.sign(farther) * min(_TURN_RAD, 0.9 * abs(farther))
    return q


def _rounded(values: np.ndarray) -> list[float]:
    return [round(float(value), 3) for value in values]


def _compared(found: Mapping[str, Any]) -> list[str]:
    reports = found["reports"]
    overlay = figure_svg(lambda figure: draw_overlay(figure, [report.log for report in reports]), _OVERLAY_SIZE_INCHES)
    return [html_page.table(marked_table(reports)), overlay]
