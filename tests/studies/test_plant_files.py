"""Plant files: what is loaded, what is logged, and closed loops against loops by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from plant_file import TEXT

from mpcoffline import InvalidDataError, MPCPolicy, StorageError
from mpcoffline.studies.plant_files import MissingPackageError, PlantFile, find_plant_files


@pytest.fixture
def plant(tmp_path: Path) -> PlantFile:
    (tmp_path / "cart.py").write_text(TEXT)
    return PlantFile.load(tmp_path / "cart.py")


def test_the_log_is_what_the_controllers_did(plant: PlantFile) -> None:
    table = plant.log(seed=3)
    s, a, s_next, ids = table.observations, table.actions, table.next_observations, table.episode_ids
    assert set(ids) == set(range(6))
    together = np.flatnonzero(ids[1:] == ids[:-1])
    np.testing.assert_array_equal(s[together + 1], s_next[together])
    np.testing.assert_allclose(table.costs, s[:, 0] ** 2 + 0.1 * a[:, 0] ** 2, rtol=1e-5)
    starts = [np.random.default_rng([7, 3, e]).uniform(-1, 1) for e in range(6)]
    first = np.unique(ids, return_index=True)[1]
    np.testing.assert_allclose(s[first, 0], starts, rtol=1e-6)


def by_hand(plant: PlantFile, policy: MPCPolicy, seed: int, n: int) -> tuple[np.ndarray, np.ndarray, list[int]]:
    costs, ends, lengths = [], [], []
    for e in range(n):
        one, state, total = plant.module.Plant(), None, 0.0
        y = one.reset(np.random.default_rng([900 + seed, e]))
        for k in range(plant.module.STEPS):
            u, state = policy.predict(y, state=state, episode_start=np.array([k == 0]))
            y, cost, ended = one.step(u)
            total += cost
            if ended:
                break
        costs.append(total)
        ends.append(one.success())
        lengths.append(k + 1)
    return np.array(costs), np.array(ends), lengths


@pytest.mark.parametrize("name", ["mpc", "truth"])
def test_batched_loops_are_those_one_by_one(plant: PlantFile, name: str) -> None:
    policy = MPCPolicy(plant.module.mpc(25) if name == "mpc" else plant.module.truth())
    costs, ends, lengths = by_hand(plant, policy, 1, 12)
    loops = plant.closed_loops(policy, 1, 12)
    np.testing.assert_allclose(loops.cost, costs, rtol=1e-5)
    np.testing.assert_array_equal(loops.success, ends)
    assert name == "truth" or min(lengths) < plant.module.STEPS == max(lengths)  # some end early


def test_behaviours_are_other_controllers_each_episode(plant: PlantFile) -> None:
    loops = plant.closed_loops(None, 0, 4)
    assert len(np.unique(loops.cost)) == 4
    np.testing.assert_array_equal(loops.cost, plant.closed_loops(None, 0, 4).cost)
    np.testing.assert_array_equal(loops.cost[:2], plant.closed_loops(None, 0, 2).cost)


@pytest.mark.parametrize(
    ("change", "error", "word"),
    [
        (("import numpy as np", "import numpy as np, no_such_package_here.part"), MissingPackageError, "no_such"),
        (("import numpy as np", "import numpy as np\nimport importlib.util\nimportlib.util.find_spec('none_of_it')"),
         MissingPackageError, "none_of_it"),
        (("def truth():", "def yardstick():"), InvalidDataError, "truth"),
        (("rng.uniform(-1, 1)", "1 / 0"), InvalidDataError, "ZeroDivisionError"),
        (("class Plant:", "class Plant"), InvalidDataError, "Python file"),
    ],
)  # fmt: skip
def test_what_is_missing_is_named(tmp_path: Path, change: tuple[str, str], error: type[Exception], word: str) -> None:
    (tmp_path / "bad.py").write_text(TEXT.replace(*change))
    with pytest.raises(error, match=word):
        PlantFile.load(tmp_path / "bad.py")


def test_the_earlier_folder_wins(tmp_path: Path) -> None:
    for folder, names in (("a", ["cart"]), ("b/plants", ["cart", "tank", "_helper"])):
        (tmp_path / folder).mkdir(parents=True)
        for name in names:
            (tmp_path / folder / f"{name}.py").write_text(TEXT)
    found = find_plant_files([tmp_path / "a", tmp_path / "b"])
    assert found == {"cart": tmp_path / "a" / "cart.py", "tank": tmp_path / "b" / "plants" / "tank.py"}
    with pytest.raises(StorageError, match="plant files"):
        find_plant_files([tmp_path / "nowhere"])


def test_violations_are_counted_step_by_step(plant: PlantFile, tmp_path: Path) -> None:
    """A share of the steps that each episode had; NaN where the plant has no limits."""
    policy, seed, n = MPCPolicy(plant.module.mpc(0)), 1, 12
    assert np.isnan(plant.closed_loops(policy, seed, n).violated).all()
    said = "    def violations(self):\n        return {'room': self.x - 0.4, 'never': -1.0}\n\n    def success"
    path = tmp_path / "limited.py"
    path.write_text(TEXT.replace("    def success", said))
    found = PlantFile.load(path).closed_loops(policy, seed, n)
    shares = []
    for e in range(n):
        one, state, over = plant.module.Plant(), None, []
        y = one.reset(np.random.default_rng([900 + seed, e]))
        for k in range(plant.module.STEPS):
            u, state = policy.predict(y, state=state, episode_start=np.array([k == 0]))
            y, _, ended = one.step(u)
            over.append(one.x > 0.4)
            if ended:
                break
        shares.append(np.mean(over))
    np.testing.assert_allclose(found.violated, shares)
    assert 0.0 < found.violated.mean() < 1.0
