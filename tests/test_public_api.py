"""``import mpcoffline``: the names that are promised, loaded when first used."""

from __future__ import annotations

import subprocess
import sys

import pytest

import mpcoffline
from mpcoffline.core import errors


@pytest.mark.parametrize("name", mpcoffline.__all__)
def test_every_public_name_exists_and_is_listed(name: str) -> None:
    assert getattr(mpcoffline, name) is not None
    assert name in dir(mpcoffline)


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="No mpcoffline attribute MCP"):
        mpcoffline.MCP  # noqa: B018


def test_every_error_of_the_project_is_public() -> None:
    classes = {n for n, c in vars(errors).items() if isinstance(c, type) and issubclass(c, errors.MPCOfflineError)}
    assert classes <= set(mpcoffline.__all__)


def test_import_is_light_and_registers_the_environments() -> None:
    code = (
        "import sys, gymnasium, mpcoffline\n"
        "heavy = {'torch', 'casadi', 'stable_baselines3', 'minari', 'scipy', 'matplotlib', 'h5py'}\n"
        "print(*(heavy & set(sys.modules)))\n"
        "print(*(name for name in gymnasium.registry if name.startswith('mpcoffline/')))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    heavy, environments = done.stdout.split("\n")[:2]
    assert heavy == ""
    assert environments.split() == list(mpcoffline.envs.ENV_IDS)
