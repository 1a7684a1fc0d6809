"""Models from torch modules: equal to the modules, in any door that a model goes through."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.mpc import MPC, Model, QuadraticCost, Signal
from mpcoffline.mpc.torch_twin import TorchTwin

NX, NU = 4, 2


class Normalised(nn.Module):
    """Scaled inputs and outputs by buffers, two arguments, a skip connection, functions and methods."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mean", torch.randn(1, NX + NU))
        self.register_buffer("std", torch.rand(NX + NU) + 0.5)
        self.register_buffer("scale", torch.rand(NX))
        self.first, self.second = nn.Linear(NX + NU, 24), nn.Linear(24, 24, bias=False)
        self.last = nn.Linear(24, NX)

    def forward(self, x: Tensor, u: Tensor) -> Tensor:
        z = (torch.cat([x, u], dim=-1) - self.mean) / self.std
        h = torch.tanh(self.first(z))
        h = h + functional.silu(self.second(h)) * 0.5
        return self.scale * self.last(h.clamp(min=-2.0)) + 1 - x[..., 0:1] * u[..., 1:].sigmoid()


def layers(*activations: nn.Module, width: int = 16) -> nn.Sequential:
    parts: list[nn.Module] = []
    n = NX + NU
    for activation in activations:
        parts += [nn.Linear(n, width), activation]
        n = width
    return nn.Sequential(*parts, nn.Linear(n, NX))


MODULES: dict[str, Callable[[], nn.Module]] = {
    "tanh": lambda: layers(nn.Tanh(), nn.Tanh()),
    "relu": lambda: layers(nn.ReLU(), nn.LeakyReLU(0.1)),
    "silu": lambda: layers(nn.SiLU(), nn.Sigmoid()),
    "softplus": lambda: layers(nn.Softplus(), nn.Softplus(beta=3.0, threshold=2.0)),
    "elu": lambda: layers(nn.ELU(), nn.ELU(alpha=0.7)),
    "gelu": lambda: layers(nn.GELU(), nn.GELU(approximate="tanh")),
    "others": lambda: layers(nn.Softsign(), nn.Hardtanh(-0.5, 0.7), nn.Identity()),
    "layer norm": lambda: layers(nn.Sequential(nn.LayerNorm(16), nn.Tanh()), nn.Dropout(0.5)),
    "batch norm": lambda: layers(nn.Sequential(nn.BatchNorm1d(16), nn.ReLU())),
    "nested": lambda: nn.Sequential(layers(nn.Tanh()), nn.Linear(NX, NX)),
    "own class": Normalised,
}


def module(name: str) -> nn.Module:
    torch.manual_seed(0)
    made = MODULES[name]()
    for part in made.modules():  # statistics and weights that are not those of a fresh module
        for tensor in (*part.parameters(recurse=False), *part.buffers(recurse=False)):
            if tensor.is_floating_point():
                tensor.data += 0.3 * torch.rand_like(tensor)
    return made.double().eval()


