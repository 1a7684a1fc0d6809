"""The figures of a learner: what is drawn where, against numbers computed apart from the drawing."""

from __future__ import annotations

from pathlib import Path

import casadi as ca
import matplotlib.colors
import numpy as np
import pytest

from mpcoffline import MPC, Model, MPCPolicy, OfflineMPCLearner, QuadraticCost, nominal_mpc, plotting
from mpcoffline.control.evaluation import Evaluation
from mpcoffline.core.errors import InvalidArgumentError, MPCOfflineError
from mpcoffline.envs import PLANTS
from mpcoffline.learning import FitResult
from mpcoffline.plotting import style
from mpcoffline.plotting.costs import stage_weights
from mpcoffline.plotting.panels import on_plane, plane_of, task_of

PENDULUM = "mpcoffline/PendulumSwingUp-v0"


def loops_of(states: np.ndarray, actions: np.ndarray) -> Evaluation:
    one = np.ones(1)
    return Evaluation(one, one, one > 0, np.array([len(actions)]), 0.9, [states], [actions])


@pytest.mark.parametrize("name", PLANTS)
def test_closed_loops_show_states_and_inputs_with_their_bounds(name: str) -> None:
    plant = PLANTS[name]
    nx, nu = len(plant.states), len(plant.inputs)
    rng = np.random.default_rng(0)
    loops = {name: loops_of(rng.normal(size=(51, nx)), rng.uniform(-2, 2, (50, nu))) for name in ("MPC_1", "MPC_3")}
    figure = plotting.loop_figure(loops, plant.id)
    assert len(figure.axes) == len(plant.shown) + nu
    assert all("(" in axes.get_ylabel() for axes in figure.axes), "every axis names its unit"
    assert figure.axes[-1].get_xlabel() == "time (s)"


def test_weights_are_those_of_the_cost() -> None:
    W, R, S = np.diag([2.0, 1.0]), np.array([[0.5]]), np.array([[0.3], [-0.2]])
    model = Model(lambda x, u, p: ca.vertcat(x[1], u[0]), nx=2, nu=1, dt=0.1)
    mpc = MPC(model, QuadraticCost(W, R, S, x_ref=[1.0, 0.0], u_ref=[0.2]), QuadraticCost(W), 5, 0.9, [-1.0], [1.0])
    np.testing.assert_allclose(stage_weights(mpc), np.block([[W, S], [S.T, R]]), atol=1e-12)


def test_the_cost_figure_prints_the_weights_and_shares_its_shades() -> None:
    nominal = nominal_mpc(PENDULUM)
    learned = nominal.with_theta(nominal.space.pack({"stage_cost.W": np.diag([2.5, 0.251, 0.1])}))
    figure = plotting.cost_figure(nominal, learned, PENDULUM)
    texts = [text.get_text() for text in figure.axes[2].texts]
    assert texts == ["2.50", "0", "0", "0", "0", "0.25", "0", "0", "0", "0", "0.10", "0", "0", "0", "0", "0.10"]


@pytest.mark.parametrize("constant", [0.0, 7.0, -3.0])
def test_one_colour_bar_holds_for_both_costs(constant: float) -> None:
    """Also where learning has moved the whole cost: the same number has the same colour in both landscapes."""
    nominal = nominal_mpc(PENDULUM)
    learned = nominal.with_theta(nominal.space.pack({"stage_cost.constant": constant}))
    figure = plotting.cost_figure(nominal, learned, PENDULUM)
    first, second = (axes.collections[0] for axes in (figure.axes[1], figure.axes[3]))
    np.testing.assert_array_equal(first.levels, second.levels)
    assert first.levels[0] <= min(0.0, constant)


def test_the_plane_of_the_pendulum_holds_its_cost() -> None:
    """With W = diag(1, 1, 0.1) at [1, 0, 0]: (cos - 1)^2 + sin^2 + 0.1 phid^2 = 2 - 2 cos + 0.1 phid^2."""
    nominal = nominal_mpc(PENDULUM)
    cost = lambda y: np.array(nominal.stage_function(y.T, np.zeros((1, len(y))), nominal.theta).full()[0])  # noqa: E731
    angle, speed, values = on_plane(task_of(PENDULUM)[0], plane_of(PLANTS["pendulum"]), cost, n=7)
    np.testing.assert_allclose(values, 2 - 2 * np.cos(angle) + 0.1 * speed**2, atol=1e-5)


def test_trajectories_are_unbroken_and_the_plane_grows_around_them() -> None:
    phi = np.linspace(3.0, 12.0, 60)  # turns over; as the environment wraps it, it jumps
    wrapped = np.stack([np.angle(np.exp(1j * phi)), np.full(60, 12.0)], axis=1)
    figure = plotting.phase_portrait(lambda y: y[:, 2] ** 2, {"MPC_3": loops_of(wrapped, np.zeros((59, 1)))}, PENDULUM)
    axes = figure.axes[0]
    curve = axes.lines[0]
    np.testing.assert_allclose(curve.get_xdata(), phi)
    assert axes.get_xlim()[1] > 12.0
    assert axes.get_ylim()[1] > 12.0
    labels = [label.get_text() for label in axes.get_xticklabels()]
    assert labels == ["0", "$\\pi$", "$2\\pi$", "$3\\pi$"]
    stars = [line.get_xdata()[0] for line in axes.lines if line.get_marker() == "*"]
    np.testing.assert_allclose(stars, [0.0, 2 * np.pi])


