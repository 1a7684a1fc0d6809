"""A ``torch.nn.Module`` as CasADi expressions: what it does to one row, traced by ``torch.fx``."""

from __future__ import annotations

import copy
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.types import Array

_Elementwise = Callable[..., Any]


def _gelu(x: Any, approximate: str = "none") -> Any:
    inner = x * (1 + 0.044715 * x * x) * np.sqrt(2 / np.pi)
    return 0.5 * x * (1 + (ca.tanh(inner) if approximate == "tanh" else ca.erf(x / np.sqrt(2))))


def _softplus(x: Any, beta: float = 1.0, threshold: float = 20.0) -> Any:
    y = beta * x
    return ca.if_else(y > threshold, x, ca.log1p(ca.exp(ca.fmin(y, threshold))) / beta)


def _elu(x: Any, alpha: float = 1.0) -> Any:
    return ca.if_else(x > 0, x, alpha * ca.expm1(ca.fmin(x, 0)))


def _sigmoid(x: Any) -> Any:
    return 1 / (1 + ca.exp(-x))


def _clamp(x: Any, min: float | None = None, max: float | None = None) -> Any:
    x = x if min is None else ca.fmax(x, min)
    return x if max is None else ca.fmin(x, max)


# By the name that torch has for it, as a function, a method and in lower case as a module.
_ELEMENTWISE: dict[str, _Elementwise] = {
    "relu": lambda x: ca.fmax(x, 0),
    "leaky_relu": lambda x, negative_slope=0.01: ca.if_else(x > 0, x, negative_slope * x),
    "silu": lambda x: x * _sigmoid(x),
    "sigmoid": _sigmoid,
    "softplus": _softplus,
    "elu": _elu,
    "gelu": _gelu,
    "softsign": lambda x: x / (1 + ca.fabs(x)),
    "clamp": _clamp,
    "hardtanh": lambda x, min_val=-1.0, max_val=1.0: _clamp(x, min_val, max_val),
    "square": lambda x: x * x,
    "pow": lambda x, exponent: x**exponent,
    "neg": lambda x: -x,
    "abs": ca.fabs,
    "add": operator.add,
    "sub": operator.sub,
    "mul": operator.mul,
    "div": operator.truediv,
    "truediv": operator.truediv,
    "true_divide": operator.truediv,
}
_ELEMENTWISE |= {
    name: getattr(ca, name) for name in ("tanh", "exp", "log", "log1p", "expm1", "sqrt", "sin", "cos", "tan", "erf")
}
# Of modules with settings: the names of those that the function takes, in its order.
_SETTINGS = {
    "LeakyReLU": ("leaky_relu", ("negative_slope",)),
    "Softplus": ("softplus", ("beta", "threshold")),
    "ELU": ("elu", ("alpha",)),
    "GELU": ("gelu", ("approximate",)),
    "Hardtanh": ("hardtanh", ("min_val", "max_val")),
}
_PLAIN = {name: name.lower() for name in ("Tanh", "ReLU", "SiLU", "Sigmoid", "Softsign")}
_NOTHING = ("Identity", "Dropout")
_KEEPS = ("contiguous", "clone", "detach", "double", "float", "dropout")
LAYERS = sorted(["Linear", "LayerNorm", "BatchNorm1d", *_SETTINGS, *_PLAIN, *_NOTHING])


