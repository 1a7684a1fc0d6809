"""What reads each kind of file, and what it may give for a changed one."""

from __future__ import annotations

import json
import os
import random
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mpcoffline import MPCPolicy, OfflineMPCLearner, TransitionTable
from mpcoffline.control import DistilledPolicy
from mpcoffline.datasets import load_dataset, repair, verify
from mpcoffline.datasets.store.packed import packed_size, unpack

from . import mutations, mutations_hdf5
from .cases import EQUAL, LIMITS, OTHER, RAW, REFUSED, WRONG, Case, Finding, status
from .honest import LOGS, PACKED, SET, Honest, learner

Read = Callable[[], str]
FULL = {
    "policy/bytes": 700, "policy/zip": 300, "policy/json": 1300, "policy/arrays": 100,
    "distilled/bytes": 300, "distilled/zip": 100, "distilled/json": 500, "distilled/arrays": 300,
    "learner/bytes": 400, "learner/zip": 100, "learner/json": 600, "learner/arrays": 300,
    "checkpoint/bytes": 400, "checkpoint/zip": 100, "checkpoint/json": 300, "checkpoint/arrays": 300,
    "metadata/bytes": 400, "metadata/json": 500, "metadata without sums/bytes": 300, "metadata without sums/json": 700,
    "hdf5/bytes": 700, "hdf5/objects": 200, "hdf5 without sums/bytes": 600, "hdf5 without sums/objects": 900,
    "sums/bytes": 300, "sums/lines": 300, "log/bytes": 700, "log salvaged/bytes": 500,
    "table cache/bytes": 500, "table cache/json": 200, "compile cache/bytes": 120,
    "packed/bytes": 300, "packed/objects": 300,
}  # fmt: skip
X = np.array([0.3, 0.2, -0.1])
COMPILE = 400  # s: a compiler may take its five minutes


def all_cases(honest: Honest, share: float) -> list[Case]:
    """Every kind of file and mutation, numbered; the first numbers are the same for every share."""
    readers: dict[str, Callable[[Honest, str, Path, random.Random], tuple[str, Read]]] = {
        "policy": archive, "distilled": archive, "learner": archive, "checkpoint": archive,
        "metadata": data_set, "hdf5": data_set, "sums": data_set, "log": log, "table cache": table_cache,
        "compile cache": compile_cache, "packed": packed,
    }  # fmt: skip
    needs = {name: _need(partial(reader, honest, f"{name}/none")) for name, reader in readers.items()}
    cases = []
    for kind, count in FULL.items():
        target = next(name for name in readers if kind.startswith(name))
        make = partial(readers[target], honest, kind)
        cases += [Case(f"{kind}/{k}", make, needs[target]) for k in range(max(2, round(count * share)))]
    return cases


def _need(make: Callable[[Path, random.Random], tuple[str, Read]]) -> int:
    """Bytes of address space that an honest file takes, measured in a process of its own."""
    import tempfile

    ours, theirs = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            with tempfile.TemporaryDirectory() as folder:
                _, read = make(Path(folder), random.Random(0))
                before = status("VmSize")
                if (kind := read()) != EQUAL:
                    os.write(theirs, f"{kind} of an honest file".encode())
                    os._exit(1)
                os.write(theirs, str(status("VmPeak") - before).encode())
        except BaseException as error:
            os.write(theirs, f"an honest file: {error!r}"[:4000].encode())
            os._exit(1)
        os._exit(0)
    os.close(theirs)
    said = os.read(ours, 4096).decode()
    os.close(ours)
    if os.waitpid(child, 0)[1]:
        raise SystemExit(f"{getattr(make, 'args', '')}: {said}")
    return int(said)


# --- archives -----------------------------------------------------------------------------------------------------


