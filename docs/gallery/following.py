"""A car that follows another at a distance which grows with its speed: comfort against keeping up."""

from mpcoffline import Input, Limit, Parameter, Plant, Signal, State


def dynamics(x, u, d, p):
    return {
        "gap": d.lead - x.speed,
        "speed": x.pull - p.drag * x.speed,
        "pull": (u.throttle - x.pull) / p.lag,
    }


def cost(x, u, d, du):
    wanted = 5.0 + 1.4 * x.speed  # m
    return 0.02 * (x.gap - wanted) ** 2 + 0.2 * (x.speed - d.lead) ** 2 + u.throttle**2 + 4.0 * du.throttle**2


plant = Plant(
    "following car",
    dt=0.2,
    states=[
        State("gap", "m", 0, 150, start=(25, 60), noise=0.2),
        State("speed", "m/s", 0, 40, start=(12, 24), noise=0.05),
        State("pull", "m/s2", -6, 4, start=0.0, noise=0.05),
    ],
    inputs=[Input("throttle", "m/s2", -5, 2.5, rate=1.0)],
    signals=[Signal("lead", "m/s", low=12, high=24)],
    parameters={
        "drag": Parameter(0.02, unit="1/s", spread=0.5),
        "lag": Parameter(0.5, low=0.1, high=2.0, unit="s", spread=0.4),
    },
    dynamics=dynamics,
    cost=cost,
    limits=[Limit("too close", "gap", low=8.0, soft=50.0)],
    horizon=30,
)
