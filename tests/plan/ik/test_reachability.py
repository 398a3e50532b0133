"""reachability: the map agrees with solve_ik, does not depend on threads, and survives its file."""

import numpy as np
import pytest
from arms import arm_of

import armctl
from armctl import InputError, Pose, Reachability
from armctl.plan.ik.problem import ik_chain
from armctl.plan.ik.solve_batch import solve_ik_batch

PLANAR_LINK = """<body pos="{x} 0 0"><joint name="j{i}" axis="0 1 0" range="-3 3"/>
<geom type="capsule" fromto="0 0 0 {length} 0 0" size="0.01" mass="1" contype="0" conaffinity="0"/>"""
PLANAR = f"""<mujoco><compiler angle="radian"/><worldbody>
{PLANAR_LINK.format(x=0, i=0, length=0.3)}{PLANAR_LINK.format(x=0.3, i=1, length=0.25)}<site name="tip" pos="0.25 0.07 0"/>
</body></body></worldbody>
<actuator><motor joint="j0" ctrlrange="-9 9"/><motor joint="j1" ctrlrange="-9 9"/></actuator></mujoco>"""


@pytest.fixture(scope="module")
def small() -> Reachability:
    return armctl.reachability(armctl.load("robot_arm_3dof"), 0.2)


def test_the_points_reached_are_those_that_solve_ik_batch_reaches(small):
    arm = armctl.load("robot_arm_3dof")
    reached = solve_ik_batch(arm, small.points).ok
    assert 10 < reached.sum() < len(reached) - 10
    assert np.array_equal(small.fraction > 0, reached)
    assert small.volume == pytest.approx(reached.sum() * 0.2**3)


def test_the_manipulability_is_at_most_that_of_any_configuration_and_positive_where_reached(small):
    arm = armctl.load("robot_arm_3dof")
    assert ((small.manipulability > 0) == (small.fraction > 0)).all()
    J = [arm.jacobian(q)[:3] for q in arm.limits.random(arm.home, 4000, np.random.default_rng(0))]
    highest = max(np.sqrt(np.linalg.det(each @ each.T)) for each in J)
    assert 0.5 * highest < small.manipulability.max() < 1.02 * highest


def test_the_fraction_of_orientations_is_what_solve_ik_batch_reaches():
    arm = arm_of("ur5e")
    found = armctl.reachability(arm, 0.3, 6, [(0.1, 0.1, 0.1), (1.0, 1.0, 0.8)])
    turns = [Pose([0, 0, 0], quat=each).rotation for each in found.orientations]
    T = np.tile(np.eye(4), (len(found.points) * 6, 1, 1))
    T[:, :3, :3] = np.tile(turns, (len(found.points), 1, 1))
    T[:, :3, 3] = np.repeat(found.points, 6, axis=0)
    fraction = solve_ik_batch(arm, T).ok.reshape(-1, 6).mean(axis=1)
    assert 0 < fraction.mean() < 1
    assert np.array_equal(found.fraction, fraction)


def test_orientations_of_an_arm_without_closed_form_are_searched():
    arm = arm_of("robot_arm_3dof")
    found = armctl.reachability(arm, 0.2, 4, [(0.0, -0.3, 0.3), (0.6, 0.3, 0.9)])
    turns = [Pose([0, 0, 0], quat=each).rotation for each in found.orientations]
    T = np.tile(np.eye(4), (len(found.points) * 4, 1, 1))
    T[:, :3, :3] = np.tile(turns, (len(found.points), 1, 1))
    T[:, :3, 3] = np.repeat(found.points, 4, axis=0)
    assert np.array_equal(found.fraction, solve_ik_batch(arm, T).ok.reshape(-1, 4).mean(axis=1))


def test_the_result_does_not_depend_on_the_number_of_threads(small):
    alone = armctl.reachability(armctl.load("robot_arm_3dof"), 0.2, threads=1)
    assert alone.fraction.tobytes() == small.fraction.tobytes()
    assert alone.manipulability.tobytes() == small.manipulability.tobytes()


