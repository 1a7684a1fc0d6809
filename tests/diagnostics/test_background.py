"""Names of what a report shows: those of who described the plant, and the task's own symbols."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from mpcoffline.diagnostics.background import names_of
from mpcoffline.mpc import Label, Labels, Model
from mpcoffline.plants.nominal import nominal_mpc

PENDULUM = "mpcoffline/PendulumSwingUp-v0"


def dataset_of(env_id: str) -> Any:
    """What tells a data set's task."""
    return SimpleNamespace(spec=SimpleNamespace(env_spec=SimpleNamespace(id=env_id)))


def test_a_task_on_its_own_data_has_its_symbols() -> None:
    names = names_of(dataset_of(PENDULUM), nominal_mpc(PENDULUM))
    assert names.states[:2] == ("cos φ", "sin φ")
    assert names.plant == PENDULUM


def test_without_a_known_task_the_model_says_its_names() -> None:
    for dataset in (None, dataset_of("Someone/Elses-v0")):
        names = names_of(dataset, nominal_mpc(PENDULUM))
        assert names.states == ("cos phi", "sin phi", "phid [rad/s]")
        assert names.inputs == ("u [N m]",)


def test_names_that_somebody_gave_go_before_those_of_the_task() -> None:
    own = Labels((Label("c"), Label("s"), Label("w", "rad/s")), (Label("torque", "N m"),))
    model = Model(lambda x, u, p: 0.9 * x + u[0], 3, 1, 0.1, discrete=True, labels=own)
    mpc = nominal_mpc(PENDULUM).replace(model=model)
    assert names_of(dataset_of(PENDULUM), mpc).states == ("c", "s", "w [rad/s]")
