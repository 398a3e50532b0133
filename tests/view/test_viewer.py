"""A simulation that is watched: it shows all it does, in real time, and computes the same."""

import gzip
import time
import urllib.request
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from arms import BUNDLED, arm_of
from scipy.spatial import KDTree
from synthetic import limb, mjcf, motors

import armctl
from armctl import Simulation
from armctl.view.mesh_decimation import FINE_CELL, decimated
from armctl.view.realtime.clock import RealTimeClock
from armctl.view.web_scene import WebScene

pytest.importorskip("mjviser", reason="pip install -e '.[view]'")


@pytest.fixture(scope="module")
def watched():
    sim = Simulation(arm_of(BUNDLED), viewer=True)
    yield sim
    assert sim.viewer is not None
    sim.viewer.close()


def test_a_watched_move_takes_its_time_and_computes_the_same(watched: Simulation):
    plain = Simulation(arm_of(BUNDLED))
    started = time.perf_counter()
    result, other = watched.move_to(watched.target), plain.move_to(plain.target)
    took = time.perf_counter() - started
    assert result.log is not None
    assert other.log is not None
    for name in ("t", "q", "v", "tau", "tip"):
        np.testing.assert_array_equal(getattr(result.log, name), getattr(other.log, name))
    assert result.log.real_time_factor < 1.05 < other.log.real_time_factor
    assert took >= 0.95 * result.duration


def test_time_before_the_first_move_is_not_caught_up():
    clock = RealTimeClock()
    begun = time.perf_counter()
    clock.resume()
    assert clock._due >= begun


def test_the_page_draws_what_the_simulation_ended_with(watched: Simulation):
    watched.reset()
    watched.move_to([0.2, -0.2, 0.4])
    scene = watched.viewer.scene
    deadline = time.monotonic() + 10
    while scene._latest is not None and time.monotonic() < deadline:
        time.sleep(0.01)
    time.sleep(0.1)
    np.testing.assert_allclose(scene._drawing.data.qpos, watched.data.qpos, atol=2e-6)
    np.testing.assert_array_equal(scene._drawing.data.mocap_pos, watched.data.mocap_pos)


def test_it_says_where_it_is_and_how_fast_it_goes(watched: Simulation):
    assert watched.viewer.url.startswith("http://127.0.0.1:")
    watched.viewer._text_written_at = 0.0
    watched.viewer.after_reset(watched.data)
    assert "real time x" in watched.viewer.scene.text.content


# Two fine spheres; the cells of the grid are 5e-4 of the extent wide, here 0.1 m.
MESHES = """
<mujoco><statistic extent="200"/>
<asset><mesh name="one" builtin="sphere" params="4"/><mesh name="two" builtin="sphere" params="4" scale="2 1 1"/></asset>
<worldbody><geom type="mesh" mesh="one"/><geom type="mesh" mesh="two" pos="5 0 0"/></worldbody></mujoco>
"""


def test_a_simplified_model_looks_the_same():
    """Every vertex kept is one of the mesh's, none that is left out was further from one kept than a cell is wide."""
    model = mujoco.MjModel.from_xml_string(MESHES)
    light, cell = decimated(model), 5e-4 * model.stat.extent
    for mesh in range(model.nmesh):
        start, kept, count = model.mesh_vertadr[mesh], light.mesh_vertnum[mesh], model.mesh_vertnum[mesh]
        before, after = model.mesh_vert[start : start + count], light.mesh_vert[start : start + kept]
        assert kept < count
        assert KDTree(after).query(before[::50])[0].max() <= np.sqrt(3) * cell * 1.001
        first, faces = light.mesh_faceadr[mesh], light.mesh_facenum[mesh]
        assert 0 < faces <= model.mesh_facenum[mesh]
        assert light.mesh_face[first : first + faces].max() < kept


def test_the_tab_shows_the_title_and_a_narrow_page_the_whole_arm(watched: Simulation):
    for encoding in ("identity", "gzip"):
        request = urllib.request.Request(watched.viewer.url, headers={"Accept-Encoding": encoding})
        body = urllib.request.urlopen(request).read()
        page = gzip.decompress(body) if encoding == "gzip" else body
        assert b"<title>robot_arm_3dof - armctl</title>" in page
    scene = watched.viewer.scene
    wide = scene._view
    cameras = [SimpleNamespace(image_width=width, image_height=844, position=None, look_at=None) for width in (390, 1280)]
    for camera in cameras:
        scene._fit_narrow_page(SimpleNamespace(camera=camera))
    phone, desktop = cameras
    assert np.linalg.norm(phone.look_at - phone.position) > 1.5 * wide.distance
    assert phone.look_at[2] < wide.look_at[2]
    assert desktop.position is None


def test_coarse_meshes_come_first_and_fine_ones_replace_them():
    model = mujoco.MjModel.from_xml_string(MESHES)
    coarse = decimated(model, 10 * FINE_CELL)
    fine = decimated(model)
    assert coarse.mesh_facenum.sum() < 0.5 * fine.mesh_facenum.sum()
    scene = WebScene(0)
    try:
        scene.set(arm_of(BUNDLED))
        coarse_model = scene._drawing.model
        groups = len(scene._scene._mesh_groups)
        scene._refine()
        assert scene._drawing.model is not coarse_model
        assert scene._scene.mj_model is scene._drawing.model
        assert len(scene._scene._mesh_groups) == groups
        scene._refine()
    finally:
        scene.close()


def test_a_stick_figure_stands_in_until_a_browser_has_drawn_the_meshes():
    scene = WebScene(0)
    try:
        scene.set(arm_of(BUNDLED))
        sticks = scene._drawing.sticks

        def is_shown(meshes_drawn: int) -> bool:
            scene.devices.take(None, str(meshes_drawn))
            scene._show_sticks()
            return sticks.visible

        assert scene._drawing.bodies > 1
        assert [is_shown(drawn) for drawn in (0, scene._drawing.bodies, 0)] == [True, False, True]
        scene._sticks_until = 0.0
        assert not is_shown(0), "a browser that never says what it draws keeps the stick figure"
        scene._refine()
        assert is_shown(0), "while finer meshes are read, none are there"
    finally:
        scene.close()


def test_a_stick_figure_follows_the_arm_while_it_is_shown():
    arm = arm_of(BUNDLED)
    scene = WebScene(0)
    try:
        scene.set(arm)
        q = arm.home + 0.4
        scene.show(arm.qpos(q))
        scene.draw()
        ends = scene._drawing.sticks._lines.points
        assert np.abs(ends - arm.fk(q).position).max(axis=2).min() < 1e-6
    finally:
        scene.close()


def test_an_arm_without_shapes_stays_a_stick_figure():
    model = mjcf(limb("a b c").replace("<geom ", '<geom group="3" '), motors("a b c"))
    scene = WebScene(0)
    try:
        scene.set(armctl.load(mujoco.MjModel.from_xml_string(model)))
        scene.devices.take(None, "20")
        scene._sticks_until = 0.0
        scene._show_sticks()
        assert scene._drawing.sticks.visible
    finally:
        scene.close()


def test_without_a_viewer_there_is_none():
    assert Simulation(arm_of(BUNDLED)).viewer is None


def test_a_model_without_a_target_marker_has_a_page():
    arm = armctl.load(mujoco.MjModel.from_xml_string(mjcf(limb("a b c"), motors("a b c"))))
    scene = WebScene(0)
    try:
        scene.set(arm)
        scene.show_target(arm.home_qpos, arm.fk(arm.home))
        scene.draw()
        np.testing.assert_array_equal(scene._drawing.data.qpos, arm.home_qpos)
    finally:
        scene.close()
