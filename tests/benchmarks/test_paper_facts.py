"""Every number that the code has from the paper, compared with the table of facts."""

import importlib
import inspect
import math

import mimicgen_tasks
import prior_space_rl
import pytest
import robomimic
import torch
from torch import nn

from lab.demonstrations.loading import navigation_task
from lab.options.command_line import parse
from lab.options.options import with_parts
from lab.options.presets import IMAGES, PRESETS
from lab.options.stored_options import recorded
from lab.reporting import paper
from lab.speed import timing
from tests import paper_facts as facts
from warmprior import (
    ChiTransformer,
    GaussianPrior,
    ImageEncoder,
    PastPrior,
    PlainMLP,
    PreviewPrior,
    VelocityMLP,
    WarmPriorActor,
)
from warmprior.diagnostics import curvature, flow_paths
from warmprior.envs.navigation1d import OBSTACLES, navigation_heights
from warmprior.envs.robosuite_tasks import TASKS
from warmprior.modules.learning_rate import warmup_cosine
from warmprior.rl import PriorSpaceConfig
from warmprior.rl.agent import delta_of
from warmprior.training import NetworkOptions, TrainingConfig, make_network
from warmprior.training.optim import ema_of, make_optimizer
from warmprior.training.option_text import options_of

PRIORS = {"gaussian": GaussianPrior, "past": PastPrior, "preview": PreviewPrior}
SCRIPTS = ("robomimic", "curvature", "sigma", "chunking", "budget", "real_time_chunking", "pusht")
MIMICGEN = {task: (f"{task}_d0", "source") for task in facts.MIMICGEN_TASKS}
SIZES = ("hidden_dim", "num_layers", "num_heads", "timestep_embedding_dim")
OPTIMIZER = {"learning_rate": "lr", "weight_decay": "weight_decay", "betas": "betas", "eps": "eps"}
STATE, IMAGE = facts.TABLE_3["state"], facts.TABLE_3["image"]


class Parsed(Exception):
    """Raised instead of the work of a script."""


def presets_of(name, monkeypatch):
    """The presets that a script reads its command line with."""
    script, found = importlib.import_module(name), {}

    def parse(presets, *args, **options):
        found.update(presets)
        raise Parsed

    for module in (script, robomimic):  # some scripts are robomimic.py with presets of their own
        monkeypatch.setattr(module, "parse", parse, raising=False)
    with pytest.raises(Parsed):
        script.main([])
    return found


def default(function, name):
    return inspect.signature(function).parameters[name].default


def values(source, names):
    return {name: getattr(source, name) for name in names}


def optimized(optimizer):
    group = optimizer.param_groups[0]
    return {name: group[key] for name, key in OPTIMIZER.items()}


def recipe(options):
    """The rows of Table 3, from what the options build."""
    network, training = make_network(options.network, 7, 9, 8), options.training
    (dropout,) = {module.p for module in network.modules() if isinstance(module, nn.Dropout)}
    rates = values(training, ("learning_rate", "weight_decay"))
    found = {
        **values(network, SIZES),
        "dropout": dropout,
        **optimized(make_optimizer(network, **rates)),
        **values(training, ("warmup_ratio", "ema_rate", "precision", "batch_size", "iterations")),
        "observation_steps": options.network.observation_steps,
    }
    if options.data.obs == "image":
        sizes = {"image_size": options.data.image_size, "crop_size": options.network.crop_size}
        encoder = ImageEncoder(["camera"], 0, backbone="small", **sizes)
        found |= {"encoder": options.network.encoder, **values(encoder, ("image_size", "crop_size"))}
    return found


def evaluation(options, **others):
    found = values(options.evaluation, ("episodes", "seeds", "top_k"))
    nfe = tuple(sorted(options.evaluation.nfe))
    return {**found, "nfe": nfe, "chunk": options.sources.chunk, **others}


@pytest.mark.parametrize("name", SCRIPTS)
def test_the_recipe_from_the_state(name, monkeypatch):
    preset, usual = presets_of(name, monkeypatch)["paper"], facts.EVALUATION
    assert (
        isinstance(make_network(preset.network, 7, 9, 8), ChiTransformer) and not preset.network.precondition
    )
    assert recipe(preset) == STATE
    # Two studies have one NFE, and one has all chunk lengths.
    own = {name: {"nfe": usual["nfe"]} for name in ("sigma", "real_time_chunking")}
    own |= {"chunking": {"chunk": usual["chunk"]}}
    assert evaluation(preset, **own.get(name, {})) == usual
    assert preset.sources.prior == tuple(facts.SIGMA) and preset.evaluation.grid == "uniform"
    loss = values(preset.training, ("times", "objective", "weighting"))
    assert tuple(loss.values()) == ("uniform", "velocity", "velocity")
    if name != "pusht":
        # The official files of one operator hold 200, where Table 3 says 250.
        assert preset.data.demonstrations == (200, facts.DEMONSTRATIONS["mh"])


