import dataclasses
import importlib
import json

import pytest
import torch

from tests.errors import raises, refuses
from tests.lerobot.plugin_policies import NEEDS_PLUGIN, VLA, flow_batch, flow_policy, small, warm
from tests.lerobot.seen import watch
from tests.lerobot.tiny import ACTION, CAMERA, LENGTH, observations, windows

pytestmark = NEEDS_PLUGIN


@pytest.mark.parametrize("name", VLA)
def test_a_base_checkpoint_becomes_a_warm_policy(found, name, built, tmp_path):
    base = built(name.removeprefix("warm_"))
    base.save_pretrained(tmp_path / "base")
    taken = {f.name: getattr(base.config, f.name) for f in dataclasses.fields(base.config) if f.init}
    config = found[name].config_class(**taken, prior="past,sigma=0.0")
    assert config.action_delta_indices == list(range(-LENGTH, LENGTH))
    dropped = [getattr(of, "drop_n_last_frames", 0) for of in (config, base.config)]
    assert dropped[0] == dropped[1]  # the same steps of an episode begin a window
    with small(name):
        policy = found[name].from_pretrained(tmp_path / "base", config=config)
    for key, value in base.state_dict().items():
        assert torch.equal(policy.state_dict()[key], value), key
    # And is saved, and loaded, as what it is.
    policy.save_pretrained(tmp_path / "warm")
    assert json.loads((tmp_path / "warm" / "config.json").read_text())["type"] == name
    with small(name):
        again = found[name].from_pretrained(tmp_path / "warm")
    assert again.config.prior == "past,sigma=0.0"
    # LeRobot finds the processors by these names.
    module = importlib.import_module(type(config).__module__.replace("configuration_", "processor_"))
    assert callable(getattr(module, f"make_{name}_pre_post_processors"))
    assert all(map(torch.equal, again.state_dict().values(), policy.state_dict().values()))


@pytest.mark.parametrize("name", VLA)
def test_losses_and_chunks_start_from_the_prior(found, name):
    torch.manual_seed(0)
    family = name.removeprefix("warm_")
    policy = warm(found, name, prior="past,sigma=0.0", n_action_steps=4).train()
    batch = windows(family, 2, LENGTH)
    with watch(family, policy) as seen:
        loss, _ = policy.forward(dict(batch))
    history, target = batch["action"][:, :LENGTH], batch["action"][:, -LENGTH:, :ACTION]
    history = batch.get("action_history", history)
    # On the line between the two, at one time per sample: t = 1 is the source.
    x = seen.x[0][..., :ACTION]
    t = ((x - target) / (history - target)).flatten(1)
    torch.testing.assert_close(t, t.mean(1, keepdim=True).expand_as(t), rtol=1e-2, atol=1e-3)
    assert loss.isfinite()
    policy.eval()
    policy.reset()
    start, actions, sources = observations(family, 2), [], []
    for _ in range(9):
        with watch(family, policy) as seen:
            actions.append(policy.select_action(dict(start)))
        sources += [x[..., :ACTION] for x in seen.x[:1]]
    assert len(sources) == 3
    assert torch.equal(sources[2], torch.stack(actions[:LENGTH], 1))
    policy.reset()
    with watch(family, policy) as seen:
        policy.predict_action_chunk(dict(start))
    assert not torch.equal(seen.x[0][..., :ACTION], sources[2])


