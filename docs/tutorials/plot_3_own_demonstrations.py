"""
3. Your own demonstrations
==========================

From a Gymnasium environment to a trained and evaluated policy: record demonstrations, keep them in
an HDF5 file or as a LeRobotDataset, train, evaluate on episodes of given seeds, and look at one of
them. The task is the swing-up of Gymnasium's pendulum, whose motor is too weak to lift it in one
go.
"""

import base64
import io
import json
import tempfile
from pathlib import Path

import gymnasium
import h5py
import matplotlib.pyplot as plt
import numpy as np
import torch
from lerobot.datasets import LeRobotDataset
from PIL import Image, ImageDraw
from torchrl.data import Categorical
from torchrl.envs import GymEnv, TransformedEnv
from torchrl.envs.transforms import Compose, Transform

from warmprior import (
    GaussianPrior,
    Normalizer,
    PastPrior,
    VelocityMLP,
    WarmPriorActor,
    policy_transforms,
)
from warmprior.data import open_demonstrations
from warmprior.evaluation import evaluate
from warmprior.saving import load_policy
from warmprior.training import BehaviourCloning, TrainingConfig, precondition

torch.manual_seed(0)
folder = tempfile.TemporaryDirectory()
root = Path(folder.name)

# %%
# Recording
# ---------
# Here the demonstrator is a controller: it pumps energy into the pendulum until there is enough,
# and balances it at the top. With you at a joystick, the loop would be the same. The motor receives
# the torque with noise, and the file records what the demonstrator intended: demonstrations without
# mistakes do not show how to recover from one.


def demonstrator(observation):
    cosine, sine, speed = observation
    angle = np.arctan2(sine, cosine)  # 0 is upright
    if abs(angle) < 0.4:
        torque = -9.0 * angle - 2.0 * speed
    else:
        energy = 0.5 * speed**2 + 15.0 * cosine  # 15 at rest, upright
        torque = 0.5 * (15.0 - energy) * speed
    return np.clip([torque], -2.0, 2.0).astype(np.float32)


def record(env, seed):
    """An episode: the observation before each action, the action, the reward after it."""
    disturbance = np.random.default_rng(seed)
    observation, _ = env.reset(seed=seed)
    episode, over = {"state": [], "actions": [], "rewards": []}, False
    while not over:
        action = demonstrator(observation)
        episode["state"].append(observation)
        episode["actions"].append(action)
        noise = disturbance.normal(0.0, 1.0, 1).astype(np.float32)
        observation, reward, terminated, truncated, _ = env.step(
            action + noise
        )
        episode["rewards"].append(reward)
        over = terminated or truncated
    return {name: np.array(values) for name, values in episode.items()}


pendulum = gymnasium.make("Pendulum-v1")
episodes = [record(pendulum, seed) for seed in range(40)]
print(len(episodes), "episodes of", len(episodes[0]["actions"]), "steps")

# %%
# As an HDF5 file
# ---------------
# robomimic's layout takes ten lines: a group per demonstration with ``actions``, ``rewards`` and
# observations by name, and the environment's name in an attribute, whose type is 1 for robosuite
# and 2 for Gymnasium. :doc:`/data` has the whole format.

with h5py.File(root / "swing_up.hdf5", "w") as file:
    data = file.create_group("data")
    data.attrs["env_args"] = json.dumps(
        {"env_name": "Pendulum-v1", "type": 2, "env_kwargs": {}}
    )
    for i, episode in enumerate(episodes):
        demo = data.create_group(f"demo_{i}")
        demo["actions"] = episode["actions"]
        demo["rewards"] = episode["rewards"]
        demo["obs/state"] = episode["state"]

demos = open_demonstrations(root / "swing_up.hdf5").steps(["state"])
print(demos.select("observation", "action", "episode"))

# %%
# If a file is wrong (a missing key, other lengths, a NaN), the error names file, demonstration and
# key before anything is trained.
#
# Or as a LeRobotDataset
# ----------------------
# If you record with LeRobot, you need no HDF5. The recorder is LeRobot's own:

features = {
    "observation.state": {
        "dtype": "float32",
        "shape": (3,),
        "names": ["cos", "sin", "speed"],
    },
    "action": {"dtype": "float32", "shape": (1,), "names": ["torque"]},
}
dataset = LeRobotDataset.create(
    "me/swing_up", fps=20, features=features, root=root / "lerobot"
)
for episode in episodes[:5]:
    for state, action in zip(
        episode["state"], episode["actions"], strict=True
    ):
        dataset.add_frame(
            {"observation.state": state, "action": action, "task": "swing up"}
        )
    dataset.save_episode()
dataset.finalize()

same = open_demonstrations(f"lerobot:{root / 'lerobot'}").steps()
first = demos[: len(same)]
for key in ("observation", "action", "episode"):
    print(key, "is the same:", bool((same[key] == first[key]).all()))

# %%
# Both readers give the same tensors (here of five episodes, to save time).
#
# Training
# --------
# Networks see values between -1 and 1: the :class:`~warmprior.Normalizer` takes the range from the
# data, and travels with the policy. :class:`~warmprior.training.BehaviourCloning` is the training
# loop of the benchmarks: averaged weights, a learning-rate schedule and checkpoints. It continues
# where it was interrupted.

normalizer = Normalizer.fit(demos)
normalized = normalizer.normalize(demos)


def train(prior, iterations=1000):
    torch.manual_seed(0)
    network = VelocityMLP(1, 3, prior.prediction_length, hidden_dim=64)
    network = precondition(network, normalized, prior)
    actor = WarmPriorActor(
        network, prior, nfe=1, clip=1.0, normalizer=normalizer
    )
    config = TrainingConfig(
        iterations=iterations,
        batch_size=256,
        learning_rate=2e-3,
        warmup_ratio=0.05,
        checkpoints=1,
    )
    training = BehaviourCloning(actor, normalized, config, root / prior.name)
    training.run(description=None)  # no progress bar
    return load_policy(training.policy_path())


