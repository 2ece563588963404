"""The recipes that are used, for one lung and for all six; how they were found: the docs."""

from __future__ import annotations

from dataclasses import replace

from ventbench.errors import InputError
from ventbench.training.rl import breaths
from ventbench.training.rl.dqn import DQN
from ventbench.training.rl.policy_gradient import PolicyGradient
from ventbench.training.rl.ppo import PPO

#: Names of the methods, as commands and tables have them.
METHODS = ("policy-gradient", "ppo", "dqn")

#: Iterations between two points of a learning curve.
CHUNKS = {"policy-gradient": 10, "ppo": 10, "dqn": 50}

Recipe = PolicyGradient | PPO | DQN

_ONE: dict[str, Recipe] = {"policy-gradient": PolicyGradient(), "ppo": PPO(), "dqn": DQN()}
_ALL: dict[str, Recipe] = {
    "policy-gradient": PolicyGradient(breaths=36),
    "ppo": PPO(breaths=288, widths=(64, 64)),
    "dqn": DQN(breaths=72, memory=7200, widths=(128, 128)),
}


def recipe(name: str, lungs: int, steps: int | None = None) -> Recipe:
    """Return the recipe of a method.

    Args:
        name: one of :data:`METHODS`.
        lungs: on which one network is trained: 1 or 6.
        steps: control steps of experience; those of the recipe if not given.

    Raises:
        InputError: if the steps do not make one iteration.
    """
    found = (_ONE if lungs == 1 else _ALL)[name]
    if steps is None:
        return found
    iterations = steps // (found.breaths * breaths.STEPS)
    if iterations < 1:
        raise InputError(
            f"{steps} steps are less than one iteration of {name}, "
            f"{found.breaths} breaths of {breaths.STEPS} steps"
        )
    return replace(found, iterations=iterations)