def test_the_recipe_from_images(monkeypatch):
    paper = with_parts(PRESETS["paper"], **IMAGES["paper"])
    assert recipe(with_parts(paper, data={"obs": "image"})) == IMAGE
    preset = mimicgen_tasks.FEW["paper"]
    assert evaluation(preset) == facts.EVALUATION
    monkeypatch.setattr("warmprior.modules.encoder.imagenet_weights", lambda: None)  # nothing is downloaded
    asked = with_parts(preset, preset="paper", data={"download": True})
    adapted = mimicgen_tasks.adapt(preset, asked)
    assert recipe(preset) == recipe(adapted) == facts.TABLE_3["mimicgen"]
    assert [(task, *adapted.data.style) for task in adapted.data.task] == list(MIMICGEN.values())
    counts = {found.data.demonstrations for found in mimicgen_tasks.FEW.values()}
    assert counts == {(facts.DEMONSTRATIONS["mimicgen"],)}


def unlike_the_paper(presets):
    """The options in which the preset of the public code is not the paper's."""
    paper, other = (recorded(presets[name]) for name in ("paper", "much-ado"))
    found = {}
    for part, options in other.items():
        if isinstance(options, dict):
            found |= {name: value for name, value in options.items() if value != paper[part][name]}
            if text := found.pop("network", ""):
                assert text.startswith(paper[part]["network"])
                found |= options_of(text)
        else:
            assert options == paper[part]
    return found


@pytest.mark.parametrize("name", [*SCRIPTS, "joint_targets"])
def test_the_preset_of_the_public_code_from_the_state(name, monkeypatch):
    # Tasks of one's own have actions of their own.
    actions = {} if name in ("pusht", "joint_targets") else facts.MUCH_ADO_ACTIONS
    assert unlike_the_paper(presets_of(name, monkeypatch)) == facts.MUCH_ADO | actions


def test_the_preset_of_the_public_code_from_images(monkeypatch):
    pytest.importorskip("torchvision")
    monkeypatch.setattr("warmprior.envs.rendering.require_rendering", lambda: None)
    argv = ["--preset", "much-ado", "--obs", "image", "--out", "out"]
    adapted = {
        name: with_parts(with_parts(PRESETS[name], **IMAGES[name]), data={"obs": "image"})
        for name in ("paper", "much-ado")
    }
    for presets in (adapted, mimicgen_tasks.FEW):
        assert unlike_the_paper(presets) == facts.MUCH_ADO | facts.MUCH_ADO_ENCODER
        assert presets["much-ado"].data.actions == "delta"
    read = parse(PRESETS, argv, "robomimic", None)
    assert with_parts(read, preset="quick", run=vars(adapted["much-ado"].run)) == adapted["much-ado"]
    network = make_network(read.network, 7, 9, 8, {"agentview_image": 84})
    observation_layers = network.network.observation_layers
    assert (observation_layers, network.encoder.backbone) == (2, "resnet18")


def test_what_the_preset_of_the_public_code_builds():
    network = make_network(PRESETS["much-ado"].network, 10, 9, 8)
    angles = network.embed_time[0].frequencies
    assert (angles.max().item(), angles.min().item()) == (
        1.0,
        pytest.approx(facts.MUCH_ADO["time_frequency"]),
    )
    hidden = [layer for layer in network.embed_observation.modules() if isinstance(layer, nn.Linear)][:-1]
    assert len(hidden) == facts.MUCH_ADO["observation_layers"] and hidden[0].in_features == 2 * 9
    assert isinstance(network, ChiTransformer) and values(network, SIZES).items() <= STATE.items()


def test_defaults_of_the_library():
    assert {name: kind(8).sigma for name, kind in PRIORS.items()} == facts.SIGMA
    sizes = {name: default(ChiTransformer, name) for name in (*SIZES, "dropout")}
    assert STATE.items() >= sizes.items()
    steps = [default(kind, "observation_steps") for kind in (ChiTransformer, VelocityMLP, PlainMLP)]
    assert {*steps, NetworkOptions().observation_steps} == {STATE["observation_steps"]}
    assert STATE.items() >= values(TrainingConfig(), ("weight_decay", "ema_rate", "precision")).items()
    assert STATE.items() >= optimized(make_optimizer(VelocityMLP(1, 1, 1, hidden_dim=8))).items()
    assert default(warmup_cosine, "warmup_ratio") == STATE["warmup_ratio"]
    assert default(ema_of, "rate") == STATE["ema_rate"]
    encoder = ImageEncoder(["camera"], 0, backbone="small")
    assert IMAGE.items() >= values(encoder, ("image_size", "crop_size")).items()