policies = {
    "Gaussian source": train(GaussianPrior(4)),
    "WP-Past": train(PastPrior(4, sigma=0.5)),
}

# %%
# Evaluating
# ----------
# :func:`~warmprior.evaluation.evaluate` runs the episodes of given seeds, the same ones for every
# policy. It needs one entry that Gymnasium's pendulum lacks: ``"success"``. A small transform adds
# it: whether the pendulum stands when the time is up. It also keeps the observations, for the video below;
# transforms before :func:`~warmprior.policy_transforms` see every
# control step.


class StandsAtTheEnd(Transform):
    """Writes ``"success"``, and keeps the observations."""

    def __init__(self):
        super().__init__()
        self.observations = []

    def _noted(self, tensordict):
        observation = tensordict["observation"]
        self.observations.append(observation.clone())
        return tensordict.set(
            "success", tensordict["truncated"] & (observation[..., :1] > 0.98)
        )

    def _step(self, tensordict, next_tensordict):
        return self._noted(next_tensordict)

    def _reset(self, tensordict, tensordict_reset):
        return self._noted(tensordict_reset)

    def transform_observation_spec(self, observation_spec):
        observation_spec["success"] = Categorical(
            2, shape=(1,), dtype=torch.bool
        )
        return observation_spec


def play(policy, episodes=20):
    """Return how many episodes end upright, and all observations ``[episodes, 201, 3]``."""
    judge = StandsAtTheEnd()
    transforms = Compose(
        judge, policy_transforms(policy.prior, normalizer=normalizer)
    )
    env = TransformedEnv(GymEnv("Pendulum-v1"), transforms)
    judge.observations.clear()
    played = evaluate(policy, env, episodes=episodes, first_seed=1_000)
    observations = torch.stack(judge.observations[-201 * episodes :]).view(
        episodes, 201, 3
    )
    return sum(episode.success for episode in played), observations


def angle(observations):
    return torch.atan2(observations[..., 1], observations[..., 0]).rad2deg()


figure, axes = plt.subplots(1, 3, figsize=(10, 3.0), sharey=True)
shown = {"Demonstrations": (None, demos["observation"].view(40, 200, 3))}
shown |= {name: play(policy) for name, policy in policies.items()}
for axis, (name, (solved, observations)) in zip(
    axes, shown.items(), strict=True
):
    for episode in observations[:20]:
        degrees = angle(episode)
        degrees[1:][degrees.diff().abs() > 180] = (
            torch.nan
        )  # no line where the angle wraps around
        axis.plot(torch.arange(len(degrees)) / 20, degrees, lw=0.8, alpha=0.7)
    share = "" if solved is None else f": {solved} of 20 end upright"
    axis.set(
        title=name + share, xlabel="seconds", yticks=[-180, -90, 0, 90, 180]
    )
axes[0].set_ylabel("angle in degrees (0 is upright)")
plt.show()

# %%
# What to notice: from both sources the policies swing up with growing energy, as the demonstrator
# does. The Gaussian one then holds the pendulum, the other one often goes over the top and needs
# another turn. Here the observation determines the next action, and the past only misleads the
# policy into continuing as before. A warm source helps in the other case, where one observation leaves
# several actions open, as in :doc:`tutorial 1 <plot_1_first_policy>`. (How many of 20 episodes end
# upright differs by several by chance alone: for a comparison take more of them, and several
# training seeds.)
#
# A video
# -------
# One episode of WP-Past, from a start that no demonstration has. (Tasks of robosuite have
# :func:`~warmprior.evaluation.record_filmstrip`, which renders the simulator; for an environment of your
# own, draw its observations.)


class Video:
    """Pictures that pages and notebooks show as a video."""

    def __init__(self, pictures, rate):
        self.pictures, self.rate = pictures, rate

    def _repr_html_(self):
        file, (first, *others) = io.BytesIO(), self.pictures
        duration = round(1000 / self.rate)
        first.save(
            file,
            "WEBP",
            save_all=True,
            append_images=others,
            duration=duration,
            loop=0,
        )
        data = base64.b64encode(file.getvalue()).decode()
        return f'<img alt="video of an episode" src="data:image/webp;base64,{data}">'


def picture(observation, size=200):
    cosine, sine, _ = observation.tolist()
    image = Image.new("RGB", (size, size), "white")
    canvas, middle = ImageDraw.Draw(image), size / 2
    tip = (middle - 0.4 * size * sine, middle - 0.4 * size * cosine)
    canvas.line([(middle, middle), tip], fill="#1f77b4", width=10)
    canvas.ellipse(
        [middle - 5, middle - 5, middle + 5, middle + 5], fill="black"
    )
    return image


_, observations = shown["WP-Past"]
hardest = int(
    angle(observations[:, 0]).abs().argmax()
)  # it starts nearest to hanging down
Video(
    [picture(observation) for observation in observations[hardest, ::2]],
    rate=10,
)

# %%
# The same episode as pictures, one per second:

figure, axes = plt.subplots(1, 10, figsize=(10, 1.3))
for second, axis in enumerate(axes):
    axis.imshow(picture(observations[hardest, 20 * second]))
    axis.set_title(f"{second} s", fontsize=8)
    axis.set(xticks=[], yticks=[])
plt.show()

# %%
# The policies are folders as in :doc:`tutorial 1 <plot_1_first_policy>`; ``load_policy`` above
# has loaded the last checkpoint of averaged weights. From here: :doc:`what one step costs
# <plot_4_one_step>`, and :doc:`images <plot_5_images>`.

folder.cleanup()
