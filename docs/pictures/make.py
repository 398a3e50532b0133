"""Draws the pictures of README and docs afresh: `make pictures`. What it cannot draw here it names, and exits with 1."""

from __future__ import annotations

import io
import runpy
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import matplotlib
import mujoco
import numpy as np
from matplotlib.figure import Figure
from PIL import Image as Picture

import armctl
from armctl.core.plotting import COLORS, STYLE, finish_figure
from armctl.lab.comparison import compare, out_and_back
from armctl.lab.tour import write_tour
from armctl.report.plot import overlay
from armctl.report.render import record
from armctl.view.realtime.status import Activity

if TYPE_CHECKING:
    from armctl.view.page import Page
    from armctl.view.realtime.session import RealTimeSession

HERE = Path(__file__).parent
ARM_SPEED_SLIDER = 1  # of the page's sliders, after that of the payload
DRAG_PAGE_PX = (940, 470)
DRAG_WIDTH_PX = 552  # of the page, without its panel
DRAG_FRAMES_PER_S = 12
DRAG_MAX_FRAMES = 150
DRAG_ARROW_M = 0.11  # from the target to the middle of the arrow's tip
TOUR_PAGE_PX = (760, 640)
TOUR_FRAMES_PER_S = 6
TOUR_DRAWING_MS = 200
TOUR_FRAMES_PER_STOP = 14
# Stops all films of a page, and lets the browser seek in them, which it does not in data within the page.
TOUR_STOP_FILMS = """() => Promise.all([...document.querySelectorAll("video")].map(async (film) => {
  film.autoplay = film.controls = film.loop = false;
  film.src = URL.createObjectURL(await (await fetch(film.src)).blob());
  await new Promise((done) => { film.onloadeddata = done; film.load(); });
}))"""
# Shows all films of a page at a time, s, once they have that picture.
TOUR_SHOW_FILMS = """(time) => Promise.all([...document.querySelectorAll("video")].map((film) => new Promise((done) => {
  film.onseeked = done;
  film.currentTime = Math.min(time, film.duration - 0.01);
  setTimeout(done, 2000);
})))"""
# The page has shadows where the browser says that it draws with a graphics card.
GRAPHICS_CARD = """
const parameter = WebGLRenderingContext.prototype.getParameter;
WebGLRenderingContext.prototype.getParameter = function (name) {
  const card = this.getExtension("WEBGL_debug_renderer_info").UNMASKED_RENDERER_WEBGL;
  return name === card ? "graphics card" : parameter.call(this, name);
};
"""
# A browser without a screen shows no mouse cursor: an arrow that follows the events of the mouse.
CURSOR = """() => {
  const cursor = document.createElement("div");
  const arrow = "M2 2 L2 19 L7 15 L10 22 L13 20.5 L10 14 L16 14 Z";
  cursor.innerHTML = `<svg width="24" height="24"><path d="${arrow}" stroke="white"/></svg>`;
  cursor.style = "position: fixed; z-index: 9999; pointer-events: none";
  document.body.append(cursor);
  document.addEventListener("pointermove", (event) => {
    cursor.style.left = event.clientX + "px";
    cursor.style.top = event.clientY + "px";
  }, true);
}"""


def shelf() -> None:
    """A Panda reaches into a shelf and from one compartment into the other, around the boards."""
    scene = armctl.World()
    for name, height in (("lower", 0.25), ("middle", 0.6), ("upper", 0.95)):
        scene.add(name, armctl.Box([0.3, 0.8, 0.02]), [0.85, 0.0, height])
    sim = armctl.Simulation(armctl.load("panda", scene=scene))
    forwards = np.column_stack([[0, 0, -1], [0, 1, 0], [1, 0, 0]])
    moves = []
    for y, z in ((-0.2, 0.42), (0.2, 0.77)):
        start = sim.state.q
        pose = armctl.Pose.from_rotation([0.74, y, z], forwards)
        moves.append(armctl.move_free(sim.arm, start, pose, speed=0.5))
        sim.reset(moves[-1](moves[-1].duration).q)
    sim.reset()
    log = sim.run(moves[0].then(moves[1]))
    record(log, sim.arm, HERE / "shelf.gif", size=(400, 300), quality="fast", speed=0.75)


