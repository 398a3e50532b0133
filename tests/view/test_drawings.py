"""What the page draws, number by number: arrows of contacts, the trail of the tip, and the charts."""

from types import SimpleNamespace

import numpy as np
import pytest
from arms import BUNDLED, arm_of

from armctl.core.pose import Pose
from armctl.view.charts import Charts
from armctl.view.drawings import ContactArrows, TipTrail
from armctl.view.page import Demonstration
from armctl.view.realtime.history import HistorySamples
from armctl.view.realtime.session import RealTimeSession
from armctl.view.realtime.status import Activity

EPSILON = 1e-6  # points are sent as float32


class Paper:
    """A scene and a panel that keep what is drawn on them."""

    def __init__(self):
        self.gui = self
        self.plots = []

    def add_arrows(self, name, points, color, **_):
        self.arrows = SimpleNamespace(points=points, remove=lambda: setattr(self, "arrows", None))
        return self.arrows

    def add_line_segments(self, name, points, color, **_):
        self.line = SimpleNamespace(points=points)
        return self.line

    def add_uplot(self, data, series, **_):
        self.plots.append(SimpleNamespace(data=data, labels=[each["label"] for each in series]))
        return self.plots[-1]

    def add_html(self, content):
        return SimpleNamespace(content=content)


@pytest.fixture
def paper() -> Paper:
    return Paper()


def test_an_arrow_has_a_centimetre_for_each_newton_and_at_most_thirty(paper):
    arrows = ContactArrows(paper, "")
    arrows.visible = True
    points = np.array([[0.1, 0.2, 0.3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    forces = np.array([[0.0, 3.0, 4.0], [-200.0, 0.0, 0.0], [0.0, 0.0, 0.01]])  # 5 N, 200 N, and one too weak to be shown
    arrows.show(np.stack([points, forces], axis=1))
    expected = [[[0.1, 0.2, 0.3], [0.1, 0.23, 0.34]], [[1.0, 0.0, 0.0], [0.7, 0.0, 0.0]]]
    assert paper.arrows.points == pytest.approx(np.array(expected), abs=EPSILON)
    arrows.show(np.zeros((0, 2, 3)))
    assert paper.arrows is None


def test_the_trail_ends_at_the_tip_and_forgets_its_oldest_piece(paper):
    trail = TipTrail(paper, np.zeros(3), "")
    way = np.outer(np.arange(1, 401), [0.005, 0.0, 0.0])
    for position in way:
        trail.add(position)
    trail.draw()
    assert paper.line.points.shape == (300, 2, 3)
    assert paper.line.points[:, 1] == pytest.approx(way[-300:], abs=EPSILON)
    assert paper.line.points[:, 0] == pytest.approx(way[-301:-1], abs=EPSILON)
    trail.add(way[-1] + 1e-3)  # too near to be drawn
    trail.draw()
    assert paper.line.points[-1, 1] == pytest.approx(way[-1], abs=EPSILON)
    trail.add(way[-1] + 1.0)  # a reset, not a motion
    trail.draw()
    assert paper.line.points == pytest.approx(np.broadcast_to(way[-1] + 1.0, (300, 2, 3)), abs=EPSILON)


def test_the_charts_show_millimetres_percents_and_the_age_of_each_sample(paper):
    t = 0.1 * np.arange(21) + 5.0
    to_target = np.linspace(0.2, 0.1, 21)
    to_target[:9] = np.nan  # before the session began
    to_reference = np.full(21, 2e-3)
    share = np.stack([np.linspace(-1.0, 1.0, 21), np.full(21, 0.25)], axis=1)
    samples = HistorySamples(t, to_target, to_reference, share)
    charts = Charts(paper, ("first", "second"), samples)
    errors, torques = paper.plots
    rows = [12, 16, 20]  # each fourth up to the last one
    assert errors.data[0] == pytest.approx(t[rows] - t[-1])
    assert errors.data[1] == pytest.approx(1e3 * to_target[rows])
    assert errors.data[2] == pytest.approx([2.0] * 3)
    assert charts.shown_reference_error_mm == pytest.approx(2.0)
    assert torques.data[1] == pytest.approx(np.maximum(100.0 * np.abs(share[rows, 0]), 25.0))
    assert torques.data[2] == pytest.approx([100.0] * 3)


def test_a_demonstration_that_something_blocks_ends_where_it_began():
    start = Pose([0.3, 0.0, 0.4])
    status = SimpleNamespace(targets={"tip": start}, aimed=("tip",), activity=Activity.AT_TARGET, paused=False)
    aimed = []

    def aim(target: Pose, tip: str, held: bool = False) -> None:
        aimed.append((target, held))
        status.targets = {tip: target}

    model = SimpleNamespace(stat=SimpleNamespace(extent=1.0))
    session = SimpleNamespace(status=status, arm=SimpleNamespace(model=model), hand_tip="tip", aim=aim)
    demonstration = Demonstration(session)  # type: ignore[arg-type]
    demonstration.advance(0.0)
    demonstration.advance(2.0)
    assert aimed[-1][1], "the target goes round as if it were dragged"
    status.activity = Activity.BLOCKED
    demonstration.advance(3.0)
    assert aimed[-1] == (start, False)
    assert demonstration.is_over


@pytest.mark.full
def test_the_demonstration_goes_round_and_comes_back_until_somebody_aims_elsewhere():
    arm = arm_of(BUNDLED)
    session = RealTimeSession(arm)
    demonstration = Demonstration(session)
    start = session.status.target

    def play(seconds: float, now: float) -> tuple[float, list[np.ndarray]]:
        seen = []
        for _ in range(round(seconds / 0.03)):
            demonstration.advance(now)
            for _ in range(3):
                session.advance()
            seen.append(session.status.target.position)
            now += 0.03
        return now, seen

    now, before = play(6.0, 0.0)  # the arm goes to its first target, rests, and begins
    assert np.ptp(before, axis=0).max() > 0.01
    now, _ = play(12.0, now)
    assert demonstration.is_over
    assert session.status.target.position == pytest.approx(start.position, abs=EPSILON)

    demonstration = Demonstration(session)
    now, _ = play(3.0, now)
    elsewhere = Pose(start.position + np.array([0.0, 0.0, -0.02]), quat=start.quat)
    session.aim(elsewhere)
    session.advance()
    play(1.0, now)
    assert demonstration.is_over
    assert session.status.target is elsewhere