def archive(honest: Honest, kind: str, folder: Path, rng: random.Random) -> tuple[str, Read]:
    """A changed policy, learner or checkpoint."""
    target, way = kind.split("/")
    name = "fit.ckpt" if target == "checkpoint" else f"{target}.zip"
    source, path = honest.folder / name, folder / name
    # Arrays are in a learner's file, and in the file of a policy with a network.
    found = mutations.members(source)
    if way == "bytes":
        other = (honest.folder / "other" / "policy.zip").read_bytes()
        what, content = mutations.mutated_bytes(rng, source.read_bytes(), other)
        path.write_bytes(content)
    elif way == "zip":
        what = mutations.mutated_zip(rng, path, found)
    elif way == "json":
        document = json.loads(found[mutations.document_name(found)])
        what, text = mutations.mutated_json(rng, document)
        mutations.write_zip(path, mutations.with_document(found, text))
    elif way == "arrays":
        arrays = mutations.arrays_name(found)
        mutations.CANARY_PATH = str(folder / "canary")
        what, content = mutations.mutated_arrays(rng, found[arrays])
        mutations.write_zip(path, found | {arrays: content})
    else:
        what = "none"
        shutil.copy(source, path)
    readers = {
        "policy": read_policy, "distilled": read_distilled, "learner": read_learner, "checkpoint": read_checkpoint
    }  # fmt: skip
    os.environ["MPCOFFLINE_CACHE"] = str(honest.folder / "solvers")
    return what, partial(readers[target], honest, path, way in ("json", "arrays"))


def policy_fingerprint(policy: MPCPolicy) -> str:
    """Everything that a policy's file says."""
    parts = [policy.mpc.to_json(), policy.solver_name, policy.solver_options, policy.exploration_noise]
    return json.dumps([*parts, str(policy.observation_space), str(policy.action_space)], sort_keys=True, default=str)


def read_policy(honest: Honest, path: Path, free: bool) -> str:
    """Loads and acts; ``free`` says that another content is as good as the original."""
    policy = MPCPolicy.load(path)
    LIMITS.begin("reference", 30)
    same = policy_fingerprint(policy) == policy_fingerprint(MPCPolicy.load(honest.folder / "policy.zip"))
    if not same and not free:
        raise Finding(WRONG, "another policy")
    act(policy)
    return EQUAL if same else OTHER


def read_distilled(honest: Honest, path: Path, free: bool) -> str:
    """Loads and acts; the honest one has three observations and one input."""
    policy = DistilledPolicy.load(path)
    LIMITS.begin("reference", 30)
    found, wanted = map(distilled_fingerprint, (policy, DistilledPolicy.load(honest.folder / "distilled.zip")))
    LIMITS.begin("predict", 10)
    action, _ = policy.predict(np.zeros(policy.observation_space.shape))
    low, high = policy.action_space.low, policy.action_space.high
    if not (np.isfinite(action).all() and (action >= low).all() and (action <= high).all()):
        raise Finding(WRONG, f"action {action}")
    if found != wanted and not free:
        raise Finding(WRONG, "another policy")
    return EQUAL if found == wanted else OTHER


def distilled_fingerprint(policy: DistilledPolicy) -> str:
    """Everything that a distilled policy's file says."""
    numbers = [
        array.tolist() for array in (*policy.network.to_arrays().values(), policy.usual_memory, policy.memory_sources)
    ]
    names = [
        policy.y_labels,
        policy.u_labels,
        policy.memory_names,
        str(policy.observation_space),
        str(policy.action_space),
    ]
    return json.dumps([numbers, names, policy.report.to_json()], sort_keys=True, default=str)


def act(policy: MPCPolicy) -> None:
    """One action, which lies within its bounds."""
    LIMITS.begin("predict", 60, wall=COMPILE, room=1 << 30)
    action, _ = policy.predict(np.zeros(policy.mpc.nx) if policy.mpc.nx != len(X) else X)
    low, high = policy.action_space.low, policy.action_space.high
    if not (np.isfinite(action).all() and (action >= low).all() and (action <= high).all()):
        raise Finding(WRONG, f"action {action}")


