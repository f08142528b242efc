import json

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from tests.data.lerobot_parts import WIDTHS, edit_table, numbers, pq, write_lerobot
from tests.errors import missing, raises, refuses
from tests.lerobot.plugin_policies import (
    NEEDS_PLUGIN,
    dataset_policy,
    flow_batch,
    flow_policy,
    one_observation,
)
from tests.toy_env import Halfway, stirred
from warmprior import (
    HistoryObservation,
    Normalizer,
    PastPrior,
    RealTimeChunking,
    VelocityMLP,
    keys,
)
from warmprior.data.formats.lerobot import LeRobotDemonstrations
from warmprior.deploy import AsyncExecutor
from warmprior.history import cold_history
from warmprior.modules.recording import Recording
from warmprior.modules.resize import resized
from warmprior.training import precondition

pytestmark = NEEDS_PLUGIN

STATE, OBJECT = 9, 10  # of lift


def moments_for(policy, steps):
    """Return the moments that this library fits to steps of the policy's widths."""
    network = policy.actor.network
    sizes = network.action_dim, network.observation_dim, network.prediction_length, network.observation_steps
    return precondition(VelocityMLP(*sizes), steps, policy.actor.prior).moments.state_dict()


def test_an_observation_that_is_not_there_is_named(found):
    seen = one_observation()
    del seen["observation.state"]
    for act in (flow_policy(found).select_action, flow_policy(found).predict_action_chunk):
        with raises(KeyError, "observation.state", "missing", "config.json", "input_features"):
            act(seen)


def camera(value):
    return {"observation.images.top": value}


@pytest.mark.parametrize(
    ("damage", "facts"),
    [
        ({"observation.state": torch.tensor([[0.0, 1.0, torch.nan]] * 2)}, ["NaN"]),
        ({"observation.environment_state": torch.tensor([[torch.inf, 0.0]] * 2)}, ["infinity"]),
        (camera(torch.full((2, 3, 16, 16), 255.0)), [255, "[0, 1]"]),
        (camera(torch.full((2, 3, 16, 16), -1.0)), [-1, "[0, 1]"]),
        (camera(torch.full((2, 3, 16, 16), torch.nan)), ["NaN", "[0, 1]"]),
        (camera(torch.full((2, 3, 16, 16), 9, dtype=torch.uint16)), ["uint16", "[0, 1]"]),
        (camera(torch.full((2, 3, 16, 16), 9, dtype=torch.uint8)), ["uint8", "[0, 1]"]),
    ],
)
def test_a_damaged_observation_is_refused_and_forgotten(found, damage, facts):
    seen = one_observation() | camera(torch.rand(2, 3, 16, 16))
    for name in ("select_action", "predict_action_chunk"):
        actions = []
        for damaged in (False, True):
            policy = flow_policy(found, images=(3, 16, 16))
            if damaged:
                with raises(ValueError, *damage, *facts):
                    getattr(policy, name)(seen | damage)
            torch.manual_seed(0)
            actions.append(getattr(policy, name)(seen))
        assert torch.equal(*actions)


def test_the_average_follows_the_weights(found):
    policy = flow_policy(found)
    before = [weight.clone() for weight in policy.actor.network.parameters()]
    policy.update()  # the first one copies
    with torch.no_grad():
        for weight in policy.actor.network.parameters():
            weight.add_(1.0)
    policy.update()
    for old, new in zip(before, policy.averaged.module.parameters(), strict=True):
        torch.testing.assert_close(new, old + 0.005)


def moments_by_hand(policy, dataset, episodes):
    """Return the moments of some episodes, normalised by all, as LeRobot's processors do: -1 if constant."""
    steps = LeRobotDemonstrations(dataset.root).steps(observations=policy.config.observed)
    steps = steps[torch.isin(steps["episode"], torch.tensor(episodes))].clone()
    low, high = (torch.as_tensor(dataset.meta.stats["action"][end]).float() for end in ("min", "max"))
    steps["action"] = 2 * (steps["action"] - low) / (high - low).clamp_min(1e-8) - 1
    return moments_for(policy, steps)


