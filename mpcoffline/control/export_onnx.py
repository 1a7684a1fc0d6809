"""What was learned as ONNX: the value function V, and explicit policies. Graphs of plain operators, written by hand."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike
from torch import nn

from mpcoffline.core.archive import file_errors, holds, read_archive, with_ending
from mpcoffline.core.errors import FileFormatError, InvalidArgumentError
from mpcoffline.core.outputs import check_output_folder, write_file
from mpcoffline.core.types import Array
from mpcoffline.learning.value.function import ValueFunction

from .explicit.policy import DistilledPolicy

OPSET = 13  # and its IR version: what runtimes of 2021 read
_IR_VERSION = 7
_VALUE = ("mean", "std", "offset", "scale", "gamma")  # V's arrays in a learner's file, beside those of its networks


def export_onnx(
    source: DistilledPolicy | ValueFunction | str | PathLike[str], folder: str | PathLike[str]
) -> list[Path]:
    """Writes an explicit policy as ``policy.onnx``, or a value function as ``value.onnx``.

    ``policy.onnx`` has the input ``observation`` ``(batch, nz)``, double: the observation, then the past inputs that
    the policy sees, if any; and the output ``action`` ``(batch, nu)``, float, within the bounds. ``value.onnx`` has the
    input ``observation`` ``(batch, nz)``, double, the MPC's state, and the output ``value`` ``(batch,)``, double: the
    discounted cost from there on, the mean of all networks that were learned. Inputs are centred in double precision,
    so that a column far from zero keeps its digits; the networks themselves are of floats.

    Needs the package ``onnx`` (``pip install "mpcoffline[onnx]"``). To run the files, any runtime of ONNX will do.

    Example:
        >>> export_onnx(learner.value_function, "controller")
        >>> session = onnxruntime.InferenceSession("controller/value.onnx")
        >>> (value,) = session.run(None, {"observation": observations})

    Args:
        source: An explicit policy, a value function, or the file of an explicit policy or of a learner, of which it is
            V. An MPC is no network: distil it first.
        folder: Where to write; made if missing. A file of the same name is overwritten.

    Returns:
        The file written.

    Raises:
        InvalidArgumentError: Where onnx is not installed, or for a policy that is an MPC.
        FileFormatError: If the file is damaged or foreign, or a learner's without V.
        StorageError: If nothing could be written there.
    """
    if not isinstance(source, (DistilledPolicy, ValueFunction)):
        if not isinstance(source, (str, PathLike)):
            raise InvalidArgumentError(
                "source",
                expected="a DistilledPolicy or a ValueFunction",
                actual=type(source).__name__,
                hint="An MPC is no network: policy.distill(...) makes one of it.",
            )
        source = _loaded(source)
    name = "policy.onnx" if isinstance(source, DistilledPolicy) else "value.onnx"
    check_output_folder(folder, (name,))
    model = _policy_model(source) if isinstance(source, DistilledPolicy) else _value_model(source)
    return [write_file(Path(folder) / name, model.SerializeToString())]


def _loaded(path: str | PathLike[str]) -> DistilledPolicy | ValueFunction:
    """What a file holds."""
    path = with_ending(path)
    if holds(path, "learner"):
        _, arrays = read_archive(path, "learner")
        own = {name: array for name, array in arrays.items() if name.startswith("net.") or name in _VALUE}
        if not own:
            raise FileFormatError(str(path), expected="a learner with a value function", actual="one without")
        with file_errors(path):
            return ValueFunction.from_arrays(own)
    if holds(path, "policy") or holds(path, "output_feedback"):
        raise FileFormatError(
            str(path),
            expected="an explicit policy or a learner",
            actual="an MPC, which is no network",
            hint="`mpcoffline distill` makes one of it.",
        )
    return DistilledPolicy.load(path)


class _Graph:
    """Nodes and constants, in order."""

    def __init__(self) -> None:
        try:
            import onnx
        except ImportError as error:
            raise InvalidArgumentError(
                "package onnx",
                expected="an installed one",
                actual=str(error),
                hint='Install it: pip install "mpcoffline[onnx]"',
            ) from error
        self._onnx = onnx
        self._nodes: list[Any] = []
        self._constants: list[Any] = []

    def constant(self, value: ArrayLike, dtype: DTypeLike = np.float32) -> str:
        """A tensor that is part of the model; its name."""
        name = f"constant_{len(self._constants)}"
        array = np.ascontiguousarray(np.asarray(value, dtype=dtype))
        self._constants.append(self._onnx.numpy_helper.from_array(array, name))
        return name

    def add(self, operator: str, *inputs: str, name: str = "", **attributes: Any) -> str:
        """A node of one output; the output's name."""
        output = name or f"{operator.lower()}_{len(self._nodes)}"
        self._nodes.append(self._onnx.helper.make_node(operator, list(inputs), [output], **attributes))
        return output

    def to_float(self, tensor: str) -> str:
        """As float."""
        return self.add("Cast", tensor, to=self._onnx.TensorProto.FLOAT)

    def to_double(self, tensor: str) -> str:
        """As double."""
        return self.add("Cast", tensor, to=self._onnx.TensorProto.DOUBLE)

    def scaled(self, tensor: str, mean: Array, spread: Array) -> str:
        """(x - mean) / spread of a double, as float."""
        centred = self.add("Sub", tensor, self.constant(mean, np.float64))
        return self.to_float(self.add("Div", centred, self.constant(spread, np.float64)))

    def affine(self, tensor: str, weight: ArrayLike, bias: ArrayLike) -> str:
        """The tensor times A', plus b."""
        product = self.add("MatMul", tensor, self.constant(np.asarray(weight).T))
        return self.add("Add", product, self.constant(bias))

    def model(self, name: str, n_in: int, shape: Sequence[str | int], kind: str, doc: str) -> Any:
        """The checked model, from ``observation`` to ``name``."""
        helper, types = self._onnx.helper, self._onnx.TensorProto
        given = helper.make_tensor_value_info("observation", types.DOUBLE, ["batch", n_in])
        result = helper.make_tensor_value_info(name, getattr(types, kind), list(shape))
        graph = helper.make_graph(self._nodes, f"mpcoffline_{name}", [given], [result], self._constants, doc)
        model = helper.make_model(
            graph,
            opset_imports=[helper.make_opsetid("", OPSET)],
            ir_version=_IR_VERSION,
            producer_name="mpcoffline",
            doc_string=doc,
        )
        self._onnx.checker.check_model(model, full_check=True)
        return model


