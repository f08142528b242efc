"""
1. A first policy, and its flow drawn
=====================================

A flow-matching policy turns a random sample into a chunk of actions. Usually that sample is plain
Gaussian noise, drawn again at every decision. This tutorial trains two policies that differ only in
that sample's distribution, the *source*: one uses :class:`~warmprior.GaussianPrior`, the other
:class:`~warmprior.PastPrior`, which draws around what the agent has just done. The task is small
enough to see everything that happens.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from torchrl.envs import TransformedEnv

from warmprior import (
    FlowMatchingLoss,
    GaussianPrior,
    PastPrior,
    PreconditionedNetwork,
    SourceMoments,
    VelocityMLP,
    WarmPriorActor,
    policy_transforms,
    window_replay_buffer,
)
from warmprior.diagnostics import (
    SharedObservations,
    executed_actions,
    flow_paths,
)
from warmprior.envs import (
    NavigationEnv,
    navigation_demonstrations,
    navigation_heights,
    navigation_metrics,
    navigation_positions,
)
from warmprior.saving import load_policy, save_policy

torch.manual_seed(0)

# %%
# The task
# --------
# An agent moves from left to right, one position per control step, 64 steps per episode. Its action
# is its height. Two obstacles stand in the way. Of six demonstrations, three pass above both and
# three below both. So at *every* position there are two good actions, and which one is right depends on
# what the agent did before.


def draw_task(axis):
    """Obstacles, and the demonstrations as dotted lines."""
    x = navigation_positions()
    for centre in (-0.45, 0.45):
        axis.fill_between(
            [centre - 0.12, centre + 0.12], -0.45, 0.45, color="0.8"
        )
    axis.plot(x, navigation_heights().T, color="0.5", lw=0.8, ls=":")
    axis.set(
        xlabel="position (observation)", xlim=(-1, 1), ylim=(-1.15, 1.15)
    )


demos = navigation_demonstrations()
print(demos)

figure, axis = plt.subplots(figsize=(5, 2.6))
draw_task(axis)
axis.plot(
    navigation_positions(), navigation_heights()[:3].T, color="tab:blue"
)
axis.plot(
    navigation_positions(), navigation_heights()[3:].T, color="tab:orange"
)
axis.set(
    ylabel="height (action)", title="Six demonstrations around two obstacles"
)
plt.show()

# %%
# ``demos`` is a plain TensorDict of contiguous steps: the observation (the position with its sines
# and cosines), the action, and the number of the episode. That is all that any dataset needs.
#
# Training
# --------
# The *prior* is the object that describes the source:
#
# * :func:`~warmprior.window_replay_buffer` is a TorchRL replay buffer of training windows:
#   observation, target chunk, and the *history*, what the agent did before.
# * :class:`~warmprior.PreconditionedNetwork` scales the network's inputs and outputs by what is
#   known of source and data.
# * :class:`~warmprior.WarmPriorActor` draws from the source, which the prior derives from the
#   history, and integrates the network's velocity to a chunk; ``nfe`` is the number of network
#   evaluations.
# * :class:`~warmprior.FlowMatchingLoss` is a TorchRL loss module.
#
# The prior is the only difference between the two policies.


def train(prior, iterations=1000):
    """Behaviour cloning by flow matching."""
    torch.manual_seed(0)
    windows = window_replay_buffer(
        demos, prior, batch_size=256, observation_steps=1, withhold=0.1
    )
    network = VelocityMLP(
        action_dim=1,
        observation_dim=demos["observation"].shape[-1],
        prediction_length=prior.prediction_length,
        observation_steps=1,
        hidden_dim=64,
    )
    network = PreconditionedNetwork(
        network, moments=SourceMoments.fit(windows, prior)
    )
    actor = WarmPriorActor(network, prior, nfe=9)
    loss_module = FlowMatchingLoss(actor)
    optimizer = torch.optim.AdamW(network.parameters(), lr=4e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(
        optimizer, iterations
    )
    for _ in range(iterations):
        optimizer.zero_grad()
        loss_module(windows.sample())["loss_flow_matching"].backward()
        optimizer.step()
        schedule.step()
    return actor


actors = {
    "Gaussian source": train(GaussianPrior(chunk_length=4)),
    "WP-Past": train(PastPrior(chunk_length=4, sigma=0.1)),
}

# %%
# ``chunk_length=4``: the policy predicts four actions, executes them, and decides again. ``sigma``
# is how far the source spreads around the last four actions, in units of the normalised action. At
# the first decision of an episode there is no past, and the source is the Gaussian one;
# ``withhold=0.1`` hides the past from a tenth of the training windows, so that the network knows this
# case well.
#
# Acting
# ------
# :func:`~warmprior.policy_transforms` turn any TorchRL environment into one that executes chunks
# and remembers the history. The actor keeps no state, so ``rollout``, collectors and parallel
# environments work as usual.

figure, axes = plt.subplots(1, 2, figsize=(9, 3.1), sharey=True)
for axis, (name, actor) in zip(axes, actors.items(), strict=True):
    transforms = policy_transforms(actor.prior, observation_steps=1)
    env = TransformedEnv(NavigationEnv(batch_size=[256]), transforms)
    torch.manual_seed(1)
    with torch.no_grad():
        rollout = env.rollout(max_steps=64, policy=actor)
    heights = executed_actions(rollout)[0].squeeze(-1)
    metrics = navigation_metrics(heights, chunk_length=4)
    draw_task(axis)
    axis.plot(
        navigation_positions(),
        heights[1:25].T,
        color="tab:blue",
        lw=0.6,
        alpha=0.5,
    )
    axis.plot(navigation_positions(), heights[0], color="black", lw=1.4)
    axis.plot(
        navigation_positions()[::4], heights[0, ::4], "o", color="black", ms=3
    )
    axis.set_title(
        f"{name}: changes sides at {metrics.switch_rate:.0%} of decisions,\n"
        f"{metrics.collision_rate:.0%} of 256 episodes collide"
    )
axes[0].set_ylabel("height (executed action)")
plt.show()

# %%
# One episode of each is drawn in black, with a dot at every decision. What to notice: nearly every
# *chunk* of the Gaussian policy is good, and follows a demonstration. But every decision draws new
# noise, and with it a new side. With the past in its source, the second decision starts where
# the first one led, and the agent stays on its side. The network has never seen a history as input:
# only the starting point of its flow has changed.
#
# The flow
# --------
# :func:`~warmprior.diagnostics.flow_paths` returns the paths from source to chunk. Here they are at
# one observation, just before the first obstacle, in an episode that has been above the obstacles
# so far. :class:`~warmprior.diagnostics.SharedObservations` cuts the same windows for every prior.
# Time runs from 0, the source, to 1, the chunk; only the first action of the chunk is drawn.

shared = SharedObservations(demos, chunk_length=4)
step = 12
figure, axes = plt.subplots(1, 2, figsize=(9, 3.1), sharey=True)
for axis, (name, actor) in zip(axes, actors.items(), strict=True):
    window = shared.windows(actor.prior)[shared.frames == step]
    generator = torch.Generator().manual_seed(0)
    paths = flow_paths(
        actor, window.expand(60).contiguous(), n_steps=50, generator=generator
    )
    # [source samples, times, position in the chunk, action dimension]
    height = paths[:, :, 0, 0]
    for line in height:
        axis.plot(
            torch.linspace(0, 1, 51),
            line,
            color="tab:blue" if line[-1] > 0 else "tab:orange",
            lw=0.7,
            alpha=0.6,
        )
    axis.set(title=name, xlabel="time of the flow", xlim=(-0.02, 1.08))
    for demonstrated in navigation_heights()[:, step]:
        axis.plot([1.02, 1.07], [demonstrated, demonstrated], color="black")
axes[0].set_ylabel("height (first action)")
axes[1].text(1.02, 0.0, "demonstrated\nactions", ha="right", va="center")
plt.show()

# %%
# What to notice: the Gaussian source reaches both sides, half of its samples each, and its paths
# bend, because at first they all head for the middle. The warm source lies on one side already, and
# its paths are short and nearly straight. That is why it needs fewer integration steps, as long as
# the past is informative: :doc:`tutorial 4 <plot_4_one_step>` measures both.
#
# Keeping a policy
# ----------------
# A saved policy is a folder with a readable configuration and a file of weights. It includes its
# prior, and returns the same chunks bit for bit.

with tempfile.TemporaryDirectory() as folder:
    save_policy(actors["WP-Past"], folder)
    loaded = load_policy(folder)
    print(sorted(path.name for path in Path(folder).iterdir()))
print(loaded.prior)

# %%
# ``python benchmarks/navigation1d.py`` compares more sources on this task (:doc:`lab notes
# </notes/evidence>`). Next: :doc:`a prior of your own <plot_2_own_prior>`.