class TorchExpression:
    """A module as a function of CasADi columns, with its weights as numbers or as symbols.

    Args:
        module: Takes rows of numbers, or states, inputs and, where there are some, signals as arguments of their own;
            taken as in ``eval()``.

    Attributes:
        weights: Its learnable tensors by name, dots as underscores, in float64.

    Raises:
        InvalidArgumentError: For a module that ``torch.fx`` cannot trace.
    """

    weights: dict[str, Array]

    def __init__(self, module: Any) -> None:
        import torch
        from torch import fx

        if not isinstance(module, torch.nn.Module):
            raise InvalidArgumentError("module", expected="a torch.nn.Module", actual=type(module).__name__)
        self._module = copy.deepcopy(module).cpu().double().eval()
        try:
            self._graph = fx.symbolic_trace(self._module)
        except Exception as error:  # whatever a module's own code raises when its inputs are symbols
            raise InvalidArgumentError(
                "module",
                expected="one that torch.fx can trace",
                actual=f"{type(error).__name__}: {error}"[:200],
                hint="Its forward must not decide by values.",
            ) from error
        self._tensors: dict[str, Array] = {
            name: tensor.detach().numpy().astype(np.float64)
            for name, tensor in (*self._module.named_parameters(), *self._module.named_buffers())
        }
        self.weights = {_named(name): self._tensors[name] for name, _ in self._module.named_parameters()}

    def __call__(self, parts: Sequence[ca.SX], p: Mapping[str, ca.SX] | None = None) -> ca.SX:
        """The module's output for states, inputs and, if any, signals, a column.

        Args:
            parts: These columns; one behind the other where the module takes one argument.
            p: Symbols for its weights by name, in their shapes; numbers when None.

        Raises:
            InvalidArgumentError: For a layer or an operation that is not known.
        """
        placeholders = sum(node.op == "placeholder" for node in self._graph.graph.nodes)
        given = iter([ca.vertcat(*parts)] if placeholders == 1 else parts)
        work: dict[Any, Any] = {}

        def value(argument: Any) -> Any:
            if isinstance(argument, (tuple, list)):
                return type(argument)(value(element) for element in argument)
            return work.get(argument, argument) if not isinstance(argument, slice) else argument

        for node in self._graph.graph.nodes:
            arguments, settings = [value(a) for a in node.args], {key: value(a) for key, a in node.kwargs.items()}
            if node.op == "placeholder":
                if (work_value := next(given, None)) is None:
                    raise InvalidArgumentError(
                        "module", expected=f"one argument, or {len(parts)}", actual=str(placeholders)
                    )
                work[node] = work_value
            elif node.op == "get_attr":
                work[node] = self._tensor(str(node.target), p)
            elif node.op == "call_module":
                work[node] = self._layer(str(node.target), arguments, p)
            elif node.op == "output":
                return ca.vec(ca.SX(arguments[0]))
            else:
                name = node.target if node.op == "call_method" else getattr(node.target, "__name__", str(node.target))
                work[node] = _operation(str(name).strip("_"), arguments, settings)
        raise InvalidArgumentError("module", expected="an output", actual="none")

    def _tensor(self, name: str, p: Mapping[str, ca.SX] | None) -> Any:
        """A tensor as symbols or numbers; one row is a column."""
        if p is not None and _named(name) in p:
            return p[_named(name)]
        found = self._tensors.get(name)
        if found is None:
            raise InvalidArgumentError("module", expected="tensors of its own", actual=name)
        return ca.DM(found.T if found.ndim == 2 and len(found) == 1 else found)

    def _layer(self, target: str, arguments: list[Any], p: Mapping[str, ca.SX] | None) -> Any:
        layer, kind = self._module.get_submodule(target), type(self._module.get_submodule(target)).__name__
        (x,) = arguments
        if kind == "Linear":
            y = self._matrix(f"{target}.weight", p) @ x
            return y if layer.bias is None else y + self._tensor(f"{target}.bias", p)
        if kind in ("LayerNorm", "BatchNorm1d"):
            return self._normalised(layer, target, x, p)
        if kind in _SETTINGS:
            name, settings = _SETTINGS[kind]
            return _ELEMENTWISE[name](x, *(getattr(layer, setting) for setting in settings))
        if kind in _PLAIN:
            return _ELEMENTWISE[_PLAIN[kind]](x)
        if kind in _NOTHING:
            return x
        raise InvalidArgumentError(
            "module", expected=f"layers among {', '.join(LAYERS)}", actual=f"{kind} (in {target!r})"
        )

    def _matrix(self, name: str, p: Mapping[str, ca.SX] | None) -> Any:
        return p[_named(name)] if p is not None and _named(name) in p else ca.DM(self._tensors[name])

    def _normalised(self, layer: Any, target: str, x: Any, p: Mapping[str, ca.SX] | None) -> Any:
        """(x - mean) / sqrt(variance + eps), of the row itself or as in training; scaled where it has weights."""
        if type(layer).__name__ == "LayerNorm":
            if tuple(layer.normalized_shape) != (x.shape[0],):
                raise InvalidArgumentError(
                    "module", expected=f"a LayerNorm of {x.shape[0]} numbers", actual=str(layer.normalized_shape)
                )
            mean = ca.sum1(x) / x.shape[0]
            variance = ca.sumsqr(x - mean) / x.shape[0]
        elif layer.running_mean is None:
            raise InvalidArgumentError("module", expected="a BatchNorm1d with statistics", actual="one without")
        else:
            mean, variance = (ca.DM(self._tensors[f"{target}.running_{name}"]) for name in ("mean", "var"))
        y = (x - mean) / ca.sqrt(variance + layer.eps)
        y = y if layer.weight is None else y * self._tensor(f"{target}.weight", p)
        return y if layer.bias is None else y + self._tensor(f"{target}.bias", p)


def _named(name: str) -> str:
    return name.replace(".", "_")


def _operation(name: str, arguments: list[Any], settings: dict[str, Any]) -> Any:
    """One function or method of torch, on columns."""
    if name == "linear":
        x, weight, *bias = [*arguments, *settings.values()]
        y = (weight.T if weight.shape == x.shape else weight) @ x
        return y + bias[0] if bias and bias[0] is not None else y
    if name in ("cat", "concat"):
        dimension = settings.get("dim", arguments[1] if len(arguments) > 1 else 0)
        if dimension in (-1, 1):
            return ca.vertcat(*arguments[0])
    if name == "getitem":
        return _element(*arguments)
    if name in _KEEPS:
        return arguments[0]
    if name == "matmul":
        return arguments[1].T @ arguments[0]
    if name in _ELEMENTWISE:
        settings.pop("inplace", None)
        try:
            return _ELEMENTWISE[name](*arguments, **settings)
        except TypeError as error:
            name = f"{name}: {error}"
    raise InvalidArgumentError(
        "module",
        expected=f"layers among {', '.join(LAYERS)}, or functions of torch that act on each number",
        actual=name,
    )


def _element(x: Any, index: Any) -> Any:
    """x[..., k] or x[..., a:b], of the last dimension."""
    last = index[-1] if isinstance(index, tuple) else index
    before = index[:-1] if isinstance(index, tuple) else ()
    if all(part is Ellipsis or part == slice(None) for part in before) and isinstance(index, tuple):
        return x[last]
    raise InvalidArgumentError("module", expected="elements x[..., k] or x[..., a:b]", actual=f"x[{index}]")