def read_learner(honest: Honest, path: Path, free: bool) -> str:
    """Loads; evaluates V and the MPC's parameters, but compiles nothing."""
    loaded = OfflineMPCLearner.load(path)
    LIMITS.begin("reference", 30)
    original = OfflineMPCLearner.load(honest.folder / "learner.zip")
    LIMITS.begin("use", 10)
    found, wanted = (learner_fingerprint(one) for one in (loaded, original))
    if found != wanted and not free:
        raise Finding(WRONG, "another learner")
    return EQUAL if found == wanted else OTHER


def learner_fingerprint(one: OfflineMPCLearner) -> str:
    """Everything that a learner's file says."""
    value = one.value_function
    sizes = np.linspace(-1, 1, 3 * one.nominal_mpc.nx).reshape(3, -1)
    numbers = None if value is None else np.asarray(value.predict(sizes)).tolist()
    mpcs = [one.nominal_mpc.to_json(), one.mpc.to_json()]
    settings = [one.learn, one.preset, one.seed, str(one.method), str(one.result)]
    return json.dumps([numbers, mpcs, one.history, *settings], sort_keys=True, default=str)


def read_checkpoint(honest: Honest, path: Path, free: bool) -> str:
    """Goes on with the fit to its end."""
    fitted = learner()
    fitted.fit(honest.table, n_steps_per_epoch=4, checkpoint=path, show_progress=False)
    LIMITS.begin("reference", 30)
    original = OfflineMPCLearner.load(honest.folder / "learner.zip")
    values = [np.asarray(one.value_function.predict(honest.table.observations)) for one in (fitted, original)]
    same = np.array_equal(fitted.theta, original.theta) and np.array_equal(*values)
    if not np.isfinite(fitted.theta).all():
        raise Finding(WRONG, "theta is not finite")
    if not same and not free:
        raise Finding(WRONG, "another theta")
    return EQUAL if same else OTHER


# --- data sets ----------------------------------------------------------------------------------------------------


def data_set(honest: Honest, kind: str, folder: Path, rng: random.Random) -> tuple[str, Read]:
    """A changed metadata.json, main_data.hdf5 or SHA256SUMS."""
    target, way = kind.split("/")
    place = copy_store(honest, folder) / SET
    sums, metadata, hdf5 = place / "SHA256SUMS", place / "data/metadata.json", place / "data/main_data.hdf5"
    path = sums if target == "sums" else metadata if target.startswith("metadata") else hdf5
    other = (honest.folder / "other" / SET / path.relative_to(place)).read_bytes()
    what, hashed = "none", "without" not in target
    if way == "bytes":
        what, content = mutations.mutated_bytes(rng, path.read_bytes(), other)
        path.write_bytes(content)
    elif way == "json":
        what, text = mutations.mutated_json(rng, json.loads(metadata.read_text()))
        metadata.write_bytes(text.encode("utf-8", "surrogatepass"))
    elif way == "lines":
        what, content = mutations.mutated_lines(rng, sums.read_text())
        sums.write_bytes(content)
    elif way == "objects":
        what = mutations_hdf5.mutated_hdf5(rng, hdf5)
    if not hashed:
        sums.unlink()
    # Without sums nobody can tell other numbers from right ones, but where the numbers are those of the original.
    numbers_may_differ = target == "hdf5 without sums"
    return what, partial(read_data_set, honest, numbers_may_differ, rng.random() < 0.3, hashed and target != "sums")


def copy_store(honest: Honest, folder: Path, name: str = "store") -> Path:
    """A store of its own, in which no cache remembers anything."""
    shutil.copytree(honest.folder / name, folder / name)
    os.environ["MINARI_DATASETS_PATH"] = str(folder / name)
    os.environ["MPCOFFLINE_CACHE"] = os.environ["XDG_CACHE_HOME"] = str(folder / "cache")
    return folder / name


