"""A learned model as a Functional Mock-up Unit of FMI 3.0, for model exchange: CasADi writes its C."""

from __future__ import annotations

import contextlib
import platform
import subprocess
import sys
import threading
import xml.etree.ElementTree as ET
import zipfile
from importlib import resources
from importlib.metadata import version
from io import BytesIO
from os import PathLike
from pathlib import Path
from shlex import split
from tempfile import TemporaryDirectory
from typing import Any

import casadi as ca
import numpy as np

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.outputs import check_output_folder, write_file
from mpcoffline.core.places import warn_once
from mpcoffline.core.text import c_identifiers
from mpcoffline.mpc import MPC
from mpcoffline.mpc.rest import at_rest
from mpcoffline.solvers.ddp.bounded import run_bounded
from mpcoffline.solvers.ddp.build import compilers

from .loading import Acting, load_policy

_NAME = "learned_model"
_FILE = "model.fmu"
_HELPER = "__assign__"  # variables of CasADi's own, whose names FMI does not allow
_SECONDS = 300.0
_working_directory = threading.Lock()  # CasADi writes where the process is


def export_fmi(policy: Acting | str | PathLike[str], folder: str | PathLike[str]) -> list[Path]:
    """Writes the model of a policy's MPC as ``model.fmu``: FMI 3.0, model exchange.

    It is the plant's ordinary differential equation dx/dt = f(x, u, d, p) with what was learned: its states are
    outputs, its inputs u and signals d inputs, and its parameters p can be tuned, with names and units of the
    description. What stands around the equation in an MPC, dead time and inputs that are held for a step, is the
    simulator's, so the model's ``dt`` is the step of the default experiment and no more. Sources are in it, and a
    library for the machine that it is written on, where that has a compiler; other tools compile the sources.

    CasADi calls its writing of FMUs experimental, so each is checked by fmpy in the tests. While it writes, the
    process's working directory is another one.

    Example:
        >>> export_fmi(learner.policy, "controller")
        >>> fmpy.simulate_fmu("controller/model.fmu", start_values={"theta": 0.3}, stop_time=10.0)

    Args:
        policy: The policy, or the file of one or of a learner.
        folder: Where to write; made if missing. A file of the same name is overwritten.

    Returns:
        The file written.

    Raises:
        InvalidArgumentError: For a model that is a discrete map: model exchange takes differential equations.
        FileFormatError: If the file is damaged or foreign.
        StorageError: If nothing could be written there.
    """
    check_output_folder(folder, (_FILE,))
    mpc = (policy if isinstance(policy, Acting) else load_policy(policy)).mpc
    with _working_directory, TemporaryDirectory(prefix="mpcoffline-") as scratch, contextlib.chdir(scratch):
        held = _held(mpc)
    packed = BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in held.items():
            archive.writestr(name, content)
    return [write_file(Path(folder) / _FILE, packed.getvalue())]


def _held(mpc: MPC) -> dict[str, bytes]:
    """The files of the archive, by their names in it; made in the working directory."""
    described = _described(mpc)
    files = described.export_fmu({"no_warning": True, "with_serialization": False})
    header = resources.files(__package__).joinpath("fmi_types.txt").read_text(encoding="utf-8")
    Path("fmi3Functions.h").write_text(header, encoding="utf-8")
    held = {archived.removeprefix("./"): Path(name).read_bytes() for name, archived in files.items()}
    held["modelDescription.xml"] = _corrected(held["modelDescription.xml"], described, mpc.model.dt)
    held["sources/fmi3Functions.h"] = header.encode()
    sources = [name for name in files if name.endswith(".c")]
    held["sources/buildDescription.xml"] = _build_description(sources)
    return held | _library(sources)


