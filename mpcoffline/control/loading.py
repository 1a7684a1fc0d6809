"""A policy from its file, whichever kind it is."""

from __future__ import annotations

from os import PathLike
from typing import Any

from mpcoffline.core.archive import holds, with_ending
from mpcoffline.core.errors import FileFormatError

from .output_feedback import OutputFeedbackPolicy
from .policy import MPCPolicy

#: What acts on measurements: of the plant's states, or of its outputs.
Acting = MPCPolicy | OutputFeedbackPolicy


def load_policy(path: str | PathLike[str], **solver_options: Any) -> Acting:
    """The policy in a file of a policy or a learner, whether it sees states or outputs.

    Args:
        path: The file, with or without ``.zip``.
        **solver_options: See :meth:`mpcoffline.MPCPolicy.load`.

    Raises:
        FileFormatError: If the file is damaged, foreign or of another version.
        InvalidArgumentError: For an option that the solver has not.
        MPCOfflineError: For a learner that has not learned.
    """
    if holds(file := with_ending(path), "distilled"):
        raise FileFormatError(
            str(path),
            expected="an MPC",
            actual="an explicit policy, which was distilled from one",
            hint="DistilledPolicy.load reads it; `mpcoffline evaluate` and `export --to c|onnx` take it.",
        )
    kind = OutputFeedbackPolicy if holds(file, "output_feedback") else MPCPolicy
    return kind.load(path, **solver_options)
