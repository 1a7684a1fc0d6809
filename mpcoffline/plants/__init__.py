"""Plants as an engineer knows them: their descriptions, simulations and nominal controllers."""

from __future__ import annotations

from .black_box import BlackBoxPlant
from .description import Plant
from .environment import PlantEnv
from .nominal import nominal_mpc
from .outputs import Output
from .plant_file import load_description, load_plant
from .quantities import Input, Limit, State

__all__ = [
    "BlackBoxPlant",
    "Input",
    "Limit",
    "Output",
    "Plant",
    "PlantEnv",
    "State",
    "load_description",
    "load_plant",
    "nominal_mpc",
]
