"""
4. What one step costs
======================

Integrating a flow takes one network evaluation per step, and a robot has only so much time per
decision. How few steps are enough? That depends on how straight the flow is, on what the source
knows about the next chunk, and on whether the network has learnt to ignore the source's noise. The
library measures all three. This tutorial does it on the task of :doc:`tutorial 1
<plot_1_first_policy>`.
"""

import matplotlib.pyplot as plt
import torch
from torchrl.envs import TransformedEnv

from warmprior import (
    FlowMatchingLoss,
    GaussianPrior,
    PastPrior,
    PreconditionedNetwork,
    PreviewPrior,
    SourceMoments,
    VelocityMLP,
    WarmPriorActor,
    policy_transforms,
    window_replay_buffer,
)
from warmprior.diagnostics import (
    SharedObservations,
    curvature,
    executed_actions,
    source_leak,
)
from warmprior.envs import (
    NavigationEnv,
    navigation_demonstrations,
    navigation_metrics,
)

torch.manual_seed(0)
demos = navigation_demonstrations()
shared = SharedObservations(demos, chunk_length=4)


def train(prior, iterations=800, look=lambda iteration, actor: None):
    """As in tutorial 1; ``look`` is called after every iteration."""
    torch.manual_seed(0)
    windows = window_replay_buffer(
        demos, prior, batch_size=256, observation_steps=1, withhold=0.1
    )
    network = VelocityMLP(
        1, 9, prior.prediction_length, observation_steps=1, hidden_dim=64
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
    for iteration in range(1, iterations + 1):
        optimizer.zero_grad()
        loss_module(windows.sample())["loss_flow_matching"].backward()
        optimizer.step()
        schedule.step()
        look(iteration, actor)
    return actor


# %%
# Three sources
# -------------
# The Gaussian one, the last four actions (WP-Past), and the policy's own forecast of the next four,
# made one decision earlier (WP-Preview, which predicts eight actions for that).

leaks = {}


def look(iteration, actor):
    """For the last section: how much of the source's noise reaches the actions meanwhile."""
    if iteration in (10, 20, 50, 100, 200, 400, 800):
        windows = shared.windows(actor.prior)
        leaks[iteration] = source_leak(
            actor, windows, nfes=(1, 9), episodes=shared.episodes
        )


actors = {
    "Gaussian source": train(GaussianPrior(4), look=look),
    "WP-Past": train(PastPrior(4, sigma=0.1)),
    "WP-Preview": train(PreviewPrior(4, sigma=0.1)),
}
colors = dict(zip(actors, ("#7f7f7f", "#1f77b4", "#d95f02"), strict=True))

# %%
# Success against steps
# ---------------------
# ``nfe`` is the number of network evaluations per chunk. It is an option of acting, not of
# training: the same three policies are evaluated with more and fewer.


def collision_rate(actor, nfe):
    transforms = policy_transforms(actor.prior, observation_steps=1)
    env = TransformedEnv(NavigationEnv(batch_size=[256]), transforms)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        played = env.rollout(
            1000, actor.replace(nfe=nfe, generator=generator)
        )
    heights = executed_actions(played)[0].squeeze(-1)
    return navigation_metrics(heights, chunk_length=4).collision_rate


nfes = [1, 2, 3, 5, 9]
figure, axis = plt.subplots(figsize=(6, 3.2))
for name, actor in actors.items():
    collisions = [collision_rate(actor, nfe) for nfe in nfes]
    print(f"{name:16}", [round(rate, 2) for rate in collisions])
    axis.plot(nfes, collisions, "o-", color=colors[name], label=name)
axis.set(
    xscale="log",
    xlabel="network evaluations per chunk (NFE)",
    ylabel="episodes that collide",
)
axis.set(ylim=(-0.03, 1.03))
axis.set_xticks(nfes, nfes)
axis.minorticks_off()
axis.legend(loc="center right")
plt.show()

# %%
# What to notice: warm sources need two or three evaluations, and many do not help the Gaussian one:
# it chooses a side again at every decision. More steps draw a better sample of the demonstrations,
# and here such samples contradict each other.
#
# Why one step is different
# -------------------------
# One step returns the *mean* of all actions that observation and source leave open. The Gaussian
# source leaves both sides open, so the mean is the middle. The figure shows the first action
# at the first obstacle, after a past above it.

step = 16
figure, axes = plt.subplots(1, 3, figsize=(10, 2.8), sharey=True)
for axis, (name, actor) in zip(axes, actors.items(), strict=True):
    window = shared.windows(actor.prior)[shared.frames == step]
    window = window.expand(200).contiguous()
    axis.axhspan(-0.45, 0.45, color="0.9")
    for place, nfe in enumerate((1, 2, 9)):
        generator = torch.Generator().manual_seed(0)
        with torch.no_grad():
            acted = actor(window.clone(), nfe=nfe, generator=generator)
        chunk = acted["vla_action", "chunk"]
        spread = 0.6 * (torch.rand(200, generator=generator) - 0.5)
        axis.plot(
            place + spread,
            chunk[:, 0, 0],
            ".",
            ms=3,
            alpha=0.5,
            color=colors[name],
        )
    axis.set_xticks(range(3), ["NFE 1", "NFE 2", "NFE 9"])
    axis.set_title(name)
axes[0].set_ylabel("height (first action)")
plt.show()

# %%
# Grey is the obstacle. At NFE 1 the Gaussian policy aims at it. The warm sources know the side, and
# their mean is an action that was demonstrated. (At the *first* decision of an episode there is no
# past, and they do the same as the Gaussian one: that is why some of their episodes collide at NFE
# 1.)
#
# Straightness
# ------------
# :func:`~warmprior.diagnostics.curvature` integrates how far the velocity strays from its mean
# along each path: 0 is a straight line, which a single Euler step follows exactly. Two numbers
# belong together. ``kappa`` shrinks with the length of the path, so that a source near the data
# looks straight in any case; ``relative`` divides that out. And ``one_step_error`` is what counts
# in the end: how far the end of one step is from the end of the path.

names, kappa, relative, error = [], [], [], []
for name, actor in actors.items():
    measured = curvature(actor, shared.deployed(actor), n_steps=50, draws=4)
    names.append(name)
    kappa.append(measured["kappa_executed"].nanmean())
    relative.append(measured["relative_executed"].nanmean())
    error.append(measured["one_step_error_executed"].square().mean().sqrt())

figure, axes = plt.subplots(1, 3, figsize=(9, 2.8))
for axis, values, title in (
    (axes[0], kappa, "curvature $\\kappa$"),
    (axes[1], relative, "curvature / squared speed"),
    (axes[2], error, "error of one step"),
):
    axis.bar(names, values, color=list(colors.values()))
    for place, value in enumerate(values):
        axis.text(place, value, f"{value:.3f}", ha="center", va="bottom")
    axis.set(title=title)
    axis.margins(y=0.15)
    axis.tick_params(axis="x", labelsize=8)
plt.show()

# %%
# What to notice: by ``kappa`` both warm sources are straight. By the ratio WP-Preview is not: its
# path is so short that bends count for a lot in this ratio, and for little in the action. Read the two
# together, and trust the error. (``shared.met`` makes the history that a *running* policy meets, with
# its own previous prediction; ``shared.windows`` the one of the training.)
#
# Does the network leak?
# ----------------------
# All this holds for a network that has learnt its task. One that has not yet learnt to ignore the
# noise at time 0 passes it on to the actions, most of all in one step. A comparison of sources at
# NFE 1 then only shows which one has less noise. :func:`~warmprior.diagnostics.source_leak`
# measures it: if the steps between the actions of a chunk are longer than the data's, there is
# noise in them.
# Here it is for the Gaussian policy while it was trained.

figure, axis = plt.subplots(figsize=(6, 3.2))
for nfe, style in ((1, "o-"), (9, "s--")):
    ratios = [leak[nfe].inner_step_ratio for leak in leaks.values()]
    axis.plot(list(leaks), ratios, style, label=f"NFE {nfe}")
axis.axhline(1.3, color="0.5", lw=0.8, ls=":")
axis.text(10, 1.34, "bound of the warning", va="bottom", color="0.4")
axis.set(xscale="log", yscale="log", xlabel="training iterations")
axis.set_ylabel("step inside chunks / the data's")
axis.set_xticks(list(leaks), list(leaks))
axis.set_yticks([1, 2, 5, 10], [1, 2, 5, 10])
axis.minorticks_off()
axis.legend()
plt.show()

for iteration in (10, 800):
    for nfe, leak in leaks[iteration].items():
        print(f"after {iteration} iterations, NFE {nfe}:", leak.warning)

# %%
# What to notice: in one step ten times as much noise at first, and after 400 iterations none. (The
# last line is about the other measure, how far predictions spread: 5 percent more than the data do,
# at the two sides of the obstacle.)
#
# Every benchmark writes these measures below its success rates. On robot tasks a leak once looked
# like a gain of 40 points for a warm source at NFE 1 (:doc:`lab notes </notes/evidence>`).