def read_data_set(honest: Honest, free: bool, repaired: bool, hashed: bool) -> str:
    """Loads, makes a table, verifies, and in some cases repairs and does it again."""
    kind, error = _table_outcome(honest, free)
    LIMITS.begin("verify")
    changed = hashed and _changed(honest)
    try:
        report = verify(SET)
    except MemoryError:
        raise
    except Exception as raised:
        raise Finding(RAW, f"verify raised {type(raised).__name__}: {raised}") from raised
    if report.ok and changed:
        raise Finding(WRONG, "verify found nothing")
    if repaired:
        LIMITS.begin("repair")
        _repaired(honest, SET, None if free else {row.tobytes() for row in honest.table.rows})
    if error is not None:
        LIMITS.stage = "load"
        raise error
    return kind


def _changed(honest: Honest) -> bool:
    """Whether a file of the data set is not that of the original, by its bytes."""
    store = Path(os.environ["MINARI_DATASETS_PATH"])
    names = ("data/metadata.json", "data/main_data.hdf5")
    return any(
        (store / SET / name).read_bytes() != (honest.folder / "store" / SET / name).read_bytes() for name in names
    )


def _table_outcome(honest: Honest, free: bool) -> tuple[str, Exception | None]:
    from mpcoffline.core.errors import MPCOfflineError

    try:
        dataset = load_dataset(SET, download=False)
        table = TransitionTable.from_minari(dataset)
    except MPCOfflineError as error:
        if any(isinstance(e, MemoryError) for e in (error, error.__cause__, error.__context__)):
            raise
        return REFUSED, error
    wanted = honest.table
    same = np.array_equal(table.rows, wanted.rows) and np.array_equal(table.episode_ids, wanted.episode_ids)
    if same:
        return EQUAL, None
    if not free:
        raise Finding(WRONG, "another table")
    if not np.isfinite(table.rows).all() or len(table) != dataset.total_steps:
        raise Finding(WRONG, f"{len(table)} rows of {dataset.total_steps}, finite: {np.isfinite(table.rows).all()}")
    return OTHER, None


def _repaired(honest: Honest, dataset_id: str, known: set[bytes] | None, **options: Any) -> str:
    """Repairs; where that succeeds, every row is a known one and none is there twice."""
    from mpcoffline.core.errors import MPCOfflineError

    try:
        repair(dataset_id, **options)
        table = TransitionTable.from_minari(dataset_id)
    except MPCOfflineError as error:
        if any(isinstance(e, MemoryError) for e in (error, error.__cause__, error.__context__)):
            raise
        return REFUSED
    rows = [row.tobytes() for row in table.rows]
    if known is not None and not set(rows) <= known:
        raise Finding(WRONG, f"repair: {len(set(rows) - known)} rows are wrong")
    if known is not None and len(set(rows)) != len(rows):
        raise Finding(WRONG, f"repair: {len(rows) - len(set(rows))} rows are there twice")
    return EQUAL if known is not None and set(rows) == known else OTHER


def log(honest: Honest, kind: str, folder: Path, rng: random.Random) -> tuple[str, Read]:
    """A changed log of an interrupted recording."""
    target, way = kind.split("/")
    store = copy_store(honest, folder)
    path = next((store / ".recording" / LOGS).glob("env-*.log"))
    other = next((honest.folder / "other" / ".recording" / LOGS).glob("env-*.log")).read_bytes()
    what = "none"
    if way == "bytes":
        what, content = mutations.mutated_log(rng, path.read_bytes(), other)
        path.write_bytes(content)
    options = {"salvage": True} if "salvaged" in target else {}
    # Whole records of another recording bear right sums: nobody can tell.
    known = None if what.endswith(("foreign", "header")) else honest.rows
    known = honest.rows | honest.foreign_rows if what.startswith("splice") else known
    return what, partial(_repaired, honest, LOGS, known, **options)


# --- caches and packed files --------------------------------------------------------------------------------------