def _policy_model(policy: DistilledPolicy) -> Any:
    """The network: u = clip(centre + unit (K v + A_n h_n + b_n), low, high), h_{k+1} = a / sqrt(1 + a^2)."""
    net, graph = policy.network, _Graph()
    one = graph.constant(1.0)
    signal = v = graph.scaled("observation", net.mean, net.spread)
    for weight, bias in zip(net.weights[:-1], net.biases[:-1], strict=True):
        a = graph.affine(signal, weight, bias)
        root = graph.add("Sqrt", graph.add("Add", graph.add("Mul", a, a), one))
        signal = graph.add("Div", a, root)
    output = graph.affine(signal, net.weights[-1], net.biases[-1])
    output = graph.add("Add", output, graph.add("MatMul", v, graph.constant(net.direct.T)))
    moved = graph.add("Mul", output, graph.constant(net.unit))
    action = graph.add("Add", moved, graph.constant(net.centre))
    with np.errstate(over="ignore"):  # a bound beyond float32 is none
        low, high = (graph.constant(bound) for bound in (net.low, net.high))
    graph.add("Min", graph.add("Max", action, low), high, name="action")
    sees = [*map(str, policy.y_labels), *(f"{name}, an input of an earlier step" for name in policy.memory_names)]
    doc = f"observation: {', '.join(sees)}; action: {', '.join(map(str, policy.u_labels))}"
    return graph.model("action", net.nz, ["batch", net.nu], "FLOAT", doc)


def _value_model(value: ValueFunction) -> Any:
    """V = offset + scale mean_i net_i((z - mean) / std), tanh between layers."""
    graph = _Graph()
    arrays = {name: array.astype(np.float64) for name, array in value.to_arrays().items() if name in _VALUE}
    scaled = graph.scaled("observation", arrays["mean"], arrays["std"])
    outputs = []
    for member in value.members:
        signal = scaled
        for layer in member:
            if isinstance(layer, nn.Linear):
                weight, bias = (part.detach().cpu().numpy() for part in (layer.weight, layer.bias))
                signal = graph.affine(signal, weight, bias)
            else:
                signal = graph.add("Tanh", signal)
        outputs.append(signal)
    mean = graph.to_double(outputs[0] if len(outputs) == 1 else graph.add("Mean", *outputs))
    column = graph.add("Mul", mean, graph.constant(arrays["scale"], np.float64))
    column = graph.add("Add", column, graph.constant(arrays["offset"], np.float64))
    graph.add("Squeeze", column, graph.constant([1], np.int64), name="value")
    return graph.model("value", value.ny, ["batch"], "DOUBLE", "the discounted cost from a state on, as learned")
