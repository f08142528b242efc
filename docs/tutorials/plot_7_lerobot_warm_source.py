"""
7. A LeRobot policy with a warm source
======================================

LeRobot's flow policies start every chunk from Gaussian noise. Here one of them gets a warm source:
the policy stays LeRobot's own class with its own weights, loss and sampler, and only the noise that
these would draw is replaced. It is first trained as in LeRobot, then evaluated and fine-tuned from
WP-Past. The policy is tiny, and the task is that of :doc:`tutorial 1 <plot_1_first_policy>`, so that it
runs here; the commands for large policies are at the end.
"""

import copy
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.datasets import LeRobotDataset
from lerobot.policies.multi_task_dit.configuration_multi_task_dit import (
    MultiTaskDiTConfig,
)
from lerobot.policies.multi_task_dit.modeling_multi_task_dit import (
    MultiTaskDiTPolicy,
)
from torch.utils.data import default_collate
from torchrl.envs import TransformedEnv
from transformers import CLIPTextConfig, CLIPTextModel

from warmprior import GaussianPrior, PastPrior, policy_transforms
from warmprior.diagnostics import executed_actions
from warmprior.envs import (
    NavigationEnv,
    navigation_demonstrations,
    navigation_metrics,
    navigation_positions,
)
from warmprior.lerobot import LeRobotActor, WarmPriorAdapter, history_indices

torch.manual_seed(0)
folder = tempfile.TemporaryDirectory()
root = Path(folder.name)

# %%
# The data
# --------
# Six demonstrations as a LeRobotDataset, recorded with LeRobot's own recorder as in :doc:`tutorial 3
# <plot_3_own_demonstrations>`.

features = {
    "observation.state": {"dtype": "float32", "shape": (9,), "names": None},
    "action": {"dtype": "float32", "shape": (1,), "names": ["height"]},
}
recorder = LeRobotDataset.create(
    "me/navigation", fps=10, features=features, root=root / "navigation"
)
demos = navigation_demonstrations()
for episode in range(6):
    for frame in demos[demos["episode"] == episode]:
        recorder.add_frame(
            {
                "observation.state": frame["observation"].numpy(),
                "action": frame["action"].numpy(),
                "task": "pass the obstacles",
            }
        )
    recorder.save_episode()
recorder.finalize()

# %%
# A warm source needs actions that LeRobot does not load by default: the ``H`` *before* each chunk.
# :func:`~warmprior.lerobot.history_indices` gives the steps to load, here ``H`` = 4 in front of a
# chunk of four.

H = 4
window_steps = history_indices(H, H)
print("steps of each training window:", window_steps)
dataset = LeRobotDataset(
    "me/navigation",
    root=root / "navigation",
    delta_timestamps={
        "observation.state": [0.0],
        "action": [step / 10 for step in window_steps],
    },
)

# All windows at once; a real dataset is read by a DataLoader.
windows = default_collate([dataset[i] for i in range(len(dataset))])
windows["action"] = windows["action"].unsqueeze(-1)
windows = {
    key: windows[key]
    for key in ("observation.state", "action", "action_is_pad")
}
print({key: tuple(value.shape) for key, value in windows.items()})

# %%
# (LeRobot gives an action of a single number without its dimension, hence the ``unsqueeze``.)
# ``action_is_pad`` matters: before an episode LeRobot repeats its first action, which would leak
# the target. The adapter uses the mask, and refuses batches without it.
#
# The policy
# ----------
# ``multi_task_dit`` is LeRobot's diffusion transformer, here with flow matching. It encodes its
# instruction with CLIP's text encoder from the hub; ours is tiny, with random weights, and the
# instruction is always the same two tokens. Heights lie in [-1, 1] already, so the processors that
# tokenise and normalise are left out.

CLIPTextModel(
    CLIPTextConfig(
        hidden_size=16,
        intermediate_size=16,
        num_hidden_layers=1,
        num_attention_heads=1,
        vocab_size=8,
        max_position_embeddings=8,
    )
).save_pretrained(root / "tiny-clip")


def instruct(batch):
    tokens = torch.ones(len(batch["observation.state"]), 2, dtype=torch.long)
    return batch | {
        "observation.language.tokens": tokens,
        "observation.language.attention_mask": torch.ones_like(tokens).bool(),
    }


