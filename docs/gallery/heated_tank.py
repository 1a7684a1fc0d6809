"""A stirred tank, heated through its jacket: the heater acts late, inflow and its temperature disturb."""

from mpcoffline import Input, Limit, Parameter, Plant, Signal, State


def dynamics(x, u, d, p):
    to_tank = p.exchange * (x.jacket - x.tank)
    through = p.flushing * d.inflow * (d.inlet - x.tank)
    return {"tank": to_tank + through, "jacket": p.heating * u.heater - 0.5 * to_tank}


plant = Plant(
    "heated tank",
    dt=20.0,
    states=[State("tank", "degC", 10, 90, start=(20, 50)), State("jacket", "degC", 10, 120, start=(20, 60))],
    inputs=[Input("heater", "%", 0, 100, rate=25, delay=2)],
    signals=[
        Signal("set_point", "degC", low=40, high=65),
        Signal("inflow", "l/min", low=2, high=6),
        Signal("inlet", "degC", low=10, high=18),
    ],
    parameters={
        "exchange": Parameter(0.006, unit="1/s", spread=0.4),
        "flushing": Parameter(0.0003, unit="1/l", spread=0.4),
        "heating": Parameter(0.0008, unit="K/s", spread=0.4),
    },
    dynamics=dynamics,
    cost={"tank": 1.0, "heater": 0.001},
    references={"tank": "set_point"},
    changes={"heater": 0.005},
    limits=[Limit("jacket too hot", "jacket", high=95.0, soft=20.0)],
    horizon=25,
)