def test_shades_are_ordered_in_grey() -> None:
    """In print, larger V is lighter: the luminance of the colour map rises."""
    import matplotlib as mpl

    colors = matplotlib.colors.to_rgba_array(mpl.colormaps["cividis"](np.linspace(0, 1, 14)))
    assert (np.diff(colors[:, :3] @ [0.299, 0.587, 0.114]) > 0).all()


def made_up_learner(losses: list[float]) -> OfflineMPCLearner:
    learner = OfflineMPCLearner(nominal_mpc(PENDULUM))
    learner.history = [(i + 1, {"value_loss": loss, "fit_share": 0.5}) for i, loss in enumerate(losses)]
    learner.history.append((len(losses) + 1, {"fit_loss": 0.1}))
    learner.result = FitResult(learner.nominal_mpc.theta, loss_before=0.4, loss_after=0.1)
    return learner


def test_training_curves_start_fit_at_the_error_before_learning() -> None:
    figure = plotting.training_figure(made_up_learner([1.0, 0.5, 0.001]))
    value, other, fit = figure.axes
    np.testing.assert_allclose(value.lines[0].get_ydata(), [1.0, 0.5, 0.001])
    assert value.get_yscale() == "log"
    assert other.get_title() == "fit share, 0.5 to 0.5"
    np.testing.assert_allclose([bar.get_height() for bar in fit.patches], [0.4, 0.1])
    assert fit.get_title().endswith(", 0.4 to 0.1")


def test_losses_read_as_numbers() -> None:
    axes = plotting.training_figure(made_up_learner([40.0, 2.0, 0.01])).axes[0]
    low, high = axes.get_ylim()
    labels = [t.get_text() for t, y in zip(axes.get_yticklabels(), axes.get_yticks(), strict=True) if low < y < high]
    assert {"0.01", "1", "10"} <= set(labels)


def test_what_cannot_be_drawn_is_refused() -> None:
    nominal = nominal_mpc(PENDULUM)
    with pytest.raises(MPCOfflineError, match="expected a fitted learner"):
        plotting.training_figure(OfflineMPCLearner(nominal))
    with pytest.raises(InvalidArgumentError, match=r"expected one of .*, got CartPole-v1"):
        plotting.cost_figure(nominal, nominal, "CartPole-v1")
    with pytest.raises(InvalidArgumentError, match="expected 5 states and 1 inputs"):
        plotting.cost_figure(nominal, nominal, "mpcoffline/CartPoleSwingUp-v0")


def test_an_interrupted_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "figure.png"
    target.write_bytes(b"old")

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("mpcoffline.core.outputs.os.replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        style.write_file(target, b"new")
    assert target.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [target]


class TestFilms:
    """Pictures of two controllers side by side."""

    @pytest.fixture
    def policies(self) -> dict[str, MPCPolicy]:
        pytest.importorskip("pygame")
        short = nominal_mpc(PENDULUM).replace(horizon=5)
        return {"MPC_1": MPCPolicy(short), "MPC_3": MPCPolicy(short.replace(horizon=4))}

    def test_a_gif_runs_in_real_time_side_by_side(self, policies: dict[str, MPCPolicy], tmp_path: Path) -> None:
        from PIL import Image

        film = plotting.animate(policies, PENDULUM, [np.pi, 0.0], tmp_path / "film.gif", seconds=0.4, width=100)
        with Image.open(film) as picture:
            assert (picture.n_frames, picture.size) == (5, (200, 110))  # type: ignore[attr-defined]
            assert picture.info["duration"] == 100
            first = np.asarray(picture.convert("RGB"))
        np.testing.assert_array_equal(first[12:, :100], first[12:, 100:])  # the same start, under the names

    def test_mp4_says_what_is_missing(self, monkeypatch: pytest.MonkeyPatch) -> None:
        import sys

        pytest.importorskip("pygame")
        monkeypatch.setattr("shutil.which", lambda _: None)
        monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
        with pytest.raises(MPCOfflineError, match=r'pip install "mpcoffline\[video\]", or write a \.gif'):
            plotting.check_film(Path("film.mp4"))

    def test_mp4_is_written_where_ffmpeg_is_there(self, policies: dict[str, MPCPolicy], tmp_path: Path) -> None:
        try:
            plotting.check_film(tmp_path / "film.mp4")
        except MPCOfflineError:
            pytest.skip("no ffmpeg")
        film = plotting.animate(policies, PENDULUM, [np.pi, 0.0], tmp_path / "film.mp4", seconds=0.2, width=100)
        assert film.read_bytes()[4:8] == b"ftyp"

    @pytest.mark.parametrize("number", [{"fps": 0}, {"width": 0}, {"seconds": -1.0}])
    def test_numbers_that_make_no_film(
        self, policies: dict[str, MPCPolicy], number: dict[str, float], tmp_path: Path
    ) -> None:
        with pytest.raises(InvalidArgumentError, match=f"{next(iter(number))}: expected a positive number"):
            plotting.animate(policies, PENDULUM, [np.pi, 0.0], tmp_path / "film.gif", **number)  # type: ignore[arg-type]

    def test_nobody_to_film(self, tmp_path: Path) -> None:
        pytest.importorskip("pygame")
        with pytest.raises(InvalidArgumentError, match="at least one"):
            plotting.animate({}, PENDULUM, [np.pi, 0.0], tmp_path / "film.gif")


def test_the_labels_fit_the_environments() -> None:
    for plant in PLANTS.values():
        task, found = task_of(plant.id)
        assert found is plant
        assert len(plant.observations) == task.observation_space.shape[0]
        assert [c.index for c in plane_of(plant)] == [plant.state(name).index for name in plant.plane]