def points(dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    return tuple(2 * torch.randn(50, n, generator=generator, dtype=torch.float64).to(dtype) for n in (NX, NU))  # type: ignore[return-value]


def evaluated(network: nn.Module, x: Tensor, u: Tensor) -> np.ndarray:
    with torch.no_grad():
        out = network(x, u) if isinstance(network, Normalised) else network(torch.cat([x, u], dim=-1))
    return out.numpy().astype(np.float64)


@pytest.mark.parametrize("name", MODULES)
def test_the_model_is_the_module(name: str) -> None:
    network, (x, u) = module(name), points()
    expected = evaluated(network, x, u)
    for residual in (False, True):
        model = Model.from_torch(network, nx=NX, nu=NU, dt=0.1, residual=residual)
        next_states = x.numpy() + expected if residual else expected
        np.testing.assert_allclose(model(x.numpy(), u.numpy()), next_states, rtol=1e-12, atol=1e-12)


def test_single_precision_and_training_mode() -> None:
    network = module("layer norm").float().train()
    model = Model.from_torch(network, NX, NU, 0.1)
    assert network.training
    x, u = points(torch.float32)
    expected = evaluated(network.eval(), x, u)
    np.testing.assert_allclose(model(x.numpy(), u.numpy()), expected, rtol=1e-5, atol=1e-6)


def test_a_derivative_is_integrated() -> None:
    network, (x, u) = module("tanh"), points()

    def f(state: Tensor) -> Tensor:
        return torch.from_numpy(evaluated(network, state, u))

    k1 = f(x)
    k2 = f(x + 0.05 * k1)
    k3 = f(x + 0.05 * k2)
    expected = x + 0.1 / 6 * (k1 + 2 * k2 + 2 * k3 + f(x + 0.1 * k3))
    model = Model.from_torch(network, NX, NU, 0.1, discrete=False)
    np.testing.assert_allclose(model(x.numpy(), u.numpy()), expected.numpy(), rtol=1e-12, atol=1e-12)


def test_files_and_torch_again() -> None:
    network, (x, u) = module("own class"), points()
    model = Model.from_torch(network, NX, NU, 0.1)
    mpc = MPC(model, QuadraticCost(np.eye(NX)), QuadraticCost(np.eye(NX)), 5, 0.9, [-1.0] * NU, [1.0] * NU)
    loaded = MPC.from_json(json.loads(json.dumps(mpc.to_json())))
    expected = evaluated(network, x, u)
    np.testing.assert_allclose(loaded.model(x.numpy(), u.numpy()), expected, rtol=1e-12, atol=1e-12)
    twin = TorchTwin(mpc.dynamics_function)
    np.testing.assert_allclose(twin(x, u, torch.tensor(mpc.theta)).numpy(), expected, rtol=1e-12, atol=1e-12)


def test_weights_that_are_learned() -> None:
    network, (x, u) = module("layer norm"), points()
    model = Model.from_torch(network, NX, NU, 0.1, learn_weights=True)
    assert model.values["0_weight"].shape == (16, NX + NU)
    assert model.space.size == sum(p.numel() for p in network.parameters())
    np.testing.assert_allclose(model(x.numpy(), u.numpy()), evaluated(network, x, u), rtol=1e-12, atol=1e-12)
    with torch.no_grad():
        network[0].weight *= 1.1  # type: ignore[index]
    values = {name.replace(".", "_"): p.detach().numpy() for name, p in network.named_parameters()}
    changed = model.with_theta(model.space.pack(values))
    np.testing.assert_allclose(changed(x.numpy(), u.numpy()), evaluated(network, x, u), rtol=1e-12, atol=1e-12)


class Deciding(nn.Module):
    def forward(self, z: Tensor) -> Tensor:
        return z if z.sum() > 0 else -z


class Sorting(nn.Module):
    def forward(self, z: Tensor) -> Tensor:
        return torch.sort(z)[0]


@pytest.mark.parametrize(
    ("network", "words"),
    [
        (nn.Sequential(nn.Linear(6, 8), nn.Softmax(dim=-1), nn.Linear(8, 4)), "Softmax"),
        (nn.Sequential(nn.LSTM(6, 4)), "LSTM"),
        (Sorting(), "sort"),
        (Deciding(), r"torch\.fx can trace"),
        (nn.Linear(5, 4), r"one of 4 \+ 2 numbers a row"),
        (nn.Linear(6, 3), "a column of 4 expressions"),
        (nn.Sequential(nn.Linear(6, 4), nn.LayerNorm(3)), "LayerNorm of 4 numbers"),
        ("a file.pt", r"torch\.nn\.Module"),
    ],
)
def test_what_is_refused_is_named(network: Any, words: str) -> None:
    with pytest.raises(InvalidArgumentError, match=words):
        Model.from_torch(network, NX, NU, 0.1)


class WithSignals(nn.Module):
    """Three arguments: states, inputs, signals."""

    def __init__(self) -> None:
        super().__init__()
        self.net = nn.Sequential(nn.Linear(NX + NU + 2, 8), nn.Tanh(), nn.Linear(8, NX))

    def forward(self, x: Tensor, u: Tensor, d: Tensor) -> Tensor:
        return self.net(torch.cat([x, u, d], dim=-1)) * d[..., 1:2]


@pytest.mark.parametrize("made", [lambda: WithSignals().net, WithSignals])
def test_a_module_gets_the_present_values_of_signals(made: Callable[[], nn.Module]) -> None:
    torch.manual_seed(0)
    network = made().double()
    signals = [Signal("price", preview=1), Signal("inflow")]
    model = Model.from_torch(network, NX, NU, 0.1, signals=signals, delay=1)
    rng = np.random.default_rng(0)
    x, u, past, inflow, prices = (rng.normal(size=n) for n in (NX, NU, NU, 1, 2))
    z = np.concatenate([x, prices, inflow, past])
    outside = np.array([prices[0], inflow[0]])
    arguments = [torch.from_numpy(v) for v in (x, past, outside)]
    with torch.no_grad():
        expected = network(*arguments) if isinstance(network, WithSignals) else network(torch.cat(arguments))
    np.testing.assert_allclose(model(z, u)[:NX], expected.numpy(), rtol=1e-12)


def test_a_module_without_room_for_signals_is_refused() -> None:
    with pytest.raises(InvalidArgumentError, match=r"4 \+ 2 \+ 1 numbers"):
        Model.from_torch(module("tanh"), NX, NU, 0.1, signals=[Signal("price")])
    with pytest.raises(InvalidArgumentError, match="one argument, or 2"):
        Model.from_torch(WithSignals(), NX, NU, 0.1)
