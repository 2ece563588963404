"""Train PPO of Stable-Baselines3 to correct a PID on 144 ventilators at once; make it a submission.

Needs `pip install stable-baselines3` beside ventbench[gym]. The number of thousands of steps may
follow as an argument: 1000 by default, about five minutes on two cores.
"""

import inspect
import sys
from pathlib import Path

import gymnasium
import numpy as np
from safetensors.numpy import save_file
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv

import ventbench

STEPS = 1000 * int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000
OUT = Path("runs/stable_baselines3/sb3_ppo")
COMMANDS = 102  # of an episode: three breaths, as scored


class CorrectedPID:
    """A PID, what it remembers of the breath, and the correction of its command by a network.

    All numbers have the shape (...) of the observations: one ventilator, or many at once.
    """

    GAINS = 6.0, 6.0, 0.3  # P, I, D, %/cmH2O: the best single PID of the paper's grid
    TIME_CONSTANT = 0.5  # s, of both averages
    LARGEST = 50.0  # correction, %
    REMEMBERED = 4  # errors and commands

    def see(self, x):
        """Return what the network sees: the observation x (..., 15) and what came before it."""
        if np.all(x[..., 13] == 0.0):  # a new breath
            nothing = np.zeros_like(x[..., 0])
            self.error = self.integral = self.derivative = nothing
            self.errors = [nothing] * self.REMEMBERED
            self.commands = [nothing] * self.REMEMBERED
        before, self.error = self.error, 40 * (x[..., 1] - x[..., 0])  # cmH2O
        a = 0.03 * x[..., 14] / (0.03 * x[..., 14] + self.TIME_CONSTANT)
        self.integral = self.integral + a * (self.error - self.integral)
        self.derivative = self.derivative + a * (self.error - before - self.derivative)
        p, i, d = self.GAINS
        pid = p * self.error + i * self.integral + d * self.derivative
        self.pid = np.clip(pid, 0.0, 100.0)
        self.errors = [self.error / 10, *self.errors[:-1]]
        memory = [self.integral / 5, self.derivative, self.pid / 50, *self.errors, *self.commands]
        return np.concatenate([x, np.stack(memory, axis=-1)], axis=-1)

    def command(self, action):
        """Return u_in, %, for the answer (...) of the network."""
        u_in = np.clip(self.pid + self.LARGEST * action, 0.0, 100.0)
        self.commands = [u_in / 50, *self.commands[:-1]]
        return u_in


class Ventilators(VecEnv):
    """The vector environment as Stable-Baselines3 wants it: episodes begin anew by themselves."""

    def __init__(self, count):
        self.made = gymnasium.make_vec("ventbench.gym_env:ventbench/Ventilator-v1", num_envs=count)
        self.pid = CorrectedPID()
        seen = self.pid.see(self.made.reset(seed=0)[0])
        space = gymnasium.spaces.Box(-np.inf, np.inf, seen.shape[1:], np.float32)
        super().__init__(count, space, self.made.single_action_space)

    def reset(self):
        return self.pid.see(self.made.reset(seed=self._seeds[0])[0])

    def step_async(self, actions):
        self.actions = self.pid.command(actions[:, 0])[:, None] / 50 - 1

    def step_wait(self):
        seen, rewards, ended, _, info = self.made.step(self.actions)
        seen = self.pid.see(seen)
        infos = [{} for _ in range(self.num_envs)]
        if ended.all():
            errors = info["error"]
            for k in range(self.num_envs):
                infos[k] = {
                    "terminal_observation": seen[k],
                    "episode": {"r": -errors[k], "l": COMMANDS, "t": 0.0},
                }
            seen = self.pid.see(self.made.step(self.actions)[0])  # begins new episodes
        return seen, rewards, ended, infos

    def close(self):
        self.made.close()

    def get_attr(self, attr_name, indices=None):
        return [getattr(self.made, attr_name, None)] * self.num_envs

    # VecEnv demands the next two methods, and PPO calls neither: they reach into single
    # environments, and here all of them are one compiled program.
    def set_attr(self, attr_name, value, indices=None):
        raise NotImplementedError

    def env_method(self, method_name, *args, indices=None, **kwargs):
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class, indices=None):
        return [False] * self.num_envs


CONTROLLER = '''"""A PID whose command a policy of Stable-Baselines3 corrects, in numpy."""

from pathlib import Path

import numpy as np
from safetensors.numpy import load_file

weights = load_file(Path(__file__).with_name("weights.safetensors"))


{pid}

class Controller:
    def reset(self, task):
        self.pid = CorrectedPID()

    def act(self, observation):
        x = np.array(
            [
                observation.pressure / 40,
                observation.target / 40,
                *(target / 40 for target in observation.targets_ahead),
                observation.previous_u_in / 50 - 1,
                observation.time,
                observation.dt / 0.03,
            ]
        )
        x = self.pid.see(x)
        for k in range(2):
            x = np.tanh(weights[f"w{{k}}"] @ x + weights[f"b{{k}}"])
        action = float((weights["w2"] @ x + weights["b2"])[0])
        return float(self.pid.command(min(max(action, -1.0), 1.0)))
'''

MANIFEST = """name = "sb3_ppo"
authors = ["you"]
licence = "Apache-2.0"
api_version = 1
family = "ppo"
tracks = ["robustness"]
description = "PPO of Stable-Baselines3 on top of a PID, one network for all lungs."

[training]
data = "no recordings; breaths on the six frozen simulators with random deviations"
simulators = "1"
seeds = [0]
"""


def export(model, folder):
    """Write the PID and the policy's mean action as a submission."""
    policy = model.policy
    layers = [policy.mlp_extractor.policy_net[0], policy.mlp_extractor.policy_net[2]]
    arrays = {}
    for k, layer in enumerate([*layers, policy.action_net]):
        arrays[f"w{k}"] = layer.weight.detach().cpu().numpy()
        arrays[f"b{k}"] = layer.bias.detach().cpu().numpy()
    folder.mkdir(parents=True, exist_ok=True)
    save_file(arrays, folder / "weights.safetensors")
    (folder / "controller.py").write_text(CONTROLLER.format(pid=inspect.getsource(CorrectedPID)))
    (folder / "submission.toml").write_text(MANIFEST)
    (folder / "README.md").write_text("PPO of Stable-Baselines3 on top of a PID; see examples/.\n")


model = PPO(
    "MlpPolicy",
    Ventilators(144),
    n_steps=COMMANDS,
    batch_size=1224,
    n_epochs=6,
    gamma=0.95,
    gae_lambda=0.9,
    learning_rate=lambda left: 1e-3 * left,  # falls to 0
    policy_kwargs={"net_arch": [64, 64], "log_std_init": -2.1},  # explores by 6 %
    seed=0,
    device="cpu",
    verbose=1,
)
model.learn(STEPS)
export(model, OUT)

mine = ventbench.score(OUT, draws=3)
pid = ventbench.score("pid_robust", draws=3, track="robustness")
print(mine)
print(f"mean of three draws: PPO {mine.drawn.mean():.3f}, PID {pid.drawn.mean():.3f} cmH2O")
