"""The file of a learner: a zip of JSON and npz."""

from __future__ import annotations

from os import PathLike
from typing import TYPE_CHECKING

from mpcoffline.core.archive import box_from_json, box_to_json, file_errors, read_archive, with_ending, write_archive
from mpcoffline.core.errors import FileFormatError
from mpcoffline.core.text import check_name
from mpcoffline.estimation import Sensors
from mpcoffline.learning import METHODS, FitResult, ValueFunction
from mpcoffline.mpc import MPC

from .candidates import TRIALS, Candidates, whole_fit
from .checkpoint import history_from_json
from .softening import check_soften

if TYPE_CHECKING:
    from .learner import OfflineMPCLearner


def write_learner(learner: OfflineMPCLearner, path: str | PathLike[str]) -> None:
    """See :meth:`OfflineMPCLearner.save`."""
    space = learner._observation_space
    document = {
        "nominal": learner.nominal_mpc.to_json(),
        "learned": None if learner._mpc is None else learner.mpc.to_json(),
        "learn": learner.learn,
        "preset": learner.preset,
        "method": learner.method.name,
        "options": learner.method.to_json(),
        "value_given": learner._given_value_function is not None,
        "seed": learner.seed,
        "device": learner.device,
        "history": learner.history,
        "result": None if learner.result is None else learner.result.to_json(),
        "candidate": learner.candidate,
        "polish": learner.polish,
        "soften": learner.soften,
        "keep_limits": learner.keep_limits,
        "sensors": None if learner.sensors is None else learner.sensors.to_json(),
        "start": None if learner.start is None else learner.start.to_json(),
        "candidates": None if learner.candidates is None else learner.candidates.to_json(),
        "observation_space": None if space is None else box_to_json(space),
    }
    value = learner._given_value_function or learner.value_function
    arrays = {} if value is None else value.to_arrays()
    if learner.candidates is not None:
        arrays |= learner.candidates.to_arrays()
    write_archive(path, "learner", document, arrays)


def read_learner(cls: type[OfflineMPCLearner], path: str | PathLike[str]) -> OfflineMPCLearner:
    """See :meth:`OfflineMPCLearner.load`."""
    path = with_ending(path)
    document, arrays = read_archive(path, "learner")
    method = METHODS.of_file(document.get("method"), str(path))
    with file_errors(path):
        nominal = MPC.from_json(document["nominal"])
        how = method.from_json(document["options"])
        learner = cls(nominal, document["learn"], seed=document["seed"], method=how, device=document["device"])
        if document["preset"] is not None:
            learner.preset = check_name("preset", document["preset"], error=FileFormatError)
        learner.history = history_from_json(document["history"])
        if document["learned"] is not None:
            learner._mpc = MPC.from_json(document["learned"])
        learner.candidate = check_name("candidate", document["candidate"], error=FileFormatError)
        learner.polish = document["polish"] is True
        learner.soften = check_soften(document["soften"], FileFormatError)
        if document["keep_limits"] is not None:
            learner.keep_limits = float(document["keep_limits"])
        if document.get("start") is not None:
            learner.start = MPC.from_json(document["start"])
        if document.get("sensors") is not None:
            learner.sensors = Sensors.from_json(document["sensors"], nominal)
        if document["candidates"] is not None:
            learner.candidates = Candidates.from_files(document["candidates"], arrays)
        whole = nominal if document["learned"] is None else whole_fit(learner)
        if document["result"] is not None:
            learner.result = FitResult.from_json(document["result"], whole.theta)
        if document["observation_space"] is not None:
            learner._observation_space = box_from_json(document["observation_space"])
        arrays = {name: array for name, array in arrays.items() if not name.startswith(TRIALS)}
        if arrays:
            value = ValueFunction.from_arrays(arrays).eval().requires_grad_(False)
            if value.ny not in (nominal.nx, whole.nx):
                raise FileFormatError("value function", expected="the MPC's coordinates", actual="others")
            learner._given_value_function = value if document["value_given"] else None
            learner.value_function = value.of_layout(nominal.layout, whole.layout)
    return learner
