"""A room and its walls, heated at a price that changes: warm enough by day, as cheap as possible."""

import casadi as ca

from mpcoffline import Input, Limit, Parameter, Plant, Signal, State


def dynamics(x, u, d, p):
    return {
        "air": p.wall * (x.walls - x.air) + p.leak * (d.outside - x.air) + p.heat * u.heating + 0.0005 * d.sun,
        "walls": 0.1 * p.wall * (x.air - x.walls) + 0.000003 * (d.outside - x.walls),
    }


def cost(x, u, d):  # cents, with discomfort at 20 cents a kelvin and quarter of an hour, squared
    missing = d.wanted - x.air
    return 0.25 * d.price * u.heating + 20.0 * ca.fmax(missing, 0.0) ** 2 + 1.0 * missing**2 + 0.05 * u.heating**2


plant = Plant(
    "room",
    dt=900.0,
    states=[
        State("air", "degC", 5, 35, start=(17, 22), noise=0.05),
        State("walls", "degC", 5, 35, start=(17, 20), noise=0.05),
    ],
    inputs=[Input("heating", "kW", 0, 4)],
    signals=[
        Signal("wanted", "degC", low=18, high=22),
        Signal("outside", "degC", low=-5, high=12),
        Signal("sun", "kW/m2", low=0, high=0.6),
        Signal("price", "ct/kWh", low=15, high=45),
    ],
    parameters={
        "wall": Parameter(0.0003, unit="1/s", spread=0.4),
        "leak": Parameter(0.00003, unit="1/s", spread=0.5),
        "heat": Parameter(0.0004, unit="K/s/kW", spread=0.4),
    },
    dynamics=dynamics,
    cost=cost,
    limits=[Limit("too warm", "air", high=25.0, soft=100.0)],
    horizon=32,
    discount=0.98,
)
