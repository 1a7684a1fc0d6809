"""Installs a built wheel outside the repository and tries it there: check_wheel.py FOLDER [PYTHON].

FOLDER/dist holds wheel and sdist. PYTHON is that of an environment with the dependencies; without it a new one is made
that borrows those of the environment which runs this script by a path file, so that nothing is downloaded; the editable
install there does not reach it, as path files do not nest. With PYTHON only what its versions decide is tried.

Tried are: the contents of the sdist, the metadata as an index sees it, the import, the command line, and
scripts/users_script.py, which is run, and type-checked together with the README's quick start. With PYTHON the quick
start is run, too (with a short regression, without the choice that follows); without, the tests run it as well.
"""

import os
import re
import subprocess
import sys
import sysconfig
import tarfile
import time
import venv
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

TRIAL = """
import importlib.metadata, importlib.util, pathlib, sys
for extra in ("pygame", "moviepy", "tensorboard", "huggingface_hub", "google.cloud.storage", "tensordict", "torchrl"):
    sys.modules[extra] = None  # as if it were not installed
import gymnasium as gym
import mpcoffline
here = pathlib.Path(sys.argv[1])
assert here in pathlib.Path(mpcoffline.__file__).parents, mpcoffline.__file__
assert mpcoffline.__version__ == importlib.metadata.version("mpcoffline")
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
assert (pathlib.Path(mpcoffline.__file__).parent / "diagnostics" / "page.html.jinja").is_file(), "no template"
print("mpcoffline", mpcoffline.__version__, "works from its wheel")
"""

# Runs a script; what is deprecated in a dependency and still called from here is an error.
RUN = r"""
import runpy, sys, warnings
warnings.filterwarnings("error", category=DeprecationWarning, module=r"mpcoffline(\.|$)")
runpy.run_path(sys.argv[1], run_name="__main__")
"""


# What the quick start's learner is asked for, so that it takes seconds.
BRIEF = r'\1, value_n_steps=500, fit_n_steps=200, candidate="full")'


def main(scratch: Path, python: Path | None) -> None:
    wheel, sdist = (next((scratch / "dist").glob(pattern)) for pattern in ("*.whl", "*.tar.gz"))
    whole = python is None
    if python is None:
        check_sdist(sdist)
        step("twine", [sys.executable, "-m", "twine", "check", "--strict", wheel, sdist])
        python = borrowing_environment(scratch / "venv")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", python]
    step("installation", [*pip, "install", "-q", "--no-deps", "--force-reinstall", wheel])
    try_wheel(python, scratch / "trial", types=whole)
    print(f"{wheel.name} ({wheel.stat().st_size / 1e6:.1f} MB), {sdist.name} ({sdist.stat().st_size / 1e6:.1f} MB)")


def check_sdist(sdist: Path) -> None:
    """The sdist holds what is tracked, so that tests, checks and documentation can be made from it."""
    if not (ROOT / ".git").exists():
        return
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, check=True, capture_output=True, text=True).stdout.split()
    with tarfile.open(sdist) as archive:
        held = {name.partition("/")[2] for name in archive.getnames()}
    # The two links are for editors; package-dir takes their place.
    left_out = {".ci/run", ".gitignore", "mpcoffline/envs", "mpcoffline/datasets/catalog"}
    if missing := set(tracked) - held - left_out:
        raise SystemExit(f"check_wheel.py: expected all tracked files in {sdist.name}, missing: {sorted(missing)}")


def borrowing_environment(home: Path) -> Path:
    """A new environment with the packages of this one; its Python."""
    venv.create(home, with_pip=False)
    python = home / "bin" / "python"
    (packages_of(python) / "borrowed.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return python


def packages_of(python: Path) -> Path:
    """Where an environment has its packages."""
    where = [python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"]
    return Path(subprocess.run(where, check=True, capture_output=True, text=True).stdout.strip())


def try_wheel(python: Path, folder: Path, *, types: bool) -> None:
    """All trials, perhaps that of the types, in a new folder that is the user's home and store of data sets."""
    (folder / "minari").mkdir(parents=True)
    environment = {"PATH": os.environ["PATH"], "HOME": str(folder), "MINARI_DATASETS_PATH": str(folder / "minari")}
    environment |= {"OMP_NUM_THREADS": "1", "COLUMNS": "100"}
    (folder / "users_script.py").write_text((ROOT / "scripts" / "users_script.py").read_text())
    (folder / "quick_start.py").write_text(quick_start())

    def trial(name: str, *command: str | Path) -> None:
        step(name, list(command), cwd=folder, env=environment)

    # Without the project's configuration: what is checked is what a stranger's mypy sees, through py.typed.
    mypy = [sys.executable, "-m", "mypy", "--strict", "--config-file=", "--python-executable", python]
    background = ThreadPoolExecutor(1)
    checked = background.submit(trial, "user's types", *mypy, "quick_start.py", "users_script.py") if types else None
    trial("import", python, "-W", "error::DeprecationWarning", "-c", "import mpcoffline")
    trial("wheel", python, "-c", TRIAL, packages_of(python).parents[2])
    for arguments in (["--version"], ["run", "--help"], ["datasets", "list"]):
        trial(f"mpcoffline {' '.join(arguments)}", python.parent / "mpcoffline", *arguments)
    if not types:  # else the tests run it with the same versions
        trial("quick start", python, "-c", RUN, "quick_start.py")
    trial("user's script", python, "-c", RUN, "users_script.py")
    if checked is not None:
        checked.result()


def quick_start() -> str:
    """The README's first block of Python, with a regression of a few seconds and no choice among its results."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    block = re.findall(r"^```python\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)[0]
    brief, n_changed = re.subn(r"(OfflineMPCLearner\(mpc, .*?)\)", BRIEF, block)
    if n_changed != 1:
        raise SystemExit("check_wheel.py: expected one learner in the README's first block of Python.")
    return brief


def step(name: str, command: list[str | Path], **options: object) -> None:
    """Runs a command; its output is shown where it fails."""
    start = time.perf_counter()
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, **options)  # type: ignore[call-overload]
    if done.returncode:
        raise SystemExit(f"{done.stdout}\ncheck_wheel.py: {name} failed with exit code {done.returncode}.")
    print(f"  {name}: {time.perf_counter() - start:.1f} s", flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve(), Path(sys.argv[2]).absolute() if len(sys.argv) > 2 else None)
