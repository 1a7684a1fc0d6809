"""The cart-pole swing-up, of which the place of the cart and the angle of the pole are measured, as cosine and sine."""

import gymnasium as gym
import numpy as np

import mpcoffline

NAME, DATASET = "mpcoffline/CartPoleSwingUp-v0", "mpcoffline/cartpole/ddpg-v0"
DT, STEPS, DISCOUNT, N_EPISODES = 0.05, 100, 0.9, 100
OUTPUTS = [0, 2, 3]  # places of the states that are measured
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
    return mpcoffline.nominal_mpc(NAME, alpha=1.0, seed=seed)


def truth():
    return mpcoffline.nominal_mpc(NAME, alpha=0.0, seed=0)
