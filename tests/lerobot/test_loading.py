import json
import resource
import shutil
import sys
from functools import cache
from itertools import product

import pytest
import torch
from safetensors.torch import load_file, save_file

from tests.errors import raises, refuses
from tests.lerobot.plugin_policies import VLA, flow_policy, small, warm

NAMES = [*VLA, "warm_flow"]


def made(found, name, **options):
    return flow_policy(found, **options) if name == "warm_flow" else warm(found, name, **options)


def load(found, name, folder, **options):
    if name == "warm_flow":
        return found[name].from_pretrained(folder, **options)
    with small(name):
        return found[name].from_pretrained(folder, **options)


@pytest.fixture(scope="module")
def whole(found, tmp_path_factory):
    """Folders of policies, each of which is saved once: tests change copies of them."""

    @cache
    def folder(name):
        place = tmp_path_factory.mktemp(name)
        made(found, name, n_action_steps=4).save_pretrained(place)
        load(found, name, place)
        return place

    return folder


@pytest.fixture
def saved(whole, tmp_path):
    """Copy such a policy, with other entries in its configuration."""

    def copied(name, **changed):
        shutil.copytree(whole(name), tmp_path, dirs_exist_ok=True)
        path = tmp_path / "config.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | changed))

    return copied


def edit(folder, change):
    weights = load_file(folder / "model.safetensors")
    change(weights)
    save_file(weights, folder / "model.safetensors")


BIAS = "actor.ode.network.network.head.1.bias"


def misfit(folder, how):
    """Spoil the weights; return what the error has to name."""
    one = max(load_file(folder / "model.safetensors"))
    if how == "absent":
        (folder / "model.safetensors").unlink()
        return "model.safetensors"
    if how == "foreign":
        save_file({"other.weight": torch.zeros(3)}, folder / "model.safetensors")
        return "other.weight"
    if how == "missing":
        edit(folder, lambda weights: weights.pop(one))
        return one
    if how in ("1e30", "NaN"):
        edit(folder, lambda weights: weights[BIAS].view(-1)[-1:].fill_(float(how)))
        return BIAS
    if how == "whole numbers":
        edit(folder, lambda weights: weights.update({BIAS: weights[BIAS].int()}))
        return BIAS
    name, size = (one, 99) if how == "shape" else ("more.weight", 3)
    edit(folder, lambda weights: weights.update({name: torch.zeros(size)}))
    return name


MISFITS = ["absent", "foreign", "missing", "shape", "unexpected"]


@pytest.mark.parametrize(
    ("name", "how"),
    [*product(NAMES, MISFITS), *(("warm_flow", how) for how in ("1e30", "NaN", "whole numbers"))],
)
def test_weights_that_do_not_fit_are_refused_by_name(found, saved, name, how, tmp_path):
    saved(name)
    fact = misfit(tmp_path, how)
    refuses(lambda: load(found, name, tmp_path), (ValueError, FileNotFoundError), fact, tmp_path)


def test_damaged_weights_are_named(found, saved, tmp_path):
    saved("warm_flow")
    file = tmp_path / "model.safetensors"
    content = bytearray(file.read_bytes())
    content[0] ^= 0xFF  # the length of the header
    file.write_bytes(content)
    refuses(lambda: load(found, "warm_flow", tmp_path), ValueError, file, "damaged")


@pytest.mark.parametrize(
    ("option", "value"),
    [
        *(("input_features", None), ("prior", None), ("prior", "past,sigma=1e30"), ("nfe", 0), ("nfe", [])),
        *(("nfe", None), ("dropout", None), ("normalization_mapping", None)),
        ("output_features", {"action": {"type": "ACTION", "shape": [10**30]}}),
    ],
)
def test_a_configuration_of_which_nothing_can_be_built(found, saved, tmp_path, option, value):
    saved("warm_flow", **{option: value})
    refuses(lambda: load(found, "warm_flow", tmp_path), ValueError, tmp_path, "cannot be built")


@pytest.mark.parametrize("option", ["sigma_unit", "cold_probability"])
def test_null_for_an_option_of_the_source(found, saved, option, tmp_path):
    saved("warm_smolvla", **{option: None})
    refuses(lambda: load(found, "warm_smolvla", tmp_path), ValueError, tmp_path, f"--policy.{option} needs")


def test_weights_of_another_size_are_named_in_one_line(found, saved, tmp_path):
    """As where a configuration lost an option, whose default is another."""
    saved("warm_flow", hidden_dim=48)
    with raises(ValueError, tmp_path, "size mismatch", "action_position", "...") as refused:
        load(found, "warm_flow", tmp_path)
    assert "\n" not in str(refused.value)