def test_it_is_preconditioned_for_the_episodes_of_the_training(found, tmp_path):
    from lerobot.datasets import LeRobotDatasetMetadata

    root = tmp_path / "data"
    write_lerobot(root, (12, 12, 12), resting=["action"], data_files_size_in_mb=0.001)
    for episodes, streamed in (([0, 2], False), ([0, 2], True), (None, False)):
        policy, dataset = dataset_policy(found, root, episodes, streamed=streamed)
        expected = moments_by_hand(policy, dataset, episodes or [0, 1, 2])
        torch.testing.assert_close(policy.actor.network.moments.state_dict(), expected)
    alone = found["warm_flow"](policy.config, dataset_meta=LeRobotDatasetMetadata("local/tiny", root=root))
    torch.testing.assert_close(alone.actor.network.moments.state_dict(), expected)
    (root / "data/chunk-000/file-001.parquet").unlink()
    dataset_policy(found, root, [0, 2])
    (root / "data").rename(tmp_path / "on the hub")
    with raises(ValueError, str(root), "--dataset.streaming=false", "--policy.precondition=false"):
        found["warm_flow"](policy.config, dataset_meta=dataset.meta)


def test_a_training_that_goes_on_has_the_moments_of_its_own_data(found, tmp_path):
    for name, seed in (("one", 0), ("two", 1)):
        write_lerobot(tmp_path / name, (12, 12, 12), seed=seed)
    first, _ = dataset_policy(found, tmp_path / "one")
    first.update()
    first.save_pretrained(tmp_path / "policy")
    again, dataset = dataset_policy(found, tmp_path / "two", place=tmp_path / "policy")
    expected = moments_by_hand(again, dataset, [0, 1, 2])
    old = first.actor.network.moments.state_dict()
    for network in (again.actor.network, again.averaged.module):
        torch.testing.assert_close(network.moments.state_dict(), expected)
    assert not torch.equal(expected["target_mean"], old["target_mean"])
    weights = dict(first.actor.network.network.named_parameters())
    assert all(torch.equal(v, weights[n]) for n, v in again.actor.network.network.named_parameters())
    # Without a training it has its own; another source is for trainings alone.
    saved = found["warm_flow"].from_pretrained(tmp_path / "policy")
    assert torch.equal(saved.actor.network.moments.target_mean, old["target_mean"])
    dataset_policy(found, tmp_path / "two", place=tmp_path / "policy", prior="past,sigma=0.1")


def test_a_dataset_without_statistics_is_refused(found, tmp_path):
    write_lerobot(tmp_path / "data", (12, 12))
    (tmp_path / "data/meta/stats.json").unlink()
    with raises(ValueError, "meta/stats.json", "action: min, action: max"):
        dataset_policy(found, tmp_path / "data", precondition=False)


def test_nan_of_an_episode_that_is_left_out_is_in_the_statistics(found, tmp_path):
    root = tmp_path / "data"
    write_lerobot(root, (12, 12))
    stats = json.loads((root / "meta/stats.json").read_text())
    stats["action"]["max"][0] = float("nan")  # as LeRobot writes it
    (root / "meta/stats.json").write_text(json.dumps(stats))
    ways = "delete_episodes", "recompute_stats", "input_features"
    with raises(ValueError, "meta/stats.json", "action: max", *ways):
        dataset_policy(found, root, [0])


