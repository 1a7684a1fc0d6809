"""The plants by name: the door through which this package's and others' come in."""

from __future__ import annotations

import re

import gymnasium as gym

from .base import ControlTask
from .episode import EPISODE_STEPS
from .page import page
from .plant import Plant
from .vector import ControlTaskVectorEnv

#: Every plant by its short name, in the order in which they were registered.
PLANTS: dict[str, Plant] = {}

_NAME = re.compile(r"[a-z][a-z0-9_]{0,31}")
_ID = re.compile(r"[A-Za-z0-9_.-]+/[A-Za-z0-9_.-]+-v\d+")


def register(task: type[ControlTask]) -> type[ControlTaskVectorEnv]:
    """Adds a plant: its environment to Gymnasium, itself to :data:`PLANTS`.

    Works from any importable module, of this package or of another::

        MyTaskVectorEnv = register(MyTaskEnv)

    The assignment matters: Gymnasium finds both classes by the module and their names, since Minari stores the spec of
    an environment as JSON and could not rebuild it from a class.

    Args:
        task: The environment, ``SomethingEnv``, with its ``plant``.

    Returns:
        Its vector twin, ``SomethingVectorEnv``.

    Raises:
        ValueError: For a class without plant or without one of its methods, and for a name or id that is malformed or
            taken.
    """
    plant = getattr(task, "plant", None)
    if not (isinstance(task, type) and issubclass(task, ControlTask) and isinstance(plant, Plant)):
        raise ValueError(f"plant: expected a subclass of ControlTask with a plant, got {task!r}.")
    if task.draw is ControlTask.draw:
        raise ValueError(f"plant {plant.name!r}: expected an environment with a method draw, got {task!r}.")
    if not (_NAME.fullmatch(plant.name) and _ID.fullmatch(plant.id) and task.__name__.endswith("Env")):
        raise ValueError(
            "plant: expected a name of small letters, digits and _, an id 'namespace/Name-v0' and a class 'NameEnv', "
            f"got {plant.name!r}, {plant.id!r} and {task.__name__!r}."
        )
    entry = f"{task.__module__}:{task.__name__}"
    taken = [known.name for known in PLANTS.values() if plant.name == known.name or plant.id == known.id]
    if (taken or plant.id in gym.registry) and (
        plant.id not in gym.registry or gym.spec(plant.id).entry_point != entry
    ):
        raise ValueError(
            f"plant {plant.name!r}, {plant.id!r}: expected a name and an id that are free, got taken ones."
        )
    task.__doc__ = page(plant, task.__doc__ or "")
    twin_name = f"{task.__name__.removesuffix('Env')}VectorEnv"
    doc = f"Many copies of :class:`{task.__name__}` stepped as arrays; see :class:`ControlTaskVectorEnv`."
    members = {"task_class": task, "__module__": task.__module__, "__doc__": doc}
    twin = type(twin_name, (ControlTaskVectorEnv,), members)
    if plant.id not in gym.registry:
        gym.register(
            plant.id,
            entry_point=entry,
            vector_entry_point=f"{task.__module__}:{twin_name}",
            max_episode_steps=EPISODE_STEPS,
        )
    PLANTS[plant.name] = plant
    return twin


def find_plant(name: str) -> Plant | None:
    """The plant of a short name or a Gymnasium id (``"module:"`` before it does not matter); None for another."""
    env_id = name.rsplit(":", 1)[-1]
    return next((plant for plant in PLANTS.values() if env_id in (plant.name, plant.id)), None)
