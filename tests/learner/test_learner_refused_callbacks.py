"""Callbacks of Stable-Baselines3's are told how they become one of ``fit``, before anything is learned."""

from __future__ import annotations

import pytest
from stable_baselines3.common.callbacks import CallbackList

from mpcoffline import InvalidArgumentError
from mpcoffline.learner.callbacks import check_callbacks


def test_what_cannot_be_called_is_refused_with_the_way_out() -> None:
    check_callbacks([print, lambda *_: None])
    with pytest.raises(InvalidArgumentError, match=r"mpcoffline\.sb3\.SB3Callback\(callback\)"):
        check_callbacks([CallbackList([])])