def _described(mpc: MPC) -> ca.DaeBuilder:
    """The differential equation with its variables."""
    model, layout = mpc.model, mpc.layout
    if model.ode is None:
        raise InvalidArgumentError(
            "model",
            expected="an ordinary differential equation, which FMI's model exchange takes",
            actual=f"a discrete map of {model.dt:g} s",
            hint="export_casadi, `export --to casadi`, writes maps, too.",
        )
    states, signals = layout.y_labels[: layout.n_states], [(s.name, s.unit) for s in layout.signals]
    inputs, usual = layout.u_labels, [s.usual for s in layout.signals]
    blocks = [(name, block.unit) for block in model.space for name in block.coordinate_names]
    labels = [*states, *inputs, *signals, *blocks]
    # Two may have one name, as a state and a parameter: then the kind goes before it.
    kinds = ["state"] * len(states) + ["input"] * len(inputs) + ["signal"] * len(signals) + ["parameter"] * len(blocks)
    names = [name for name, _ in labels]
    shown = [f"{kind} {name}" if names.count(name) > 1 else name for kind, name in zip(kinds, names, strict=True)]
    identifiers = c_identifiers([*shown, "time", _NAME])
    starts = np.concatenate([at_rest(mpc)[: layout.n_states], mpc.usual_input, usual, model.space.theta])
    free = np.full(len(states), np.inf), np.full(len(signals), np.inf)
    low = np.concatenate([-free[0], np.asarray(mpc.action_low), -free[1], model.space.low])
    high = np.concatenate([free[0], np.asarray(mpc.action_high), free[1], model.space.high])

    described = ca.DaeBuilder(_NAME, "", {})
    columns: dict[str, list[ca.MX]] = {"state": [], "input": [], "signal": [], "parameter": []}
    causality = {
        "state": ("output", "continuous", {"initial": "exact"}),
        "input": ("input", "continuous", {}),
        "signal": ("input", "continuous", {}),
        "parameter": ("parameter", "tunable", {}),
    }
    for i, (kind, (label, unit)) in enumerate(zip(kinds, labels, strict=True)):
        role, variability, more = causality[kind]
        options: dict[str, Any] = {"start": float(starts[i]), "description": label} | more
        options |= {"unit": unit} if unit else {}
        options |= {side: float(at[i]) for side, at in (("min", low), ("max", high)) if np.isfinite(at[i])}
        columns[kind].append(described.add(identifiers[shown[i]], role, variability, options))
    x, u, p = (_column(part) for part in (columns["state"], columns["input"] + columns["signal"], columns["parameter"]))
    for state, rate in zip(columns["state"], ca.vertsplit(model.ode(x, u, p)), strict=True):
        described.eq(described.der(state), rate)
    return described


def _column(parts: list[ca.MX]) -> ca.MX:
    return ca.vertcat(*parts) if parts else ca.MX(0, 1)


def _corrected(text: bytes, described: ca.DaeBuilder, dt: float) -> bytes:
    """CasADi's description of the model as FMI 3.0 asks for it: without its helpers, with units and a step."""
    root = ET.fromstring(text)
    variables, structure = root.find("ModelVariables"), root.find("ModelStructure")
    if variables is None or structure is None:
        raise InvalidArgumentError("CasADi", expected="a version that describes FMUs", actual=version("casadi"))
    for variable in list(variables):
        if variable.get("name", "").startswith(_HELPER):
            variables.remove(variable)
    # States whose start is given are not to be found by an initialisation.
    known = {v.get("valueReference") for v in variables if v.get("name") in set(described.x())}
    for unknown in structure.findall("InitialUnknown"):
        if unknown.get("valueReference") in known:
            structure.remove(unknown)
    place = list(root).index(variables)
    root.insert(place, ET.Element("DefaultExperiment", stepSize=repr(dt)))
    if units := sorted({unit for v in variables if (unit := v.get("unit"))}):
        defined = ET.Element("UnitDefinitions")
        defined.extend(ET.Element("Unit", name=unit) for unit in units)
        root.insert(place, defined)
    ET.indent(root)
    return bytes(ET.tostring(root, encoding="utf-8", xml_declaration=True))


def _build_description(sources: list[str]) -> bytes:
    """What is to be compiled, for tools that do it themselves."""
    root = ET.Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = ET.SubElement(root, "BuildConfiguration", modelIdentifier=_NAME)
    files = ET.SubElement(configuration, "SourceFileSet", language="C99")
    for name in sorted(sources):
        ET.SubElement(files, "SourceFile", name=name)
    ET.indent(root)
    return bytes(ET.tostring(root, encoding="utf-8", xml_declaration=True))


def _library(sources: list[str]) -> dict[str, bytes]:
    """The compiled library of this machine by its name in the archive; none where nothing compiles it."""
    system = {"linux": ("linux", ".so"), "darwin": ("darwin", ".dylib")}.get(sys.platform)
    said = "no C compiler"
    for compiler in compilers() if system else []:
        flags = ("-std=gnu11", "-O2", "-fPIC", "-shared", "-fvisibility=hidden", "-w", "-I.")
        try:
            done = run_bounded([*split(compiler), *flags, *sources, "-o", "library", "-lm"], timeout=_SECONDS)
        except subprocess.TimeoutExpired:
            said = f"{compiler}: no result within {_SECONDS:.0f} s"
            continue
        if system and done.returncode == 0:
            machine = {"AMD64": "x86_64", "arm64": "aarch64"}.get(platform.machine(), platform.machine())
            return {f"binaries/{machine}-{system[0]}/{_NAME}{system[1]}": Path("library").read_bytes()}
        said = f"{compiler}: {done.stderr.strip()[:200] or f'exit code {done.returncode}'}"
    warn_once(f"{_FILE} has its sources alone, nothing compiled ({said}).")
    return {}