def test_a_training_says_what_it_uses_of_the_dataset(found, tmp_path, caplog):
    """Cameras with the options of their size; what is left out, and of which episodes."""
    images = [("front", "image"), ("side", "image")]
    write_lerobot(tmp_path / "data", (5, 6, 7), images=images)
    caplog.set_level("INFO")
    sizes = {"encoder": "small", "image_size": 24, "crop_size": 16}
    policy, dataset = dataset_policy(found, tmp_path / "data", [0, 2], resize="pad", **sizes)
    height, width = dataset.meta.features["observation.images.front"]["shape"][:2]
    shown = f"observation.images.front, {height} x {width}, seen at 24 x 24 (pad)"
    assert not missing(
        caplog.messages[-1], shown, "2 demonstrations, 12 steps", "nothing", "20 control steps"
    )
    seen = policy.config.input_features
    seen = {name: entry for name, entry in seen.items() if name != "observation.images.side"}
    dataset_policy(found, tmp_path / "data", input_features=seen, **sizes)
    assert "left out      observation.images.side (--policy.input_features)" in caplog.messages[-1]
    assert "(squeeze)" in caplog.messages[-1] and "3 demonstrations, 18 steps" in caplog.messages[-1]
    episodes = tmp_path / "data" / "meta/episodes/chunk-000/file-000.parquet"
    edit_table(episodes, tasks=lambda tasks: [["lift"], ["push"], ["lift"]])
    for chosen, unseen in ((None, "task, one of 2 (no option takes it)"), ([0, 2], "nothing")):
        dataset_policy(found, tmp_path / "data", chosen, **sizes)
        assert f"left out      {unseen}" in caplog.messages[-1]
    rows = pq.read_table(episodes)
    pq.write_table(rows.drop_columns(["tasks"]), episodes)  # LeRobot trains without them
    dataset_policy(found, tmp_path / "data", **sizes)
    assert "left out      nothing" in caplog.messages[-1]
    pq.write_table(rows, episodes)
    blind = {name: entry for name, entry in seen.items() if "images" not in name}
    dataset_policy(found, tmp_path / "data", input_features=blind)
    for options in ({"image_size": 24}, {"resize": "pad"}, {"crop_size": 8}, {"encoder": "small"}):
        with raises(ValueError, f"--policy.{next(iter(options))} would change nothing"):
            dataset_policy(found, tmp_path / "data", input_features=blind, **options)
    with raises(ValueError, "--policy.resize", "squeeze", "pad", "crop"):
        dataset_policy(found, tmp_path / "data", resize="crop")


def test_the_executor_takes_the_names_and_the_rate_of_the_dataset(found, tmp_path):
    from lerobot_policy_warmprior.processor_warm_flow import make_warm_flow_pre_post_processors
    from lerobot_policy_warmprior.robot import load_actor

    root, place = tmp_path / "data", tmp_path / "policy"
    write_lerobot(root, (12, 12), images=[("front", "image"), ("side", "image")], fps=30)
    sizes = {"encoder": "small", "image_size": 24, "crop_size": 16}
    policy, dataset = dataset_policy(found, root, n_action_steps=4, **sizes)
    stirred(policy.actor.network)
    policy.save_pretrained(place)
    for pipeline in make_warm_flow_pre_post_processors(policy.config, dataset.meta.stats):
        pipeline.save_pretrained(place)
    actor, rng = load_actor(place), np.random.default_rng(0)
    theirs = {name: rng.normal(size=width) for name, width in WIDTHS.items() if name != "action"}
    ours = {"state": np.concatenate([*theirs.values()])}
    for camera in ("front", "side"):
        ours[camera] = rng.integers(0, 256, (48, 64, 3), np.uint8)
        theirs[f"observation.images.{camera}"] = ours[camera]
    actions = []
    for observation in (ours, theirs):
        torch.manual_seed(0)
        with AsyncExecutor(actor, latency=0, control_rate=29.97) as executor:
            with pytest.warns(UserWarning) as said:  # the demonstrations have squares
                actions.append(executor.act(observation))
            front, side = (str(warning.message) for warning in said)
        for camera, text in {"front": front, "side": side}.items():
            assert not missing(text, f"observation.images.{camera}", "48 x 64")
    assert torch.equal(*actions) and actions[0].std() > 0
    refuses(lambda: AsyncExecutor(actor, control_rate=50), ValueError, "control_rate=50", 30)
    config = json.loads((place / "config.json").read_text()) | {"recording": '{"rate": -1}'}
    (place / "config.json").write_text(json.dumps(config))
    refuses(lambda: load_actor(place), ValueError, place, "cannot be built")


def test_features_of_width_1(found, tmp_path):
    """As LeRobotDataset and its loader give them, without that dimension."""
    from lerobot.datasets import LeRobotDataset
    from torch.utils.data import default_collate

    write_lerobot(tmp_path / "data", (12, 12), {name: numbers(1) for name in ("observation.state", "action")})
    policy, _ = dataset_policy(found, tmp_path / "data", n_action_steps=4)
    config = policy.config
    deltas = {"action": config.action_delta_indices, "observation.state": config.observation_delta_indices}
    times = {name: [i / 20 for i in steps] for name, steps in deltas.items()}
    dataset = LeRobotDataset("local/tiny", root=tmp_path / "data", delta_timestamps=times)
    batch = default_collate([dataset[i] for i in range(6)])
    assert batch["action"].ndim == 2
    loss, _ = policy.forward(batch)
    loss.backward()
    assert policy.eval().select_action({"observation.state": torch.zeros(3, 1)}).shape == (3, 1)


