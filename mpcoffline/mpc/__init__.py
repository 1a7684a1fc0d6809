"""WHAT is optimised: parameters, model, costs and the MPC problem, written in CasADi."""

from __future__ import annotations

from .component import COSTS, StageCost, TerminalCost
from .constraints import CONSTRAINTS, AnyConstraint, Constraint, Penalty, StateBounds
from .cost import NormCost, QuadraticCost
from .expression_cost import ExpressionCost
from .integration_check import IntegrationCheck
from .labels import Label, Labels
from .lifted import LiftedCost, polynomial_features
from .model import Model
from .networks import ConvexNetworkCost, NetworkCost
from .parameters import Block, Parameter, ParameterSpace
from .problem import MPC
from .signals import Signal

__all__ = [
    "CONSTRAINTS",
    "COSTS",
    "MPC",
    "AnyConstraint",
    "Block",
    "Constraint",
    "ConvexNetworkCost",
    "ExpressionCost",
    "IntegrationCheck",
    "Label",
    "Labels",
    "LiftedCost",
    "Model",
    "NetworkCost",
    "NormCost",
    "Parameter",
    "ParameterSpace",
    "Penalty",
    "QuadraticCost",
    "Signal",
    "StageCost",
    "StateBounds",
    "TerminalCost",
    "polynomial_features",
]
