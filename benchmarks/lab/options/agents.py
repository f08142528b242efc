"""Options of agents in source space, and the arms of their comparison."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, asdict, dataclass, field, fields, make_dataclass
from itertools import product
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_type_hints

import tyro

from lab.demonstrations.data_options import check_counts
from lab.options.options import FinishedRun, Options, check_given, check_single
from warmprior.options.agent import NUM_ENVS, Algorithm, PriorSpaceConfig

if TYPE_CHECKING:
    from lab.methods.methods import Method
    from warmprior import WarmPriorActor

TOY = "navigation"

# The recipe of an agent, without the options that all benchmarks share. On the command line its options have
# the prefix rl, because --learning-rate and the like are those of behaviour cloning.
HINTS = get_type_hints(PriorSpaceConfig)
SHARED = ("algorithm", "seed", "nfe", "evaluation_episodes", "delta")
AgentOptions: Any = make_dataclass(
    "AgentOptions",
    [
        (f.name, HINTS[f.name], field(default=f.default))
        for f in fields(PriorSpaceConfig)
        if f.name not in SHARED and f.default is not MISSING
    ],
    frozen=True,
    namespace={"__doc__": str(PriorSpaceConfig.__doc__).replace("``", "")},
)


@dataclass(frozen=True)
class Arm:
    """An arm is an algorithm and a box, applied to the frozen policies of a method."""

    method: Method
    algorithm: str
    centre: str  # centre of the box: the source's mean, or zero
    delta: float | None  # half the side of the box

    def __post_init__(self) -> None:
        if self.centre == "zero" and self.method.has_anchor:
            prior = self.method.prior()
            if self.method.parts.start is not None or prior.history_length != prior.chunk_length:
                raise ValueError(f"--centre zero: {self.method.name} has a centre of its own, leave it out")

    def __str__(self) -> str:
        value = self.method.arguments.get("sigma")
        sigma = "" if value is None else f"sigma={value:g}"
        source = ",".join(filter(None, (self.method.name, sigma, self.method.options)))
        around = " around zero" if self.centre == "zero" and self.method.has_anchor else ""
        box = "" if self.delta is None else f", delta {self.delta:g}"
        return f"{self.algorithm} {source}{around}{box}"

    def policy(self, actor: WarmPriorActor) -> WarmPriorActor:
        """Return the policy for the agent; around zero it has a cold source and the same field."""
        from lab.methods.methods import ColdPrior

        if self.centre == "mean" or not self.method.has_anchor:
            return actor
        return actor.replace(prior=ColdPrior(actor.prior.chunk_length, actor.prior.prediction_chunks))


@dataclass(frozen=True)
class AgentsOptions(Options):
    """Options of a comparison of agents that act through the policies of a comparison of sources."""

    policies: FinishedRun = None  # folder of a finished run whose policies to use (default: train them)
    rl: Annotated[AgentOptions, tyro.conf.arg(name="rl")] = field(default_factory=AgentOptions)
    algorithm: tuple[Algorithm, ...] = ("dsrl-na",)  # algorithms of the agents
    warm_algorithm: tuple[Algorithm, ...] = ()  # algorithms for warm sources (default: as --algorithm)
    # for warm sources, centre of the search: the source's mean, zero as a control, or both
    centre: tuple[Literal["mean", "zero"], ...] = ("mean",)
    delta: tuple[float, ...] = ()  # half widths of the agents' boxes (default: 0.5 around a mean, else 1.5)
    num_envs: int = NUM_ENVS  # number of parallel environments per agent
    # number of Ray actors that collect, with --num-envs environments each; needs --engine ray (default: none)
    collectors: int | None = None

    @property
    def is_toy(self) -> bool:
        return self.data.task == (TOY,)

    @property
    def name(self) -> str:
        return TOY if self.is_toy else super().name

    def check(self) -> None:
        check_counts(self, "num_envs", "collectors")
        if self.collectors is not None and self.collectors > 10:  # more would share seeds with other runs
            raise ValueError(f"--collectors must be at most 10, got {self.collectors}")
        if self.is_toy != (self.preset == "unit"):
            raise ValueError(f"--task {TOY} and --preset unit belong together")
        check_single(self, "task", "style", "chunk", "sigma", "nfe")
        check_given(self, "algorithm", "centre")
        if self.evaluation.temperature != (1.0,):
            raise ValueError("agents choose the noise themselves: leave out --temperature")
        if self.is_toy and (self.data.horizon is not None or self.evaluation.play_on):
            raise ValueError("episodes of the toy have one length: leave out --horizon and --play-on")
        if self.collectors is not None and self.run.engine != "ray":
            raise ValueError("--collectors belongs to --engine ray")
        super().check()
        for method in self.sources.methods():
            if not method.is_flow:
                raise ValueError(
                    f"--prior {method.name} is no flow and has no source space to act in: leave it out"
                )
            for arm in self.arms(method):
                self.agent(arm, 0)

    def arms(self, method: Method) -> list[Arm]:
        """Return the arms of a method."""
        centres = self.centre if method.has_anchor else ("zero",)
        algorithms = self.warm_algorithm if method.has_anchor else ()
        parts = product(algorithms or self.algorithm, centres, self.delta or (None,))
        return [Arm(method, *part) for part in parts]

    def agent(self, arm: Arm, seed: int) -> PriorSpaceConfig:
        shared: Mapping[str, Any] = asdict(self.rl)
        options_of_arm: dict[str, Any] = {
            "algorithm": arm.algorithm,
            "seed": seed,
            "nfe": self.evaluation.nfe[0],
            "evaluation_episodes": self.evaluation.episodes,
            "backup_entropy": shared["backup_entropy"] or arm.algorithm == "dsrl-sac",
            "delta": arm.delta,
        }
        return PriorSpaceConfig(**{**shared, **options_of_arm})