def test_losses_of_samples(found):
    policy = flow_policy(found).eval()
    batch = flow_batch(8)
    batch["action_is_pad"][1, 5:] = True
    torch.manual_seed(5)
    mean, _ = policy.forward(batch)
    torch.manual_seed(5)
    losses, said = policy.forward(batch, reduction="none")
    count = torch.tensor([4.0, 1.0, 4.0])
    assert losses.shape == (3,) and losses.grad_fn is not None
    torch.testing.assert_close((losses * count).sum() / count.sum(), mean)
    assert said["flow_matching"] == pytest.approx(losses.mean().item())
    assert policy.forward(batch)[0].ndim == 0
    refuses(lambda: policy.forward(batch, reduction="sum"), ValueError, "reduction", "mean, none")


@pytest.mark.parametrize("prior", ["past,sigma=0.0", "preview,sigma=0.0"])
def test_fewer_actions_are_executed_than_remembered(found, prior, tmp_path):
    flow_policy(found, prior=prior).save_pretrained(tmp_path)
    config = found["warm_flow"].config_class.from_pretrained(tmp_path, cli_overrides=["--n_action_steps=3"])
    policy = found["warm_flow"].from_pretrained(tmp_path, config=config).eval()
    assert policy.actor.prior.chunk_length == 4
    sources, chunks = [], []
    policy.actor.register_forward_hook(lambda module, args, out: sources.append(out["prior", "loc"]))
    policy.actor.register_forward_hook(lambda module, args, out: chunks.append(out["vla_action", "chunk"]))
    batch = one_observation()
    actions = torch.stack([policy.select_action(dict(batch)) for _ in range(9)], 1)
    assert len(sources) == 3
    expected = actions[:, 2:6] if prior.startswith("past") else chunks[1][:, 3:7]
    assert torch.equal(sources[2][:, :4], expected)
    refuses(lambda: flow_policy(found, prior_chunk=4, n_action_steps=5), ValueError, "n_action_steps", 4, 5)


def test_the_flow_policys_loss_is_algorithm_1(found):
    policy = flow_policy(found, prior="past,sigma=0.0", precondition=False).eval()
    batch = flow_batch(8)
    batch["action_is_pad"][0, :2] = True  # the beginning of an episode
    batch["action_is_pad"][1, 6:] = True  # and an end
    torch.manual_seed(5)
    loss, _ = policy.forward(batch)
    # By hand. The first draw is of the source, of which only the cold sample is left, then the times.
    torch.manual_seed(5)
    eps, t = torch.randn(3, 4, 2), torch.rand(3)
    history, target = batch["action"].split(4, 1)
    a0 = torch.where(torch.tensor([True, False, False])[:, None, None], eps, history)
    a_t = a0 + t[:, None, None] * (target - a0)
    seen = torch.cat([batch["observation.environment_state"], batch["observation.state"]], -1)
    with torch.no_grad():
        error = (policy.actor.network(t, a_t, seen) - (target - a0)).square()
    inside = (~batch["action_is_pad"][:, 4:])[..., None].expand_as(error)
    torch.testing.assert_close(loss.detach(), error[inside].mean())
    with raises(KeyError, "action_is_pad"):
        policy.forward({k: v for k, v in batch.items() if k != "action_is_pad"})


def test_a_network_that_cannot_be_made_is_named(found):
    missing = ["[", "3", '"x"', '{"name": "none"}', '{"name": "PlainMLP", "hidden_dim": -3}']
    for network in (*missing, '{"name": "PreconditionedNetwork", "network": 5}'):
        with raises(ValueError, "--policy.network"):
            flow_policy(found, network=network)


