"""C of a terminal cost that is a network: loops over its weights, with the little arithmetic around them as it is.

Written out, the Hessian of 24 x 24 units by ten states is 20,000 statements, most of what a compiler had to read.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from mpcoffline.mpc import MPC
from mpcoffline.mpc.networks import NetworkCost
from mpcoffline.mpc.seen import terminal_expression
from mpcoffline.solvers.scaling import split_constant

_MOST = 1 << 14  # derivatives of hidden results: a megabyte of vectors


@dataclass(frozen=True)
class TerminalNetwork:
    """The terminal cost of an MPC as T(x, y), y = net(z(x)) without the bias of its output.

    Attributes:
        x: The state's symbols.
        z: What the network sees, affine in x.
        y: The symbol of its output.
        cost: T of x and y without its constant, linear in y.
        layers: Of each layer, the output's last: rows, columns, where in theta its weights and its biases begin.
    """

    x: ca.SX
    z: ca.SX
    y: ca.SX
    cost: ca.SX
    layers: tuple[tuple[int, int, int, int], ...]

    @classmethod
    def of(cls, mpc: MPC, x: ca.SX, theta: ca.SX) -> TerminalNetwork | None:
        """That of an MPC, in symbols of its state and its parameters.

        None for a terminal cost of another kind, and for networks whose derivatives do not fit on a thread's stack.
        """
        cost = mpc.terminal_cost
        if type(cost) is not NetworkCost or cost.n_layers < 2:
            return None
        hidden = sum(block.shape[0] for block in cost.space if block.name.startswith("biases_")) - 1
        if hidden * cost.nx > _MOST:
            return None
        y, one = ca.SX.sym("y"), ca.SX.sym("one")
        own = mpc.space.slices
        p = cost.space.symbols(ca.vertcat(*(theta[own[f"terminal_cost.{block.name}"]] for block in cost.space)))
        last = cost.n_layers - 1
        stand_in = _StandIn(cost, y * one + p[f"biases_{last}"])  # no bare symbol: its bias is to be split off
        whole, _ = split_constant(terminal_expression(mpc.layout, stand_in, x, p), ca.vertcat(x, y))
        layers = tuple(
            (*p[f"weights_{k}"].shape, own[f"terminal_cost.weights_{k}"].start, own[f"terminal_cost.biases_{k}"].start)
            for k in range(cost.n_layers)
        )
        return cls(x, stand_in.z, y, ca.substitute(whole, one, 1), layers)

    @property
    def size(self) -> int:
        """Of what ``network_expand`` writes: y, its gradient, the upper triangle of its Hessian."""
        n = self.z.numel()
        return 1 + n + n * (n + 1) // 2

    def expansion(self, found: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Gradient and Hessian of T by x, from what ``network_expand`` has found."""
        n = self.z.numel()
        gradient, hessian = found[1 : 1 + n], ca.SX(n, n)
        for b in range(n):
            for a in range(b + 1):
                hessian[a, b] = hessian[b, a] = found[1 + n + b * (b + 1) // 2 + a]
        own_hessian, own_gradient = ca.hessian(self.cost, self.x)
        seen, by_output = ca.jacobian(self.z, self.x), ca.gradient(self.cost, self.y)
        return own_gradient + by_output * (seen.T @ gradient), own_hessian + by_output * (seen.T @ hessian @ seen)

    def tables(self) -> str:
        """The layers' sizes and places, as ``network.c`` reads them; in front of it."""
        hidden = [rows for rows, *_ in self.layers[:-1]]
        sizes = {"INPUTS": self.z.numel(), "LAYERS": len(hidden), "HIDDEN": sum(hidden), "WIDEST": max(hidden)}
        rows = ", ".join(f"{{{', '.join(map(str, layer))}}}" for layer in self.layers)
        return "\n".join(
            [
                *(f"#define NETWORK_{name} {size}" for name, size in sizes.items()),
                "typedef struct { int rows, columns, weights, biases; } network_layer;",
                f"static const network_layer network[] = {{{rows}}};",
            ]
        )


class _StandIn:
    """A network cost whose output is given, for those who ask a cost for its expression."""

    def __init__(self, cost: NetworkCost, output: ca.SX) -> None:
        self.nx, self._cost, self._output = cost.nx, cost, output
        self.z = ca.SX()  # what the network sees, once it was asked

    def terminal_expression(self, x: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
        """As of a cost."""
        self.z = self._cost.standardised(x, p)
        return self._cost.of_output(self._output, x, p)


#: ``gen_final`` and ``gen_final_expand``, of the network and what is emitted around it.
COMPOSED = """static void gen_final(const vd *x, const vd *p, vd *out) {
    vd z[NETWORK_INPUTS], h[NETWORK_HIDDEN], norm[NETWORK_HIDDEN], y;
    gen_network_inputs(x, p, z);
    y = network_forward(z, p, h, norm);
    gen_final_of_network(x, &y, p, out);
}

static void gen_final_expand(const vd *x, const vd *p, vd *out) {
    vd z[NETWORK_INPUTS], found[1 + NETWORK_INPUTS + NETWORK_INPUTS * (NETWORK_INPUTS + 1) / 2];
    gen_network_inputs(x, p, z);
    network_expand(z, p, found);
    gen_final_expand_of_network(x, found, p, out);
}"""
