"""A plant of another package: a mass on a spring, from its equations to its drawing."""

from __future__ import annotations

from mpcoffline.envs import ControlTask, Input, Nominal, Parameter, Plant, State, Uniform, register


class SpringEnv(ControlTask):
    """A mass on a spring."""

    plant = Plant(
        id="own/Spring-v0",
        name="spring",
        dt=0.1,
        states=(
            State("x", "x", "m", limit=1e3, start=10.0, quantity="position", band=0.1),
            State("xd", r"\dot x", "m/s", limit=1e3, start=10.0, quantity="speed"),
        ),
        inputs=(Input("u", "u", "N", -1.0, 3.0, quantity="force"),),
        parameters=(Parameter("m", 1.0, 0.1, 10.0, "kg", spread=0.4), Parameter("k", 2.0, 0.0, 10.0, "N/m")),
        dynamics=lambda y, u, p: (y[1], (u[0] - p["k"] * y[0]) / p["m"]),
        cost=lambda s, u: s[0] ** 2 + 0.1 * s[1] ** 2 + 0.1 * u[0] ** 2,
        starts={"broad": Uniform((-1.0, -1.0), (1.0, 1.0))},
        nominal=Nominal((1.0, 0.1), (0.1,), horizon=20),
        shown=("x",),
        plane=("x", "xd"),
        coverage=(("x", "xd"), ("x", "u")),
    )

    def draw(self, canvas, moment):  # type: ignore[no-untyped-def]
        """Draws the mass."""
        canvas.disc([canvas.width / 2.0 + 50.0 * float(moment.state[0]), canvas.height / 2.0], 12.0, (0, 0, 0))


SpringVectorEnv = register(SpringEnv)