def test_the_images_network_has_group_norm():
    pytest.importorskip("torchvision")
    encoder = make_network(NetworkOptions("plain_mlp", encoder="resnet18"), 7, 9, 8, {"camera": 84}).encoder
    kinds = {type(module) for module in encoder.modules() if "Norm" in type(module).__name__}
    assert kinds == {nn.GroupNorm} and encoder.backbone == "resnet18"


def test_tasks_have_the_papers_cameras_and_widths():
    for task, count in facts.CAMERAS.items():
        for name in MIMICGEN if task == "mimicgen" else (task,):
            spec = TASKS[MIMICGEN[name][0] if name in MIMICGEN else name]
            wrists = [camera for camera in spec.cameras if camera.endswith("eye_in_hand")]
            assert (len(spec.cameras), 2 * len(wrists)) == (count, count)
    assert tuple(sorted({spec.action_dim for spec in TASKS.values()})) == facts.ACTION_DIM
    hang = TASKS["tool_hang"]  # beside images there is the robot's own part; Transport's 59 are beyond
    assert (hang.observation_dim - hang.object_dim, hang.observation_dim) == facts.STATE_DIM


def test_speed_is_measured_at_the_papers_sizes():
    from peers import PEERS

    from lab.speed.training import paper_network

    widths = {PEERS["warmprior_transformer"][0], paper_network().hidden_dim}
    assert widths == {STATE["hidden_dim"]} and STATE["observation_steps"] == timing.TO
    assert (facts.EVALUATION["nfe"], facts.EVALUATION["chunk"]) == (timing.NFES, (timing.H,))


def row(task, data, obs, prior, nfe, **more):
    """A row of results, of the paper's own experiment."""
    place = {"task": task, "data": data, "obs": obs, "prior": prior, "nfe": nfe}
    return {**place, "sigma": facts.SIGMA[prior], "chunk": 8, **more}


def table_1():
    """Every entry: where it is, and the rate."""
    for (task, data, obs), rates in facts.SUCCESS.items():
        task, data = MIMICGEN[task] if data == "mimicgen" else (task, data)
        places = ((task, data, obs, prior, nfe) for nfe in (9, 3, 1) for prior in PRIORS)
        yield from zip(places, rates, strict=True)


def test_every_entry_of_table_1():
    entries = dict(table_1())
    stored = {
        (*setting, prior, nfe): rate
        for setting, priors in paper.PAPER_SUCCESS.items()
        for prior, rates in priors.items()
        for nfe, rate in rates.items()
    }
    assert stored == entries and len(entries) == 13 * 9
    for place, rate in entries.items():
        assert paper.paper_success(row(*place)) == pytest.approx(rate / 100)


def test_every_entry_of_table_2():
    entries = {
        setting: dict(zip(("past", "preview"), pair, strict=True))
        for setting, pair in facts.CURVATURE.items()
    }
    assert entries == paper.PAPER_CURVATURE
    others = ({"obs": "image"}, {"sigma": 0.3}, {"options": "correlation=0.5"}, {"chunk": 4})
    for (task, data), ratios in entries.items():
        for prior, ratio in ratios.items():
            one = row(task, data, "state", prior, 9)
            assert paper.paper_curvature(one) == ratio
            assert all(math.isnan(paper.paper_curvature(one | more)) for more in others)


def test_the_study_of_sigma_has_rates_of_its_own():
    assert facts.EVALUATION["chunk"] == (paper.PAPER_CHUNK,) and facts.SIGMA == paper.PAPER_DEFAULT_SIGMA
    stored = {
        (prior, sigma): rate for prior, rates in paper.PAPER_SIGMA.items() for sigma, rate in rates.items()
    }
    assert stored == facts.SIGMA_SUCCESS
    others = [{"chunk": 1}, {"delay": 0}, {"temperature": 0.5}, {"actions": "absolute"}]
    others += [{"options": "correlation=0.5"}]
    elsewhere = [{"obs": "image"}, {"nfe": 3}, {"data": "ph"}, {"task": "transport"}]
    for (prior, sigma), rate in stored.items():
        one = row("square", "mh", "state", prior, 1, sigma=sigma)
        assert paper.paper_success(one) == rate
        without = others + (elsewhere if sigma == 0 else [])
        assert all(math.isnan(paper.paper_success(one | more)) for more in without)