def humanoid() -> None:
    """A humanoid at its keyframe, and reaching with both hands while its feet stay: the start and the end of an example."""
    run = runpy.run_path(str(HERE.parents[1] / "examples" / "67_a_humanoid_reaches.py"))
    robot = run["robot"]
    data = mujoco.MjData(robot.model)
    camera = mujoco.MjvCamera()
    camera.lookat[:] = [0.1, 0.0, 0.85]
    camera.distance, camera.azimuth, camera.elevation = 3.0, 130.0, -8.0
    robot.model.vis.global_.offwidth, robot.model.vis.global_.offheight = 900, 1000
    pictures = []
    with mujoco.Renderer(robot.model, 1000, 900) as renderer:
        for q in (robot.home, run["q"]):
            data.qpos[:] = robot.qpos(q)
            mujoco.mj_forward(robot.model, data)
            renderer.update_scene(data, camera)
            pictures.append(renderer.render())
    Picture.fromarray(np.hstack(pictures)).resize((900, 500)).save(HERE / "humanoid.png")


def four_panels() -> None:
    """A run as curves over time."""
    sim = armctl.Simulation("robot_arm_3dof")
    armctl.Report.from_log(sim.move_to([0.3, 0.2, 0.3]).log).plot(HERE / "four_panels.png")


def loop() -> None:
    """The loop of an arm and PD, with a delay."""
    arm = armctl.load("robot_arm_3dof")
    armctl.linearize(arm, "pd", arm.home, armctl.Plant(delay=2)).plot(HERE / "loop.png")


def pd_against_computed_torque() -> None:
    """The same motion of a UR5e under PD and under computed torque, with and without a payload that neither knows of."""
    arm = armctl.load("ur5e")
    plants = [armctl.Plant(), armctl.Plant(payload=2.0)]
    logs = [r.log for r in compare(arm, ["pd", "computed-torque"], out_and_back(arm), plants)]
    labels = [f"{name}{burden}" for burden in ("", ", 2 kg unknown") for name in ("PD", "computed torque")]
    overlay(logs, HERE / "pd_against_computed_torque.png", labels=labels)


def waypoints() -> None:
    """The same waypoints, stopping at each and flowing through."""
    arm = armctl.load("panda")
    rng = np.random.default_rng(3)
    points = [arm.home]
    for _ in range(6):
        points.append(arm.limits.clamp(points[-1] + rng.uniform(-0.8, 0.8, arm.n)))
    stopping = armctl.move_j(arm, points[0], points[1])
    for start, goal in pairwise(points[1:]):
        stopping = stopping.then(armctl.move_j(arm, start, goal))
    flowing = armctl.move_through(arm, np.array(points))
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(8, 5), layout="constrained")
        for ax, motion, title in zip(
            figure.subplots(2, 1, sharex=True), (stopping, flowing), ("stopping", "flowing"), strict=True
        ):
            t = np.linspace(0.0, motion.duration, 1000)
            speed = motion.sample(t).v / arm.limits.v_max
            for i, name in enumerate(arm.joint_names):
                ax.plot(t, speed[:, i], color=COLORS[i], label=name if motion is flowing else None, linewidth=1.2)
            ax.set_title(f"{title}: {motion.duration:.2f} s through {len(points)} waypoints; joint speeds, share of the limit")
            ax.set_ylim(-1.05, 1.05)
        ax.set_xlabel("time, s")
        figure.legend(loc="outside lower center", ncols=7)
        figure.savefig(HERE / "waypoints.png")


def study() -> None:
    """The plots of the study that examples/80_a_thousand_runs.py makes."""
    runpy.run_path(str(HERE.parents[1] / "examples" / "80_a_thousand_runs.py"))
    for path in Path("out").glob("study_*.png"):
        shutil.move(path, HERE / path.name)