def test_the_flow_policy_remembers(found):
    policy = flow_policy(found, prior="past,sigma=0.0").eval()
    sources = []
    policy.actor.register_forward_hook(lambda module, args, out: sources.append(out["prior", "noise"]))
    batch = one_observation()
    actions = torch.stack([policy.select_action(dict(batch)) for _ in range(9)], 1)
    assert len(sources) == 3
    assert torch.equal(sources[1], actions[:, :4]) and torch.equal(sources[2], actions[:, 4:8])
    assert actions.abs().max() <= 1
    policy.reset()
    chunks = [policy.predict_action_chunk(dict(batch), executed_steps=4) for _ in range(2)]
    refuses(lambda: policy.predict_action_chunk(dict(batch)), ValueError, "executed_steps=")
    assert not torch.equal(sources[3], actions[:, 4:8])
    assert torch.equal(sources[4], chunks[0])
    with raises(ValueError, "executed_steps"):
        policy.predict_action_chunk({name: value + 1 for name, value in batch.items()}, executed_steps=99)
    assert torch.equal(policy._queues["observation.state"][-1], batch["observation.state"])  # not seen
    policy.predict_action_chunk(dict(batch), executed_steps=2)  # of four
    assert torch.equal(sources[5], torch.cat([chunks[0][:, 2:], chunks[1][:, :2]], 1))


def test_the_flow_policy_sees_images(found, tmp_path):
    """Resized, in a random window in training and the central one else; saved and loaded with its encoder."""
    from lerobot.configs.types import NormalizationMode

    standardised = {"normalization_mapping": {"VISUAL": NormalizationMode.MEAN_STD}}
    policy = flow_policy(found, images=(3, 16, 16), precondition=False, prior="past")
    batch = flow_batch(8)
    pictures = torch.randint(256, (3, 2, 3, 16, 16), generator=torch.Generator().manual_seed(1))
    batch["observation.images.top"] = pictures / 255
    policy.train().forward(batch)[0].backward()
    assert all(weight.grad is not None for weight in policy.actor.network.encoder.parameters())
    torch.manual_seed(3)
    loss = policy.eval().forward(batch)[0]
    vector = torch.cat([batch["observation.environment_state"], batch["observation.state"]], -1)
    observation = TensorDict({"state": vector, "observation.images.top": pictures.to(torch.uint8)}, [3])
    features = policy.actor.network.encoder(observation)
    torch.manual_seed(3)
    a0, t = torch.randn(3, 4, 2), torch.rand(3)
    history, target = batch["action"].split(4, 1)
    a0 = history + 0.5 * a0
    error = policy.actor.network.network(t, a0 + t[:, None, None] * (target - a0), features) - (target - a0)
    torch.testing.assert_close(loss, error.square().mean())

    policy.save_pretrained(tmp_path / "saved")
    again = found["warm_flow"].from_pretrained(tmp_path / "saved").eval()
    frames = torch.randint(256, (3, 2, 3, 48, 64), generator=torch.Generator().manual_seed(2)).byte()
    assert torch.equal(again._pixels(frames / 255), resized(frames, (16, 16)))
    again.config.resize = "pad"
    assert torch.equal(again._pixels(frames / 255), resized(frames, (16, 16), "pad"))
    again.config.resize = "squeeze"
    flat = torch.full((2, 3, 20, 24), 0.4)  # any size and shape is resized
    start = {"observation.state": torch.zeros(2, 3), "observation.environment_state": torch.zeros(2, 2)}
    actions = []
    for one in (policy, again):
        one.reset()
        torch.manual_seed(7)
        actions.append(one.select_action({**start, "observation.images.top": flat}))
    assert actions[0].shape == (2, 2) and torch.equal(*actions)
    refuses(lambda: policy.select_action(start), KeyError, "images.top")
    for options, fact in (({"encoder": "tiny"}, "resnet18-imagenet"), (standardised, "MEAN_STD")):
        with raises(ValueError, fact):
            flow_policy(found, images=(3, 16, 16), **options)
    with raises(ValueError, "[3, h, w]", "observation.images.top", "[1, 16"):
        flow_policy(found, images=(1, 16, 16))


def saved_policy(folder, **options):
    """A policy of lift's widths, with the environment that it was made for."""
    from warmprior import VelocityMLP, WarmPriorActor
    from warmprior.envs.description import environment_description
    from warmprior.envs.simulator import task_env_args
    from warmprior.saving import save_policy

    torch.manual_seed(0)
    data = torch.rand(2, 50, OBJECT + STATE), torch.rand(2, 50, 7)
    (low, high), (least, most) = ((value.amin(1), value.amax(1)) for value in data)
    low[0, 3] = high[0, 3] = 0.5  # constant
    ends = ((low, least), (high, most))
    normalizer = Normalizer(*({"observation": seen[0], "action": action[0]} for seen, action in ends))
    seen = options.get("observation_key") == keys.CONDITIONED
    width = HistoryObservation.width(8, 7) if seen else 0
    network = stirred(VelocityMLP(7, OBJECT + STATE + width, 8), by=0.05)
    environment = environment_description(task_env_args("lift"), "ph")
    recording = Recording("lift", 2, 50, "[7]", {"object": OBJECT, "robot": STATE}, rate=20)
    chosen = {"nfe": 3, "clip": 1.0, "normalizer": normalizer, "environment": environment} | options
    chosen |= {"recording": recording}
    actor = WarmPriorActor(network, PastPrior(8, sigma=0.3, correlation=0.5), **chosen)
    save_policy(actor, folder)
    return actor