def test_the_study_of_sigma(monkeypatch):
    presets = presets_of("sigma", monkeypatch)
    for preset in presets.values():
        assert preset.sources.sigma == facts.SIGMAS and preset.evaluation.nfe == facts.SIGMA_STUDY["nfe"]
    assert evaluation(presets["paper"]).items() >= facts.SIGMA_STUDY.items()


def test_the_curvature(monkeypatch):
    assert default(curvature, "n_steps") == default(flow_paths, "n_steps") == facts.CURVATURE_STEPS
    for preset in presets_of("curvature", monkeypatch).values():
        assert preset.measured == facts.CURVATURE_OBSERVATIONS


def test_the_study_without_chunks(monkeypatch):
    for preset in presets_of("chunking", monkeypatch).values():
        assert {facts.NO_CHUNKS["chunk"], *facts.EVALUATION["chunk"]} <= {*preset.sources.chunk}
        assert facts.NO_CHUNKS["nfe"] in preset.evaluation.nfe


def test_the_toy(monkeypatch):
    presets, toy = presets_of("navigation1d", monkeypatch), facts.TOY
    preset = presets["paper"]
    network = make_network(preset.network, 1, facts.TOY_OBSERVATION_DIM, 4)
    layers = [module for module in network.modules() if isinstance(module, nn.Linear)]
    assert isinstance(network, PlainMLP) and len(layers) == toy["layers"]
    widths = {layer.out_features for layer in layers[:-1]}
    assert widths == {toy["width"]} == {default(PlainMLP, "hidden_dim")}
    assert toy.items() >= values(preset.training, ("iterations", "batch_size")).items()
    # The rest of the recipe is that of its robot tasks.
    rest = ("learning_rate", "weight_decay", "warmup_ratio", "ema_rate", "precision")
    assert STATE.items() >= values(preset.training, rest).items()
    assert all(found.sources.sigma == toy["sigma"] for found in presets.values())
    assert preset.position_only and not preset.network.precondition
    assert navigation_task("position").data["observation"].shape[-1] == facts.TOY_OBSERVATION_DIM
    heights = navigation_heights()
    assert (len(heights), len(OBSTACLES)) == (facts.TOY_DEMONSTRATIONS, facts.TOY_OBSTACLES)
    for side in (heights > 0, heights < 0):
        assert 2 * side.all(1).sum() == facts.TOY_DEMONSTRATIONS


def test_the_agents():
    presets = prior_space_rl.AGENT_PRESETS
    preset = presets["paper"]
    assert (preset.algorithm, preset.warm_algorithm) == (facts.AGENTS["baselines"], facts.AGENTS["warm"])
    assert preset.evaluation.seeds == facts.AGENTS["seeds"] and preset.sources.prior == tuple(facts.SIGMA)
    assert recipe(preset) == STATE  # of the frozen policies
    for name, kind in PRIORS.items():
        prior = kind(2)
        actor = WarmPriorActor(VelocityMLP(1, 1, prior.prediction_length, hidden_dim=8), prior)
        expected = facts.BOX_AROUND_ZERO if name == "gaussian" else facts.BOX_AROUND_MEAN
        assert delta_of(PriorSpaceConfig(), actor) == expected
    assert presets["unit"].delta == (facts.BOX_AROUND_MEAN, facts.BOX_AROUND_ZERO)


def test_the_policy_for_lerobot():
    for package in ("lerobot", "transformers", "lerobot_policy_warmprior"):
        pytest.importorskip(package)
    from lerobot_policy_warmprior.configuration_warm_flow import WarmFlowConfig, WarmupRatioConfig

    config = WarmFlowConfig()
    names = ("hidden_dim", "num_layers", "num_heads", "dropout", "ema_rate")
    assert (
        IMAGE.items() >= values(config, (*names, "encoder", "image_size")).items()
        and config.crop_size is None
    )
    weights = [nn.Parameter(torch.zeros(1))]
    assert IMAGE.items() >= optimized(config.get_optimizer_preset().build(weights)).items()
    assert WarmupRatioConfig().warmup_ratio == IMAGE["warmup_ratio"]
    assert config.get_scheduler_preset().warmup_ratio == IMAGE["warmup_ratio"]
    assert config.n_obs_steps == IMAGE["observation_steps"]
    assert (config.n_action_steps,) == facts.EVALUATION["chunk"]
    assert config.make_prior().sigma == facts.SIGMA["past"]