def polish() -> None:
    """The contact force of a tool that slides over a cylinder, and its height."""
    run = runpy.run_path(str(HERE.parents[1] / "examples" / "47_polish.py"))
    log = run["log"]

    def panels(figure: Figure) -> None:
        axes = figure.subplots(2, 1, sharex=True)
        axes[0].plot(log.t, run["force"], color=COLORS[0], linewidth=0.8)
        axes[0].axhline(run["FORCE"], color="#555555", linestyle=(0, (4, 3)), linewidth=0.9)
        axes[0].set_title("contact force, N; dashed: target")
        axes[1].plot(log.t, 1e3 * log.tip_ref[:, 2], color="#555555", linestyle=(0, (4, 3)), linewidth=0.9)
        axes[1].plot(log.t, 1e3 * log.tip[:, 2], color=COLORS[1])
        axes[1].set_title("height of the tip, mm; dashed: planned")
        axes[1].set_xlabel("time, s")

    finish_figure(panels, (8, 5), HERE / "polish.png")


class Browser(NamedTuple):
    """A page of armctl and the tab of a browser that shows it."""

    page: Page
    tab: Any


@contextmanager
def browser(arm: armctl.Arm, width: int, height: int) -> Iterator[Browser]:
    """The page of `armctl view` in a browser that draws in software, with the arm at its first target."""
    from playwright.sync_api import sync_playwright

    from armctl.view.page import Page
    from armctl.view.web_scene import WebScene

    page = Page(arm, WebScene(0))
    threading.Thread(target=page.serve, daemon=True).start()
    software = "--no-sandbox --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader --ignore-gpu-blocklist"
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=software.split())
        tab = chromium.new_page(viewport={"width": width, "height": height})
        tab.add_init_script(GRAPHICS_CARD)
        tab.goto(page.url)
        tab.get_by_text("at the target").first.wait_for(timeout=60e3)
        tab.add_style_tag(content=".mantine-Notifications-root { display: none }")  # that software draws is no news here
        yield Browser(page, tab)
        chromium.close()
    page.close()


def page() -> None:
    """`armctl view panda` in a browser, with a wall: the arm is on its planned path to the dropped target."""
    scene = armctl.World()
    scene.add("wall", armctl.Box([0.3, 0.04, 0.5]), [0.5, 0.2, 0.25])
    with browser(armctl.load("panda", scene=scene), 1280, 800) as (page, tab):
        session = page.session
        downwards = session.status.target.quat
        for position in ([0.5, 0.45, 0.25], [0.5, -0.05, 0.25]):
            session.aim(armctl.Pose(position, quat=downwards))
            time.sleep(4)
            tab.get_by_text("at the target").first.wait_for(timeout=60e3)
        # The arm is slow, so that it is still on its way when the browser, which draws in software, has caught up.
        speed = tab.get_by_role("slider").nth(ARM_SPEED_SLIDER)
        for key in ("Home", *10 * ("ArrowRight",)):
            speed.press(key, timeout=60e3)
        speed.evaluate("slider => slider.blur()")
        session.aim(armctl.Pose([0.5, 0.45, 0.25], quat=downwards))
        while session.status.path is None:
            time.sleep(0.01)
        time.sleep(4)
        tab.screenshot(path=HERE / "page.png", timeout=60e3)


def drag() -> None:
    """The page of `armctl view panda`: a mouse drags the target behind a box, drops it, and the arm goes around the box."""
    scene = armctl.World()
    scene.add("box", armctl.Box([0.35, 0.06, 0.4]), [0.5, 0.15, 0.2])
    frames = []
    with browser(armctl.load("panda", scene=scene), *DRAG_PAGE_PX) as (page, tab):
        session = page.session
        start = np.array([0.5, 0.4, 0.25])
        session.aim(armctl.Pose(start, rpy=[np.pi, 0.0, 0.0]))
        time.sleep(4)
        tab.get_by_text("at the target").first.wait_for(timeout=60e3)
        time.sleep(12)  # until the fine meshes are there
        tab.evaluate(CURSOR)
        session.set_speed_override(0.5)
        arrow = start + np.array([0.0, DRAG_ARROW_M, 0.0])
        handle = on_screen(page, tab, arrow)
        drop = on_screen(page, tab, arrow - np.array([0.0, 0.52, 0.0]))
        for share in np.linspace(1.0, 0.0, 6):
            tab.mouse.move(*(handle + share * np.array([60.0, 40.0])))
            frames.append(next_frame(session, tab))
        tab.mouse.down()
        for share in np.linspace(0.0, 1.0, 26):
            tab.mouse.move(*(handle + share * (drop - handle)))
            frames.append(next_frame(session, tab))
        if not page.is_target_held:
            raise RuntimeError("the mouse missed the arrow of the target")
        frames += [next_frame(session, tab) for _ in range(6)]
        tab.mouse.up()
        while session.status.path is None and session.status.activity is not Activity.BLOCKED:
            time.sleep(0.01)
        while session.status.activity is not Activity.AT_TARGET and len(frames) < DRAG_MAX_FRAMES:
            frames.append(next_frame(session, tab))
        frames += [next_frame(session, tab) for _ in range(DRAG_FRAMES_PER_S)]
    film = [Picture.fromarray(frame) for frame in frames]
    interval_ms = round(1000 / DRAG_FRAMES_PER_S)
    film[0].save(HERE / "drag.webp", save_all=True, append_images=film[1:], duration=interval_ms, loop=0, quality=80)


