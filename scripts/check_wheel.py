"""Installs a built wheel into a new environment outside the repository and tries it: check_wheel.py FOLDER.

FOLDER/dist holds the wheel. The environment borrows the dependencies of the one that runs this script by a path file,
so that nothing is downloaded; the editable install there does not reach it, as path files do not nest.
"""

import os
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

TRIAL = """
import importlib.util, pathlib, sys
import gymnasium as gym
import mpcoffline
here = pathlib.Path(sys.argv[1])
assert here in pathlib.Path(mpcoffline.__file__).parents, mpcoffline.__file__
assert not {"torch", "casadi", "stable_baselines3", "minari"} & set(sys.modules), "import mpcoffline is not light"
for name in ("envs", "datasets"):
    spec = importlib.util.find_spec(name)
    assert spec is None or here not in pathlib.Path(spec.origin or "/").parents, f"{name} is installed at top level"
for env_id in mpcoffline.envs.ENV_IDS:
    env = gym.make(env_id)
    observation, _ = env.reset(seed=0)
    action, _ = mpcoffline.MPCPolicy(mpcoffline.nominal_mpc(env_id), "ddp").predict(observation)
    assert env.action_space.contains(action), action
for row in mpcoffline.list_datasets():
    assert row.where == "shipped", row
assert mpcoffline.load_dataset("mpcoffline/linear/ddpg-v0").total_episodes == 500
print("mpcoffline", mpcoffline.__version__, "works from its wheel")
"""


def main(scratch: Path) -> None:
    wheel, sdist = (next((scratch / "dist").glob(pattern)) for pattern in ("*.whl", "*.tar.gz"))
    home = scratch / "venv"
    venv.create(home, with_pip=False)
    python = home / "bin" / "python"
    subprocess.run([sys.executable, "-m", "pip", "--python", python, "install", "-q", "--no-deps", wheel], check=True)
    where = [python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"]
    packages = Path(subprocess.run(where, check=True, capture_output=True, text=True).stdout.strip())
    (packages / "borrowed.pth").write_text(sysconfig.get_path("purelib") + "\n")
    store = scratch / "wheel-minari"
    store.mkdir()
    environment = {"MINARI_DATASETS_PATH": str(store), "PATH": os.environ["PATH"], "HOME": str(scratch)}
    subprocess.run([python, "-c", TRIAL, home], check=True, cwd=scratch, env=environment)
    for arguments in (["--version"], ["run", "--help"], ["datasets", "list"]):
        command = [home / "bin" / "mpcoffline", *arguments]
        subprocess.run(command, check=True, cwd=scratch, env=environment, stdout=subprocess.DEVNULL)
    print(f"{wheel.name} ({wheel.stat().st_size / 1e6:.1f} MB), {sdist.name} ({sdist.stat().st_size / 1e6:.1f} MB)")


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve())
