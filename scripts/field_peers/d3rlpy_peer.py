#!/usr/bin/env python3
"""Trains one algorithm of d3rlpy on transitions that were handed over, and writes its policy as TorchScript.

    ENV/bin/python d3rlpy_peer.py data.npz policy.pt '{"algorithm": "iql", "seed": 0, "steps": 20000}'

Runs in an environment of its own that scripts/bench_field makes, without the project; mpcoffline.studies.field.peers
says what the data hold. The last line it prints is JSON: the CPU seconds of the training.
"""

from __future__ import annotations

import importlib.util
import json
import os
import sys
import threading
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]

#: What the authors trained with, in the scripts that reproduce their papers; a search or an option overrides it.
SETTINGS: dict[str, dict[str, Any]] = {
    "bc": {"learning_rate": 1e-3},
    "td3+bc": {
        "actor_learning_rate": 3e-4,
        "critic_learning_rate": 3e-4,
        "alpha": 2.5,
        "target_smoothing_sigma": 0.2,
        "target_smoothing_clip": 0.5,
        "update_actor_interval": 2,
    },
    "iql": {
        "actor_learning_rate": 3e-4,
        "critic_learning_rate": 3e-4,
        "expectile": 0.7,
        "weight_temp": 3.0,
        "max_weight": 100.0,
    },
    "cql": {
        "actor_learning_rate": 1e-4,
        "critic_learning_rate": 3e-4,
        "temp_learning_rate": 1e-4,
        "conservative_weight": 5.0,
        "alpha_learning_rate": 0.0,
        "n_action_samples": 10,
    },
}


def episodes_of(data: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    """The episodes in the transitions: what d3rlpy asks of one, and the observation after its last action.

    An episode ends where it terminated or where it was cut (``timeouts``); only the first is the end of the task.
    """
    ends = np.flatnonzero(data["terminals"] | data["timeouts"]) + 1
    starts = np.concatenate([[0], ends[:-1]])
    return [
        {
            "observations": data["observations"][start:end].astype(np.float32),
            "actions": data["actions"][start:end].astype(np.float32),
            "rewards": data["rewards"][start:end, None].astype(np.float32),
            "terminated": bool(data["terminals"][end - 1]),
            "last_observation": data["next_observations"][end - 1].astype(np.float32),
        }
        for start, end in zip(starts, ends, strict=True)
    ]


def scalers_of(data: dict[str, np.ndarray], episodes: list[dict[str, Any]]) -> dict[str, Any]:
    """Observations standardised, actions from their bounds to [-1, 1], returns with a range of 1000.

    The standard deviation is taken as it is: d3rlpy's own adds 1e-3, which is not small in every unit.
    """
    from d3rlpy.preprocessing import MinMaxActionScaler, MultiplyRewardScaler, StandardObservationScaler

    y = data["observations"].astype(np.float64)
    std = y.std(axis=0)
    returns = [float(episode["rewards"].astype(np.float64).sum()) for episode in episodes]
    spread = max(returns) - min(returns)
    return {
        "observation_scaler": StandardObservationScaler(y.mean(axis=0), np.where(std > 0.0, std, 1.0), eps=0.0),
        "action_scaler": MinMaxActionScaler(data["low"], data["high"]),
        "reward_scaler": MultiplyRewardScaler(1000.0 / spread if spread > 0.0 else 1.0),
    }


def made(algorithm: str, scalers: dict[str, Any], batch: int, steps: int, options: dict[str, Any]) -> Any:
    """The algorithm, with its authors' settings."""
    from d3rlpy import algos
    from d3rlpy.models.encoders import VectorEncoderFactory
    from d3rlpy.optimizers import AdamFactory
    from d3rlpy.optimizers.lr_schedulers import CosineAnnealingLRFactory

    kinds = {"bc": algos.BCConfig, "td3+bc": algos.TD3PlusBCConfig, "iql": algos.IQLConfig, "cql": algos.CQLConfig}
    settings = SETTINGS[algorithm] | {"batch_size": batch} | scalers | options
    if algorithm == "bc":
        del settings["reward_scaler"]
    if algorithm == "iql":
        settings["actor_optim_factory"] = AdamFactory(lr_scheduler_factory=CosineAnnealingLRFactory(T_max=steps))
    if algorithm == "cql":
        wide = VectorEncoderFactory([256, 256, 256])
        settings |= {"actor_encoder_factory": wide, "critic_encoder_factory": wide}
    return kinds[algorithm](**settings).create(device=False)


def drawn_at_once(buffer: Any, rng: np.random.Generator) -> Any:
    """A buffer that draws a minibatch by one index, as likely as d3rlpy's own row by row, in a tenth of the time."""
    from d3rlpy.dataset import TransitionMiniBatch

    n = buffer.transition_count
    rows = [buffer.transition_picker(*buffer.buffer[k]) for k in range(n)]
    columns = TransitionMiniBatch.from_transitions(rows)
    names = ("observations", "actions", "rewards", "next_observations", "next_actions", "terminals", "intervals")
    arrays = {name: getattr(columns, name) for name in names}

    def sample(batch_size: int) -> Any:
        chosen = rng.integers(n, size=batch_size)
        return TransitionMiniBatch(**{name: array[chosen] for name, array in arrays.items()}, transitions=[])

    buffer.sample_transition_batch = sample
    return buffer


def end_with(parent: int) -> None:
    """Ends this process soon after the one that started it."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def whole_episodes() -> Any:
    """The module of the project that lets d3rlpy use the last transition of an episode that was cut."""
    path = ROOT / "mpcoffline" / "datasets" / "interop" / "d3rlpy.py"
    spec = importlib.util.spec_from_file_location("whole_episodes", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def main() -> None:
    import d3rlpy
    import torch
    from d3rlpy.dataset import create_infinite_replay_buffer
    from d3rlpy.logging import NoopAdapterFactory

    data_file, policy_file, job = sys.argv[1], sys.argv[2], json.loads(sys.argv[3])
    end_with(os.getppid())
    torch.set_num_threads(1)
    d3rlpy.seed(job["seed"])
    with np.load(data_file) as file:
        data = dict(file)
    interop, episodes = whole_episodes(), episodes_of(data)
    buffer = create_infinite_replay_buffer(
        episodes=[interop.WholeEpisode(**episode) for episode in episodes],
        transition_picker=interop.LastTransitionPicker(),
    )
    buffer, steps = drawn_at_once(buffer, np.random.default_rng(job["seed"])), job["steps"]
    algorithm = made(job["algorithm"], scalers_of(data, episodes), job.get("batch", 256), steps, job.get("options", {}))
    start = time.process_time()
    algorithm.fit(
        buffer,
        n_steps=steps,
        n_steps_per_epoch=steps,
        logger_adapter=NoopAdapterFactory(),
        show_progress=False,
        save_interval=2,
    )
    seconds = time.process_time() - start
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the tracer, which sees shapes that never change
        algorithm.save_policy(policy_file)
    print(json.dumps({"train_s": seconds, "version": d3rlpy.__version__}))


if __name__ == "__main__":
    main()
