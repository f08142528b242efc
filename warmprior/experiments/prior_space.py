"""Reinforcement learning in the source space of frozen policies: recipes, and their environments."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import MISSING, asdict, dataclass, field, fields, make_dataclass, replace
from functools import partial
from typing import Annotated, Any, Literal, get_type_hints

import tyro
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.transforms import Compose

from warmprior.diagnostics.flow import sees_history
from warmprior.envs import GoalNavigationEnv
from warmprior.envs.description import environment_parts
from warmprior.experiments.navigation1d import NAVIGATION_PRESETS
from warmprior.experiments.presets import PRESETS
from warmprior.experiments.recipe import (
    EvaluationOptions,
    Flat,
    PolicyOptions,
    Recipe,
    SourceOptions,
    check_counts,
)
from warmprior.experiments.record import refuse_ignored
from warmprior.experiments.store import finished_problem
from warmprior.modules.actor import WarmPriorActor
from warmprior.rl import PriorAnchor, PriorSpaceConfig
from warmprior.training.evaluation import parallel_env
from warmprior.transforms import EncodeObservation, policy_transforms

__all__ = [
    "PRIOR_SPACE_PRESETS",
    "PriorSpaceRecipe",
    "agent_environment",
    "agent_policy",
    "prior_space_preset",
]

TOY = "navigation"

PER_AGENT = ("algorithm", "seed", "nfe", "evaluation_episodes")
"""Of the recipe of an agent: told by the options that all experiments share."""

_HINTS = get_type_hints(PriorSpaceConfig)
AgentOptions: Any = make_dataclass(
    "AgentOptions",
    [
        (f.name, _HINTS[f.name], field(default=f.default))
        for f in fields(PriorSpaceConfig)
        if f.name not in PER_AGENT and f.default is not MISSING
    ],
    frozen=True,
    namespace={"__doc__": PriorSpaceConfig.__doc__},
)
"""The rest of :class:`~warmprior.rl.PriorSpaceConfig`, the same for all agents of an experiment."""


@dataclass(frozen=True)
class GroupOptions:
    """The agents to compare.

    Attributes:
        algorithm: of their learning.
        horizon: time limit in control steps (default: the task's).
        base_delta: half the agent's box around zero, where --rl.delta is not given (default: 1.5).
        num_envs: parallel environments of an agent.
        threads: of an agent's training; more than one only wait for each other in small networks.
        collectors: Ray actors that collect, with num-envs environments each, with --engine ray (default:
            none, the training itself collects).
    """

    algorithm: tuple[Literal["dsrl-na", "dsrl-sac"], ...] = ("dsrl-na",)
    horizon: int | None = None
    base_delta: float | None = None
    num_envs: int = 4
    threads: int | None = None
    collectors: int | None = None

    def __post_init__(self) -> None:
        check_counts(self, "horizon", "num_envs", "threads")
        check_counts(self, "collectors", most=10)  # their seeds are apart from others' by that much


@dataclass(frozen=True)
class PriorSpaceRecipe(Recipe):
    """Everything that determines a comparison of agents; the frozen policies are those of a comparison.

    Attributes:
        policies: of a finished run, instead of those of the options.
        rl: what all agents share.
        agents: what is compared.
    """

    policies: Annotated[PolicyOptions, Flat] = field(default_factory=PolicyOptions)
    # With their prefix: gradient steps, say, are those of behaviour cloning in all experiments.
    rl: Annotated[AgentOptions, tyro.conf.arg(name="rl")] = field(default_factory=AgentOptions)
    agents: Annotated[GroupOptions, Flat] = field(default_factory=GroupOptions)

    @property
    def is_toy(self) -> bool:
        """Whether it is of the navigation toy."""
        return self.data.task == (TOY,)

    @property
    def name(self) -> str:
        """Of the output folder."""
        return TOY if self.is_toy else super().name

    def check(self) -> None:
        """Refuse what cannot work, or has no effect, before any work."""
        if self.is_toy != (self.run.preset == "unit"):
            raise ValueError(f"--task {TOY} and --preset unit belong together")
        self.check_single(problem=True, chunk=True, sigma=True, nfe=True)
        if self.agents.collectors is not None and self.run.engine != "ray":
            raise ValueError("--collectors belongs to --engine ray")
        base = prior_space_preset(self)
        if self.policies.run is not None:
            told = "--run brings its policies and their data"
            parts = ["data", "network", "training", "sources", "run"]
            but = ["task", "prior", "seed", "preset", "device"]
            refuse_ignored(self, base, parts, told, but=but)
        elif self.is_toy:
            told = "the toy has demonstrations and a time limit of its own"
            refuse_ignored(self, base, ["data"], told)
            refuse_ignored(self, base, ["network"], told, only=["observation_steps"])
            for name, given in (
                ("horizon", self.agents.horizon is not None),
                ("play-on", self.evaluation.play_on),
            ):
                if given:
                    raise ValueError(f"{told}: leave out --{name}")
        else:
            self.data.check()
            self.check_observations()
        configs: dict[tuple[str, str], dict[str, Any]] = {}
        for method in self.sources.methods():
            same = configs.setdefault((method.name, method.options), method.config())
            if same != method.config():
                raise ValueError(
                    "agents are told apart by the name and options of their method, but for sigma: they "
                    f"would not tell {method} from another {method.name}. Compare these in runs of their own"
                )
            if not method.is_flow:
                raise ValueError(
                    f"--prior {method.name} is no flow: there is no source space to act in"
                )
            for algorithm in self.agents.algorithm:
                self.agent(method.has_anchor, algorithm, 0)

    def agent(self, anchored: bool, algorithm: str, seed: int) -> PriorSpaceConfig:
        """The recipe of one agent.

        Args:
            anchored: whether its frozen policy has an anchor, see :func:`~warmprior.rl.has_anchor`.
            algorithm: of its learning.
            seed: its seed.

        Raises:
            ValueError: for a number out of its range, naming it.
        """
        shared: Mapping[str, Any] = asdict(self.rl)
        own: dict[str, Any] = {
            "algorithm": algorithm,
            "seed": seed,
            "nfe": self.evaluation.nfe[0],
            "evaluation_episodes": self.evaluation.episodes,
            "backup_entropy": shared["backup_entropy"] or algorithm == "dsrl-sac",
        }
        if shared["delta"] is None and not anchored:
            own["delta"] = self.agents.base_delta
        return PriorSpaceConfig(**{**shared, **own})


def agent_environment(recipe: PriorSpaceRecipe, actor: WarmPriorActor) -> Callable[[int], EnvBase]:
    """The environment of agents around a frozen policy, as a function of its seed.

    Args:
        recipe: how many at once, and the time limit.
        actor: the frozen policy, which knows its own environment.
    """
    if recipe.is_toy:
        return partial(_toy, actor, recipe.agents.num_envs)
    make_env, make_transforms = environment_parts(actor)
    make_env = partial(make_env, horizon=recipe.agents.horizon, **recipe.evaluation.environment)
    return partial(_simulators, actor, make_env, make_transforms, recipe.agents.num_envs)


def agent_policy(actor: WarmPriorActor) -> WarmPriorActor:
    """The frozen policy of an agent: one that sees images reads their features, as the agent does.

    Args:
        actor: the policy.
    """
    encoding = _encoding(actor)
    return actor.replace(observation_key=encoding[0].out_keys[0]) if encoding else actor


def _encoding(actor: WarmPriorActor) -> list[EncodeObservation]:
    return [EncodeObservation(actor)] if getattr(actor.network, "encodes", False) else []


def _toy(actor: WarmPriorActor, num_envs: int, _seed: int) -> EnvBase:
    transforms = policy_transforms(
        actor.prior, observation_steps=1, see_history=sees_history(actor)
    )
    transforms.append(PriorAnchor(actor))
    return TransformedEnv(GoalNavigationEnv(batch_size=[num_envs]), transforms)


def _simulators(
    actor: WarmPriorActor, make_env: Any, make_transforms: Any, num_envs: int, seed: int
) -> EnvBase:
    # Outside of the workers: one anchor draws for all of them, and one encoder serves them.
    workers = parallel_env(make_env, make_transforms, num_envs)
    env = TransformedEnv(workers, Compose(*_encoding(actor), PriorAnchor(actor)))
    env.set_seed(seed, static_seed=True)
    return env


def _with(recipe: PriorSpaceRecipe, **parts: Mapping[str, Any]) -> PriorSpaceRecipe:
    """Replace leaves of a recipe, by part."""
    made = {part: replace(getattr(recipe, part), **values) for part, values in parts.items()}
    return replace(recipe, **made)


_TOY, _QUICK, _PAPER = NAVIGATION_PRESETS["quick"], PRESETS["quick"], PRESETS["paper"]

PRIOR_SPACE_PRESETS: dict[str, PriorSpaceRecipe] = {
    # Lift from a weak policy, WP-Past against the base, two seeds: half an hour.
    "quick": PriorSpaceRecipe(
        network=_QUICK.network,
        training=_QUICK.training,
        sources=SourceOptions(prior=("gaussian", "past")),
        evaluation=EvaluationOptions(seeds=2, episodes=40, nfe=(1,)),
        rl=AgentOptions(
            environment_steps=24_000,
            warmup_steps=3_000,
            updates=4,
            noise_critic_steps=2,
            learning_rate=1e-3,
            gamma=0.97,
            hidden_dim=128,
            # At 1, the entropy of 56 coordinates outweighs the 8 control steps of a decision: the agent
            # would be paid for not solving the task, until the temperature has fallen.
            alpha_init=0.05,
            evaluate_every=6_000,
        ),
        agents=GroupOptions(threads=1),
    ),
    # The navigation toy with a goal, three seeds: about two minutes.
    "unit": PriorSpaceRecipe(
        network=_TOY.network,
        training=replace(_TOY.training, iterations=800, save_every=800, cold_probability=0.0),
        sources=SourceOptions(prior=("past",)),
        evaluation=EvaluationOptions(seeds=3, episodes=128, nfe=(2,)),
        rl=AgentOptions(
            environment_steps=12_000,
            warmup_steps=3_000,
            updates=12,
            noise_critic_steps=4,
            learning_rate=1e-3,
            tau=0.05,
            gamma=1.0,
            hidden_dim=128,
            num_layers=2,
            # Failure ends the episode: entropy in the targets would pay for not failing, whatever the reward.
            backup_entropy=False,
            alpha_init=0.02,
            reward_offset=0.0,
            evaluate_every=6_000,
        ),
        agents=GroupOptions(num_envs=32, threads=1),
    ),
    # DSRL's hyper-parameters per task, three seeds: needs a GPU.
    "paper": PriorSpaceRecipe(
        data=_PAPER.data,
        network=_PAPER.network,
        training=_PAPER.training,
        sources=SourceOptions(chunk=(4,)),
        evaluation=EvaluationOptions(seeds=3, episodes=200, nfe=(1,)),
        # Success ends the episode here, unlike in DSRL: entropy in the targets would pay for not solving it.
        rl=AgentOptions(environment_steps=1_000_000, backup_entropy=False, evaluate_every=50_000),
    ),
}
"""Budgets of comparisons of agents."""

_TASKS = {"quick": ("lift",), "unit": (TOY,)}
"""What a preset is for where no task, file or run is named."""

_BY_TASK: dict[tuple[str, str], dict[str, dict[str, Any]]] = {
    # Weak policies: solved in 0.3 to 0.8 of the episodes.
    ("quick", "lift"): {
        "data": {"demonstrations": (5,)},
        "training": {"iterations": 300},
        "agents": {"horizon": 90},
    },
    ("quick", "can"): {"training": {"iterations": 500}},
    ("paper", "lift"): {"rl": {"updates": 30}, "agents": {"horizon": 300}},
    ("paper", "can"): {"agents": {"horizon": 300}},
    ("paper", "square"): {
        "rl": {"gamma": 0.999, "warmup_steps": 32_000},
        "agents": {"horizon": 400},
    },
    # DSRL's own choice there is SAC.
    ("paper", "transport"): {
        "rl": {"hidden_dim": 128, "warmup_steps": 640_000},
        "sources": {"chunk": (8,)},
        "agents": {"horizon": 800, "base_delta": 1.0, "algorithm": ("dsrl-na", "dsrl-sac")},
    },
}
"""What a preset does differently on a task."""


def prior_space_preset(asked: PriorSpaceRecipe) -> PriorSpaceRecipe:
    """The preset that is asked for, with the hyper-parameters of the task.

    Args:
        asked: names both.

    Raises:
        ValueError: if the preset needs a task and none is known.
    """
    name, given, run = asked.run.preset, asked.data.task, asked.policies.run
    if name == "unit":
        given = _TASKS[name]
    elif run is not None:
        given = given or (finished_problem(run)["task"],)
    elif asked.data.dataset is None:
        given = given or _TASKS.get(name, ())
    if name == "paper" and not given:
        raise ValueError("--preset paper has hyper-parameters per task: add the --task")
    task = next(iter(given), "")
    changed = _with(PRIOR_SPACE_PRESETS[name], **_BY_TASK.get((name, task), {}))
    return _with(changed, data={"task": given})
