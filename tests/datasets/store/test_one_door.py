"""Nothing but the guarded door opens a stored data set: no other module calls what Minari, Gymnasium or HDF5 would."""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).parents[3]
MODULES = [*(ROOT / "mpcoffline").rglob("*.py"), *(ROOT / "envs").rglob("*.py")]

# What makes, imports or opens things that a data set's files name, or fails as a whole where one folder is bad.
FORBIDDEN = {
    "MinariDataset": {"mpcoffline/datasets/store/opening.py"},
    "MinariStorage.read": set[str](),
    "MinariStorage.read_raw_metadata": set[str](),
    "minari.load_dataset": set[str](),
    "minari.list_local_datasets": set[str](),
    "minari.combine_datasets": set[str](),
    "minari.download_dataset": set[str](),
    "minari.delete_dataset": set[str](),
    ".recover_environment": set[str](),
    "EnvSpec.from_json": {
        "mpcoffline/datasets/store/packed.py",
        "mpcoffline/datasets/recording/session.py",
        "mpcoffline/datasets/check/repairing.py",
    },
    "h5py.File": {
        "mpcoffline/datasets/interop/from_buffers.py",  # after check_hdf5: another tool's file, no data set
        "mpcoffline/datasets/table/hdf5_episodes.py",  # after check_stored
        "mpcoffline/datasets/store/hdf5_guard.py",
        "mpcoffline/datasets/store/hdf5_writing.py",  # a copy that came through the door
        "mpcoffline/datasets/store/packed.py",
        "mpcoffline/datasets/check/repairing.py",
        "mpcoffline/datasets/store/verification.py",
        "mpcoffline/datasets/store/writing.py",  # what was checked and copied
    },
}


def _names(tree: ast.AST) -> dict[str, str]:
    """What the names that a module imports stand for, in full."""
    found = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.asname or alias.name.partition(".")[0]: alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
    return found


def _dotted(node: ast.expr) -> str:
    if isinstance(node, ast.Attribute):
        return f"{_dotted(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else "?"


def _calls(source: str) -> set[str]:
    """The full names of all functions that are called, as far as the module's own text tells; not those that write."""
    tree = ast.parse(source)
    names, found = _names(tree), set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            head, dot, rest = _dotted(node.func).partition(".")
            if not any(isinstance(mode, ast.Constant) and mode.value == "w" for mode in node.args[1:2]):
                found.add(names.get(head, head) + dot + rest)
    return found


def _forbidden(source: str) -> set[str]:
    calls = _calls(source)
    return {name for name in FORBIDDEN for call in calls if _is(call, name)}


def _is(call: str, name: str) -> bool:
    """Whether a call is of that name: in any module of Minari's, or of a class or a package wherever it comes from."""
    within_minari = call.partition(".")[0] == "minari" and call.split(".")[-1] == name.split(".")[-1]
    if name.startswith("minari."):
        return within_minari
    return call == name or call.endswith(name if name.startswith(".") else f".{name}")


def test_the_rule_sees_each_way_of_writing_it() -> None:
    for source in (
        "import minari\nminari.load_dataset('x')",
        "import minari as m\nm.load_dataset('x')",
        "from minari import load_dataset as load\nload('x')",
        "from minari.storage.local import load_dataset\nload_dataset('x')",
    ):
        assert _forbidden(source) == {"minari.load_dataset"}
    assert _forbidden("from minari import MinariDataset\nMinariDataset('x')") == {"MinariDataset"}
    assert _forbidden("from minari.dataset.minari_storage import MinariStorage as S\nS.read('x')") == {
        "MinariStorage.read"
    }
    assert _forbidden("import h5py\nwith h5py.File('x') as f: pass") == {"h5py.File"}
    assert _forbidden("dataset.recover_environment()") == {".recover_environment"}
    assert _forbidden("from .loading import load_dataset\nload_dataset('x')") == set()


def test_nothing_but_the_door_opens_a_stored_data_set() -> None:
    assert len(MODULES) > 100
    found = {
        (path.relative_to(ROOT).as_posix(), name)
        for path in MODULES
        for name in _forbidden(path.read_text(encoding="utf-8"))
    }
    assert {(module, name) for module, name in found if module not in FORBIDDEN[name]} == set()
    assert {name for _, name in found} >= {"MinariDataset", "EnvSpec.from_json"}  # it looks at the right files
