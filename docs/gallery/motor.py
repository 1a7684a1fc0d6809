"""A DC motor under a load that is measured: speed follows a set-point within the limit of the current."""

from mpcoffline import Input, Limit, Parameter, Plant, Signal, State


def dynamics(x, u, d, p):
    return {
        "speed": (p.torque * x.current - p.friction * x.speed - d.load) / 0.02,
        "current": (u.voltage - 1.2 * x.current - p.torque * x.speed) / 0.03,
    }


plant = Plant(
    "motor",
    dt=0.01,
    states=[State("speed", "rad/s", -150, 150, start=(-20, 20)), State("current", "A", -40, 40, start=0.0)],
    inputs=[Input("voltage", "V", -24, 24)],
    signals=[Signal("set_point", "rad/s", low=-100, high=100), Signal("load", "N*m", low=-0.3, high=0.3)],
    parameters={
        "torque": Parameter(0.15, unit="N*m/A", spread=0.3),
        "friction": Parameter(0.003, unit="N*m*s", spread=0.5),
    },
    dynamics=dynamics,
    cost={"speed": 0.01, "voltage": 0.001},
    references={"speed": "set_point"},
    changes={"voltage": 0.002},
    limits=[Limit("over-current", "current", low=-12.0, high=12.0, soft=5.0)],
    horizon=25,
)