def test_a_configuration_does_not_take_the_memory_of_a_network_without_weights(found, saved, tmp_path):
    for width in (24_000, 960_000):  # gigabytes, and terabytes
        saved("warm_flow", hidden_dim=width, network="")
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        refuses(lambda: load(found, "warm_flow", tmp_path), ValueError, tmp_path, "far more weights")
        assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 500_000  # kB


def test_buffers_of_normalisation_of_old_checkpoints(found, saved, tmp_path):
    """LeRobot's processors have them now."""
    saved("warm_smolvla")
    old = {"normalize_inputs.buffer_observation_state.mean": torch.zeros(6)}
    edit(tmp_path, lambda weights: weights.update(old))
    load(found, "warm_smolvla", tmp_path)


SOURCES = [("prior", "preview"), ("prior_chunk", 4)]
CHANGES = {
    "warm_flow": [
        *(("precondition", False), ("num_layers", 2), ("num_heads", 3), ("n_obs_steps", 1)),
        *(("hidden_dim", 48), ("prior_chunk", 8), ("prior", "gaussian"), ("prior", "past,sigma=0.1")),
    ],
    "warm_pi05": [*SOURCES, ("sigma_unit", "std"), ("prior", "past,sigma=0.1")],
    "warm_smolvla": SOURCES,
    "warm_groot": SOURCES,
}


@pytest.mark.parametrize("name", NAMES)
def test_options_that_contradict_the_saved_ones(found, saved, name, tmp_path):
    saved(name)
    kind = found[name].config_class
    for option, value in CHANGES[name]:
        config = kind.from_pretrained(tmp_path)
        setattr(config, option, value)
        said = "prior" if option == "prior_chunk" else option
        with raises(ValueError, f"{said}="):
            load(found, name, tmp_path, config=config)
    # What changes no meaning is free.
    config = kind.from_pretrained(tmp_path)
    config.n_action_steps = 2
    loaded = load(found, name, tmp_path, config=config)
    assert loaded.config.n_action_steps == 2
    refuses(lambda: load(found, name, tmp_path, n_action_step=3), TypeError, "n_action_step")


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("prior", ["evil_module:Prior", "evil_module", "evil_module:Prior,sigma=0.1"])
def test_a_prior_in_a_file_imports_nothing(found, saved, name, prior, tmp_path, monkeypatch):
    saved(name, prior=prior)
    (tmp_path / "evil_module.py").write_text("raise SystemExit('ran')")
    monkeypatch.syspath_prepend(tmp_path)
    with raises(ValueError, "'evil_module", "--policy.discover_packages_path"):
        load(found, name, tmp_path)
    with raises(ValueError, "'evil_module"):
        found[name].config_class(prior=prior, device="cpu").action_delta_indices  # noqa: B018
    assert "evil_module" not in sys.modules


@pytest.mark.parametrize("place", ["path", "type"])
def test_own_priors_come_by_lerobots_own_option(found, place, tmp_path, monkeypatch):
    from lerobot.configs import parser
    from lerobot.configs.eval import EvalPipelineConfig
    from lerobot.configs.train import TrainPipelineConfig

    name = f"own_priors_by_{place}"
    code = f"from warmprior import PastPrior\n\n\nclass Own(PastPrior):\n    name = '{name}'\n"
    (tmp_path / name).mkdir()  # LeRobot imports a package
    (tmp_path / name / "__init__.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    made(found, "warm_flow").save_pretrained(tmp_path / "policy")
    if place == "path":
        config, own = EvalPipelineConfig, f"--env.discover_packages_path={name}"
        arguments = [own, f"--policy.path={tmp_path / 'policy'}", "--env.type=warmprior_robosuite"]
    else:
        config, own = TrainPipelineConfig, f"--policy.discover_packages_path={name}"
        arguments = [own, "--policy.type=warm_flow", "--dataset.repo_id=local/none"]
    monkeypatch.setattr(sys, "argv", ["lerobot", *arguments, f"--policy.prior={name},sigma=0.1"])
    seen = []

    def main(cfg):
        seen.append(cfg.policy.make_prior())

    main.__annotations__["cfg"] = config
    parser.wrap()(main)()
    assert seen[0].name == name and seen[0].sigma == 0.1


def test_groots_horizon_is_that_of_the_training_where_its_checkpoint_is_not(found, tmp_path):
    base, arm = tmp_path / "base", {"action": {"delta_indices": [0, 1, 2]}}
    base.mkdir()
    processor = {"processor_kwargs": {"modality_configs": {"arm": arm}}}
    (base / "processor_config.json").write_text(json.dumps(processor))
    options = {"base_model_path": str(base), "embodiment_tag": "arm", "n_action_steps": 3}
    warm(found, "warm_groot", **options).save_pretrained(tmp_path / "warm")
    base.rename(tmp_path / "elsewhere")
    again = load(found, "warm_groot", tmp_path / "warm")
    assert again.warm_adapter.prior.chunk_length == 3