config = MultiTaskDiTConfig(
    input_features={
        "observation.state": PolicyFeature(FeatureType.STATE, (9,))
    },
    output_features={"action": PolicyFeature(FeatureType.ACTION, (1,))},
    device="cpu",
    objective="flow_matching",
    num_integration_steps=9,
    n_obs_steps=1,
    horizon=H,
    n_action_steps=H,
    hidden_dim=48,
    num_layers=2,
    num_heads=2,
    timestep_embed_dim=32,
    dropout=0.0,
    text_encoder_name=str(root / "tiny-clip"),
)
policy = MultiTaskDiTPolicy(config)


def train(policy, loss_of, iterations, learning_rate):
    torch.manual_seed(0)
    policy.train()
    trained = [p for p in policy.parameters() if p.requires_grad]
    optimizer = torch.optim.AdamW(trained, lr=learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(
        optimizer, iterations
    )
    for _ in range(iterations):
        chosen = torch.randint(len(dataset), (128,))
        batch = {key: value[chosen] for key, value in windows.items()}
        loss, _ = loss_of(instruct(batch))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    policy.eval()


# %%
# LeRobot alone, first. Its ``forward`` takes the chunk without the history and draws Gaussian
# noise. Call what comes out a checkpoint from the hub.


def lerobots_own_loss(batch):
    chunk = batch["action"][:, -H:], batch["action_is_pad"][:, -H:]
    batch["action"], batch["action_is_pad"] = chunk
    return policy.forward(batch)


train(policy, lerobots_own_loss, iterations=400, learning_rate=3e-3)

# %%
# The warm source
# ---------------
# :class:`~warmprior.lerobot.WarmPriorAdapter` wraps a policy. ``adapter.loss(batch)`` is the
# policy's own loss, ``adapter.select_action`` its own sampler; both get the prior's sample where
# they would draw noise, exactly once, or raise an error. The fine-tuning loop does not change.

past = PastPrior(H, sigma=0.3)
tuned = copy.deepcopy(policy)
adapter = WarmPriorAdapter(tuned, past, cold_probability=0.2)
train(tuned, adapter.loss, iterations=400, learning_rate=2e-3)

before, after = policy.state_dict(), tuned.state_dict()
print(
    type(tuned).__name__,
    "with the same tensors:",
    list(before) == list(after),
)
print(sum(value.numel() for value in after.values()), "numbers in both")

# %%
# (``cold_probability`` hides the past from some windows, so that the policy does not forget what to
# do at the first decision of an episode.)
#
# What has changed is where the flow starts. ``adapter.source`` makes the samples of training windows;
# here are forty of each for the window at one step of a demonstration that passes above.

figure, axes = plt.subplots(1, 2, figsize=(9, 2.8), sharey=True)
x = navigation_positions()
adapters = {
    "Gaussian source": WarmPriorAdapter(policy, GaussianPrior(H)),
    "WP-Past": adapter,
}
colors = ("#7f7f7f", "#1f77b4")
for axis, (name, one), color in zip(
    axes, adapters.items(), colors, strict=True
):
    history, chunk = windows["action"][:, :H], windows["action"][:, -H:]
    valid = ~windows["action_is_pad"][:, :H]
    share = one.cold_probability
    samples = one.source.draw_for_training(
        history, valid, chunk, cold_probability=share
    )
    warm = valid.all(1)
    error = (samples - chunk)[warm].square().mean().sqrt()
    step = 24
    forty = torch.full((40,), step)
    samples = one.source.draw_for_training(
        history[forty], valid[forty], chunk[forty], cold_probability=share
    )
    axis.plot(
        x[step : step + H],
        samples.squeeze(-1).T,
        color=color,
        lw=0.7,
        alpha=0.6,
    )
    axis.plot(
        x[step - H : step], history[step], "k.:", label="executed before"
    )
    axis.plot(
        x[step : step + H], chunk[step], "k.-", label="demonstrated chunk"
    )
    axis.set(title=f"{name}: {error:.2f} from the chunk", xlabel="position")
axes[0].set_ylabel("height (action)")
axes[1].legend(loc="lower left")
plt.show()

# %%
# What to notice: the Gaussian samples do not depend on where the robot is. Around the past most of
# them lie on its side already (except those whose past was hidden), so the paths of the flow are
# shorter.
#
# Acting
# ------
# On a robot that is LeRobot's own loop around ``adapter.select_action``, which returns one action
# after another and predicts a new chunk whenever the last one is used up:


def one_robot(adapter):
    torch.manual_seed(2)
    adapter.reset()  # a new episode
    heights, env = [], NavigationEnv()
    data = env.reset()
    for _ in range(64):
        state = data["observation"].unsqueeze(0)
        action = adapter.select_action(instruct({"observation.state": state}))
        heights.append(action.item())
        _, data = env.step_and_maybe_reset(data.set("action", action[0]))
    return heights


# %%
# In TorchRL's environments :class:`~warmprior.lerobot.LeRobotActor` is the same policy with the keys
# of :class:`~warmprior.WarmPriorActor`. The figure has 64 of its episodes in colour, and that robot
# in black.


def many_robots(policy, prior, nfe):
    actor = LeRobotActor(policy, prior, preprocess=instruct, nfe=nfe)
    transforms = policy_transforms(prior, observation_steps=1)
    env = TransformedEnv(NavigationEnv(batch_size=[64]), transforms)
    torch.manual_seed(1)
    with torch.no_grad():
        return executed_actions(env.rollout(64, actor))[0].squeeze(-1)


players = {
    "LeRobot's policy": (policy, GaussianPrior(H)),
    "the same weights, WP-Past": (policy, past),
    "fine-tuned from WP-Past": (tuned, past),
}
figure, axes = plt.subplots(2, 3, figsize=(10, 5.4), sharex=True, sharey=True)
for row, nfe in zip(axes, (9, 1), strict=True):
    for axis, (name, (played, prior)) in zip(
        row, players.items(), strict=True
    ):
        color = colors[prior is past]
        heights = many_robots(played, prior, nfe)
        alone = one_robot(WarmPriorAdapter(played, prior, nfe=nfe))
        metrics = navigation_metrics(heights, H)
        for centre in (-0.45, 0.45):
            axis.fill_between(
                [centre - 0.12, centre + 0.12], -0.45, 0.45, color="0.8"
            )
        axis.plot(x, heights.T, color=color, lw=0.5, alpha=0.5)
        axis.plot(x, alone, color="black", lw=1.2)
        axis.plot(x[::H], alone[::H], "o", color="black", ms=3)
        axis.set(ylim=(-1.2, 1.2))
        axis.set_title(
            f"{name}, NFE {nfe}:\n{metrics.collision_rate:.0%} collide, "
            f"{metrics.distance:.2f} from the data"
        )
    row[0].set_ylabel("height (executed action)")
for axis in axes[1]:
    axis.set_xlabel("position")
plt.show()
folder.cleanup()

# %%
# What to notice, from left to right: LeRobot's policy draws a new side to pass on at every
# decision. With the same weights and a warm source it stays on its side, before any fine-tuning:
# this flow happens to carry what starts above to actions above. Do not count on it; for these
# weights the source is one that they have never seen, and a toy with one action dimension is kind.
# Fine-tuning adds nothing to that at nine evaluations; a few episodes more collide. It shows below,
# at a single evaluation, where a policy returns the mean of what its source
# leaves open: the unchanged weights run through the middle whatever the source, and the
# fine-tuned ones have begun to leave it. Most episodes still collide, because they begin there, at a
# first decision without a past, and 400 iterations are few.
#
# Large policies
# --------------
# The plugin brings the same to LeRobot's command line, as policy types into which the hub's
# checkpoints load unchanged:
#
# .. code-block:: console
#
#    pip install -e '.[lerobot,vla]' -e plugins/lerobot_policy_warmprior
#    lerobot-train --policy.type=warm_smolvla --policy.pretrained_path=lerobot/smolvla_base \
#        --policy.prior=past --policy.n_action_steps=25 \
#        --dataset.repo_id=USER/DATASET --batch_size=64 --steps=20000
#    lerobot-train --policy.type=warm_pi05 --policy.pretrained_path=lerobot/pi05_base \
#        --policy.prior=preview --policy.n_action_steps=25 \
#        --dataset.repo_id=USER/DATASET --batch_size=32 --steps=3000
#
# GR00T N1.7 is ``--policy.type=warm_groot``. pi0, X-VLA and GR00T N1.5 have no types there, and are
# trained in Python as above, by ``WarmPriorAdapter(policy, PastPrior(16)).loss(batch)`` (:doc:`/lerobot`).
#
# What was run: this page; the losses and samplers of all these families, LeRobot's own classes with
# small random weights, against flow matching written by hand; and the library's own policy through
# ``lerobot-train`` and ``lerobot-eval``. What was not: pretrained weights of any of them, and real
# robots. Nothing here shows how much a fine-tuned VLA gains from a warm source.
