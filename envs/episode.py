"""What the tasks' episodes have in common."""

from __future__ import annotations

#: Steps of an episode, unless ``max_episode_steps`` says another length.
EPISODE_STEPS = 100
#: The weight of a cost one step later: the discount of the nominal controllers, and of what is reported as Jd.
DISCOUNT = 0.9