def test_a_policy_of_this_library_is_one_of_lerobot(found, tmp_path):
    pytest.importorskip("robosuite")
    from lerobot.policies.factory import make_pre_post_processors
    from lerobot_policy_warmprior.export import export_policy, main
    from lerobot_policy_warmprior.robot import load_actor

    actor = saved_policy(tmp_path / "ours")
    out = export_policy(tmp_path / "ours", tmp_path / "theirs")
    policy = found["warm_flow"].from_pretrained(out)
    before, after = make_pre_post_processors(policy.config, pretrained_path=str(out))
    assert policy.actor.prior.config() == actor.prior.config()
    assert load_actor(out).recording == actor.recording
    raw = torch.randn(OBJECT + STATE)
    seen = {"observation.environment_state": raw[:OBJECT], "observation.state": raw[OBJECT:]}
    torch.manual_seed(7)
    action = after(policy.select_action(before(dict(seen))))
    # The same by this library: normalised, the observation twice, cold, and back.
    data = actor.normalizer.normalize(TensorDict({"observation": raw.expand(1, 2, -1)}, [1]))
    data.set("history", cold_history([1], 8, 8, 7))
    torch.manual_seed(7)
    chunk = actor(data)["vla_action", "chunk"]
    expected = actor.normalizer.denormalize(TensorDict({"action": chunk[:, 0]}, [1]))["action"]
    torch.testing.assert_close(action, expected)
    refuses(lambda: export_policy(tmp_path / "ours", out), FileExistsError, "folder")
    assert main([str(tmp_path / "ours"), str(tmp_path / "again")]) == 0
    for i, (options, fact) in enumerate(
        [
            *(({"clip": None}, "clip=1.0"), ({"observation_key": keys.CONDITIONED}, "last actions")),
            *(({"solver": "midpoint", "nfe": 4}, "Euler"), ({"grid": "dense-jump"}, "uniform")),
            *(({"guidance": RealTimeChunking()}, "guidance"), ({"start": Halfway()}, "Euler")),
            *(({"temperature": 0.5}, "'temperature': 0.5"), ({"max_nfe": 1, "nfe": 1}, "max_nfe")),
        ]
    ):
        saved_policy(tmp_path / f"other{i}", **options)
        with raises(ValueError, fact):
            export_policy(tmp_path / f"other{i}", tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_the_environment_has_the_observations_of_converted_demonstrations():
    pytest.importorskip("robosuite")
    import numpy as np
    from gymnasium.utils.env_checker import check_env
    from lerobot_policy_warmprior import RobosuiteEnvConfig

    from warmprior.envs import RobosuiteEnv

    config = RobosuiteEnvConfig(task="lift", episode_length=5)
    ((batch,),) = (suite.values() for suite in config.create_envs(2).values())
    assert not np.array_equal(*batch.reset()[0]["environment_state"])  # without a seed
    single = batch.envs[0]
    check_env(single, skip_render_check=True)
    observation, _ = batch.reset(seed=[3, 4])
    ours = RobosuiteEnv("lift", seed=3).reset()["observation"]
    assert np.array_equal(observation["environment_state"][0], ours[:OBJECT])
    assert np.array_equal(observation["agent_pos"][0], ours[OBJECT:])
    for _ in range(5):
        *_, truncated, info = batch.step(np.zeros((2, 7), np.float32))
    assert truncated.all() and info["final_info"]["is_success"].tolist() == [False, False]
    features = {name: entry.shape for name, entry in config.features.items()}
    assert features == {"action": (7,), "agent_pos": (STATE,), "environment_state": (OBJECT,)}
    batch.close()
    refuses(lambda: RobosuiteEnvConfig(task="life"), ValueError, "task", "'life'")