def tour() -> None:
    """The page of `armctl tour panda` in a browser, from stop to stop; its films play."""
    from playwright.sync_api import sync_playwright

    frames = []
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        path = write_tour(armctl.load("panda"), "panda", Path(folder) / "tour.html")
        chromium = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        tab = chromium.new_page(viewport=dict(zip(("width", "height"), TOUR_PAGE_PX, strict=True)))
        tab.goto(path.as_uri())
        tab.evaluate(TOUR_STOP_FILMS)
        stops = tab.locator("h2").all()[:-1]
        for stop in stops:
            stop.evaluate("heading => heading.scrollIntoView()")
            for k in range(TOUR_FRAMES_PER_STOP):
                tab.evaluate(TOUR_SHOW_FILMS, 0.5 * k / TOUR_FRAMES_PER_S)  # in slow motion
                tab.wait_for_timeout(TOUR_DRAWING_MS)
                frames.append(Picture.open(io.BytesIO(tab.screenshot())).convert("RGB"))
        chromium.close()
    interval_ms = round(1000 / TOUR_FRAMES_PER_S)
    frames[0].save(HERE / "tour.webp", save_all=True, append_images=frames[1:], duration=interval_ms, loop=0, quality=70)


def next_frame(session: RealTimeSession, tab: Any) -> np.ndarray:
    """The scene of a page one frame later, (height, width, 3).

    The simulation runs in slow motion until then, and almost stands meanwhile, because the browser draws in software.
    """
    due = session.status.elapsed + 1 / DRAG_FRAMES_PER_S
    session.set_speed(0.1)
    while session.status.elapsed < due:
        time.sleep(0.005)
    session.set_speed(0.001)
    time.sleep(0.4)
    clip = {"x": 0, "y": 0, "width": DRAG_WIDTH_PX, "height": DRAG_PAGE_PX[1]}
    return np.asarray(Picture.open(io.BytesIO(tab.screenshot(clip=clip, timeout=60e3))).convert("RGB"))


def on_screen(page: Page, tab: Any, point: np.ndarray) -> np.ndarray:
    """(2,) where a point (3,) of the world is in the tab, pixels."""
    box = tab.locator("canvas").first.bounding_box()
    (client, *_) = page.scene.server.get_clients().values()
    eye = np.array(client.camera.position)
    forward = np.array(client.camera.look_at) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    way = point - eye
    scale = box["height"] / 2 / np.tan(client.camera.fov / 2) / (way @ forward)
    x = box["x"] + box["width"] / 2 + scale * (way @ right)
    y = box["y"] + box["height"] / 2 - scale * (way @ np.cross(right, forward))
    return np.array([x, y])


def draw(picture: Callable[[], None]) -> bool:
    """Draws one, or says why not."""
    try:
        picture()
    except (armctl.ArmctlError, ImportError) as error:
        print(f"{picture.__name__}: not drawn: {error}", file=sys.stderr)
        return False
    print(f"{picture.__name__}: drawn")
    return True


if __name__ == "__main__":
    wanted = [drag, tour, shelf, humanoid, four_panels, loop, pd_against_computed_torque, waypoints, study, polish, page]
    chosen = [picture for picture in wanted if not sys.argv[1:] or picture.__name__ in sys.argv[1:]]
    drawn = [draw(picture) for picture in chosen]
    sys.exit(0 if all(drawn) else 1)
