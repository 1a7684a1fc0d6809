"""WHAT is optimised: parameters, model, costs and the MPC problem, written in CasADi."""

from __future__ import annotations

from .component import StageCost, TerminalCost
from .constraints import Constraint, Penalty, StateBounds
from .cost import NormCost, QuadraticCost
from .model import Model
from .networks import NetworkCost
from .parameters import Block, Parameter, ParameterSpace
from .problem import MPC

__all__ = [
    "MPC",
    "Block",
    "Constraint",
    "Model",
    "NetworkCost",
    "NormCost",
    "Parameter",
    "ParameterSpace",
    "Penalty",
    "QuadraticCost",
    "StageCost",
    "StateBounds",
    "TerminalCost",
]