def test_groots_processors_keep_the_history_apart(found, tmp_path, monkeypatch):
    """Minima and maxima by hand; the chunk is what GR00T's own processors make of it."""
    from lerobot.policies.factory import make_pre_post_processors
    from lerobot.policies.groot import processor_groot
    from lerobot_policy_warmprior import loading
    from lerobot_policy_warmprior.processor_warm_groot import check_pretrained

    # What encodes images and language is on the hub.
    monkeypatch.setattr(processor_groot.GrootN17VLMEncodeStep, "__call__", lambda self, seen: seen)
    actions = torch.randn(20, 3 + LENGTH, ACTION) * torch.linspace(0.1, 3.0, ACTION) + 5.0
    flat = actions.flatten(0, 1)
    low, high = flat.amin(0), flat.amax(0)
    options = {"dataset_stats": {"action": {"min": low, "max": high}}}
    config = warm(found, "warm_groot", prior="past,sigma=0.0", prior_chunk=3, n_action_steps=3).config
    assert config.action_delta_indices == list(range(-3, LENGTH))
    before, after = make_pre_post_processors(config, **options)
    seen = torch.rand(20, *config.input_features["observation.state"].shape)
    raw = {"observation.state": seen, "action": actions, "task": ["push"] * 20}
    raw["action_is_pad"] = torch.arange(3 + LENGTH).lt(2).expand(20, -1) | torch.arange(3 + LENGTH).ge(9)
    before.save_pretrained(tmp_path), after.save_pretrained(tmp_path)
    again, _ = make_pre_post_processors(config, pretrained_path=str(tmp_path))
    own, _ = processor_groot.make_groot_pre_post_processors(config, **options)
    chunk = {name: value[:, 3:] if name.startswith("action") else value for name, value in raw.items()}
    theirs = own(dict(chunk))
    for pipeline in (before, again):
        batch = pipeline(dict(raw))
        scaled = 2 * (actions[:, :3] - low) / (high - low) - 1
        torch.testing.assert_close(batch["action_history"], scaled)
        assert torch.equal(batch["action_history_is_pad"], raw["action_is_pad"][:, :3])
        for name in ("action", "action_mask", "action_is_pad", "state"):
            assert torch.equal(batch[name], theirs[name]), name
        observation = {"observation.state": raw["observation.state"], "task": raw["task"]}
        assert "action_history" not in pipeline(observation)
        pipeline.steps[2].valid_action_horizon = 2  # of an embodiment; it does not limit what is remembered
        torch.testing.assert_close(pipeline(dict(raw))["action_history"], scaled)
    # A training that continues takes the saved processors, which have to remember as many actions.
    check_pretrained(config, str(tmp_path))
    asked = {}

    def download(*place, **options):
        asked.update(options)
        return tmp_path / "policy_preprocessor.json"

    monkeypatch.setattr(loading, "hf_hub_download", download)
    check_pretrained(config, "user/policy", revision="v1")
    assert asked == {"revision": "v1"}
    config.prior_chunk = 4
    refuses(lambda: check_pretrained(config, str(tmp_path)), ValueError, 3, "prior='past,sigma=0.0'", 4)
    own.save_pretrained(tmp_path)
    config.pretrained_path = "elsewhere"  # where it once came from does not count
    with small("warm_groot"), raises(ValueError, "--policy.base_model_path"):
        found["warm_groot"].from_pretrained(tmp_path, config=config)
    before.steps[2].modality_config = {"action": {"action_configs": [{"rep": "relative"}]}}
    refuses(lambda: before(dict(raw)), ValueError, "embodiment_tag")


@pytest.mark.parametrize("name", [*VLA, "warm_flow"])
def test_another_number_of_environments(found, name):
    """Also while LeRobot's queue still has actions of the others."""
    if name == "warm_flow":
        policy, batches = flow_policy(found), {n: flow_batch(8, n) for n in (2, 3)}
        batches = {n: {k: v[:, -1] for k, v in b.items() if "obs" in k} for n, b in batches.items()}
    else:
        policy = warm(found, name, n_action_steps=4)
        batches = {n: observations(name.removeprefix("warm_"), n) for n in (2, 3)}
    policy.eval().reset()
    policy.select_action(dict(batches[2]))
    for call in (policy.select_action, policy.predict_action_chunk):
        with raises(ValueError, 3, 2, "reset"):
            call(dict(batches[3]))
    refuses(lambda: policy.select_action(dict(batches[2]), nfe=3), TypeError, "nfe")
    policy.reset()
    assert len(policy.select_action(dict(batches[3]))) == 3


@pytest.mark.parametrize("name", VLA)
def test_a_damaged_observation_is_refused(found, name):
    policy = warm(found, name, n_action_steps=4).eval()
    seen = observations(name.removeprefix("warm_"), 2)
    state = "state" if name == "warm_groot" else "observation.state"
    damage = {state: seen[state] * torch.nan}
    if CAMERA in seen:
        damage[CAMERA] = 255 * seen[CAMERA]
    for act in (policy.select_action, policy.predict_action_chunk):
        for entry, value in damage.items():
            refuses(lambda act=act, change={entry: value}: act(seen | change), ValueError, entry)
        assert act(seen).isfinite().all()