def table_cache(honest: Honest, kind: str, folder: Path, rng: random.Random) -> tuple[str, Read]:
    """A changed file of a mapped table."""
    copy_store(honest, folder)
    shutil.copytree(honest.folder / "tables", folder / "tables")
    files = sorted(path for path in (folder / "tables").rglob("*") if path.is_file() and path.stat().st_size)
    way = kind.split("/")[1]
    what = "none"
    if way == "bytes":
        path = rng.choice(files)
        what, content = mutations.mutated_bytes(rng, path.read_bytes())
        what = f"{path.name}: {what}"
        path.write_bytes(content)
    elif way == "json":
        path = rng.choice([path for path in files if path.suffix == ".json"])
        what, text = mutations.mutated_json(rng, json.loads(path.read_text()))
        path.write_bytes(text.encode("utf-8", "surrogatepass"))
    return what, partial(read_mapped, honest, folder / "tables")


def read_mapped(honest: Honest, cache: Path) -> str:
    """Reads a mapped table in every way."""
    table = TransitionTable.from_minari(SET, memory=1, cache=cache)
    wanted = honest.table
    means, first = table.statistics().mean, table.split(0.5, 0)[0]
    rows = sorted(row.tobytes() for batch in table.batches(len(wanted), 0, epochs=1) for row in batch.numpy())
    checks = {
        "rows": np.array_equal(table.rows, wanted.rows),
        "episode ids": np.array_equal(table.episode_ids, wanted.episode_ids),
        "statistics": all(np.allclose(a, b) for a, b in zip(means, wanted.statistics().mean, strict=True)),
        "split": np.array_equal(first.rows, wanted.split(0.5, 0)[0].rows),
        "batches": rows == sorted(row.tobytes() for row in wanted.rows),
        "trim": np.array_equal(table.trim(0.9).rows, wanted.trim(0.9).rows),
    }
    if wrong := [name for name, right in checks.items() if not right]:
        raise Finding(WRONG, ", ".join(wrong))
    return EQUAL


def compile_cache(honest: Honest, kind: str, folder: Path, rng: random.Random) -> tuple[str, Read]:
    """A changed library of a compiled solver."""
    cache = folder / "solvers"
    shutil.copytree(honest.folder / "solvers", cache)
    os.environ["MPCOFFLINE_CACHE"] = str(cache)
    path = rng.choice(sorted(cache.rglob("*.so")))
    what = "none"
    if kind.endswith("bytes"):
        what, content = mutations.mutated_bytes(rng, path.read_bytes())
        path.write_bytes(content)
    return what, partial(read_compiled, honest)


def read_compiled(honest: Honest) -> str:
    """Acts by a solver from the cache; building it anew takes its time."""
    policy = MPCPolicy.load(honest.folder / "policy.zip")
    LIMITS.begin("predict", 60, wall=120, room=1 << 30)
    action, _ = policy.predict(X)
    LIMITS.begin("reference", 60)
    os.environ["MPCOFFLINE_CACHE"] = str(honest.folder / "solvers")
    if not np.array_equal(action, MPCPolicy.load(honest.folder / "policy.zip").predict(X)[0]):
        raise Finding(WRONG, f"action {action}")
    return EQUAL


def packed(honest: Honest, kind: str, folder: Path, rng: random.Random) -> tuple[str, Read]:
    """A changed packed file, which holds no sum itself."""
    path, way = folder / "packed.h5", kind.split("/")[1]
    shutil.copy(honest.folder / "packed.h5", path)
    (folder / "store").mkdir()
    os.environ["MINARI_DATASETS_PATH"] = str(folder / "store")
    what = "none"
    if way == "bytes":
        what, content = mutations.mutated_bytes(rng, path.read_bytes())
        path.write_bytes(content)
    elif way == "objects":
        what = mutations_hdf5.mutated_hdf5(rng, path)
    return what, partial(read_packed, honest, path)


def read_packed(honest: Honest, path: Path) -> str:
    """Its size, then its episodes."""
    packed_size(path)
    LIMITS.begin("unpack")
    table = TransitionTable.from_minari(unpack(path, PACKED))
    if np.array_equal(table.rows, honest.table.rows):
        return EQUAL
    if not np.isfinite(table.rows).all():
        raise Finding(WRONG, "rows that are not finite")
    return OTHER
