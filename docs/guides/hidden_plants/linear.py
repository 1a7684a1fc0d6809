"""The linear task, of which the first two states are measured."""

import gymnasium as gym
import numpy as np

import mpcoffline
from mpcoffline.envs.linear_tracking import plant_matrices

NAME, DATASET = "mpcoffline/LinearTracking-v0", "mpcoffline/linear/ddpg-v0"
DT, STEPS, DISCOUNT, N_EPISODES = 0.1, 100, 0.9, 100
OUTPUTS = [0, 1]  # places of the states that are measured
WHY = "no speed is measured"


class Plant:
    def reset(self, rng):
        self.env = gym.make(NAME)
        observation, self.info = self.env.reset(seed=int(rng.integers(2**31)))
        return observation.astype(float)

    def step(self, u):
        u = np.clip(np.asarray(u, np.float32), self.env.action_space.low, self.env.action_space.high)
        observation, reward, ended, _, self.info = self.env.step(u)
        return observation.astype(float), -float(reward), ended

    def success(self):
        return bool(self.info.get("is_success", True))


def behaviour(rng):  # of the closed loops alone: the log is the data set
    space = gym.make(NAME).action_space
    return lambda observation, k: rng.uniform(space.low, space.high)


def mpc(seed):
    return mpcoffline.nominal_mpc(NAME)


def truth():
    A, B = plant_matrices(alpha=1.0)
    return mpcoffline.nominal_mpc(NAME).with_values({"model.A": A, "model.B": B})