def test_a_saved_map_is_read_back_and_another_file_is_refused(small, tmp_path):
    small.save(tmp_path / "reach.npz")
    again = Reachability.load(tmp_path / "reach.npz")
    assert str(again) == str(small)
    assert again.to_dict() == small.to_dict()
    assert again.points.tobytes() == small.points.tobytes()
    np.savez(tmp_path / "other.npz", points=np.zeros((1, 3)))
    with pytest.raises(InputError, match=r"other\.npz: no map that Reachability\.save wrote"):
        Reachability.load(tmp_path / "other.npz")


def test_the_cloud_and_the_plot_show_the_points_reached(small, tmp_path):
    points, colours = small.cloud("manipulability")
    assert len(points) == len(colours) == (small.fraction > 0).sum()
    assert colours[small.manipulability[small.fraction > 0].argmax()].tolist() == [253, 231, 37]
    assert small.plot(tmp_path / "reach.png").stat().st_size > 1000
    with pytest.raises(InputError, match=r"^values: expected one of fraction, manipulability, got 'volume'$"):
        small.cloud("volume")


def test_where_nothing_is_reached_there_is_a_reason():
    found = armctl.reachability(armctl.load("robot_arm_3dof"), 0.1, region=[(5.0, 5.0, 5.0), (5.1, 5.1, 5.1)])
    assert not found
    assert found.reason == f"none of {len(found.points)} points is reachable"
    assert found.to_dict()["mean_fraction"] == 0.0


def test_corners_of_a_region_that_lie_on_the_grid_are_points_of_it():
    arm = armctl.load("robot_arm_3dof")
    centre = ik_chain(arm).base
    found = armctl.reachability(arm, 0.1, region=[centre - 0.3, centre + 0.3])
    assert len(found.points) == 7**3


def test_an_arm_that_moves_in_a_plane_has_a_grid_in_that_plane(tmp_path):
    path = tmp_path / "planar.xml"
    path.write_text(PLANAR)
    arm = armctl.load(path)
    whole = armctl.reachability(arm, 0.1)
    assert whole
    assert np.unique(whole.points[:, 1]) == pytest.approx([0.07])
    area = (whole.fraction > 0).sum() * 0.1**2
    assert f"{area:.3g} m^2" in str(whole)
    assert whole.plot(tmp_path / "layer.png").stat().st_size > 1000
    box = armctl.reachability(arm, 0.1, region=[(-0.7, -0.5, -0.7), (0.7, 0.5, 0.7)])
    assert (box.fraction > 0).sum() == (whole.fraction > 0).sum()
    thin = armctl.reachability(arm, 0.1, region=[(0.21, 0.0, -0.7), (0.21, 0.1, 0.7)])
    assert np.unique(thin.points[:, 0]) == pytest.approx([0.21])
    assert thin


def test_a_wrong_call_is_one_sentence():
    arm = armctl.load("robot_arm_3dof")
    with pytest.raises(InputError, match=r"^spacing: 1e-06 m makes .* points, expected at most 2000000$"):
        armctl.reachability(arm, 1e-6)
    with pytest.raises(InputError, match=r"^region: expected two opposite corners, shape \(2, 3\), m, got shape \(1, 3\)$"):
        armctl.reachability(arm, 0.1, region=[(0.0, 0.0, 0.0)])


def test_the_manipulability_of_a_point_is_that_of_its_best_orientation():
    """Between the worst and the best configuration of the orientation whose configurations are best."""
    arm = arm_of("six joints")
    place = arm.fk(arm.home).position
    found = armctl.reachability(arm, 0.3, 40, [place, place])
    assert found.points == pytest.approx(place[None])
    worst = []
    best = []
    for quat in found.orientations:
        solutions = armctl.solve_ik_all(arm, Pose(place, quat=quat))
        if solutions.ok.all():
            J = np.array([arm.jacobian(q) for q in solutions.q])
            values = np.abs(np.linalg.det(J))
            worst.append(values.min())
            best.append(values.max())
    assert 4 < len(best) < 40
    assert max(worst) * (1 - 1e-3) <= found.manipulability[0] <= max(best) * (1 + 1e-3)
