from functools import partial

import pytest
import torch
from torchrl.data import Categorical, Unbounded
from torchrl.envs import RewardSum, SerialEnv, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from tests.errors import raises, refuses
from tests.toy_env import ACTION_DIM, PLACES, ChunkPolicy, CountingEnv, closing, placed
from warmprior import ChunkStep, PastPrior, policy_transforms
from warmprior.envs import NavigationEnv
from warmprior.evaluation import evaluate, parallel_env, play_episode
from warmprior.tasks import Play

H = 4
HOW = {"high": "max", "effort": "sum", "left": "last"}


def values(seed, t):
    """What the environment says after step ``t`` of the episode of a seed; it ends after some steps."""
    g = torch.Generator().manual_seed(100 * seed + t)
    high, effort = (2 * torch.rand(2, generator=g) - 3).tolist()  # below 0: no maximum is that of zeros
    return {"high": high, "effort": effort, "left": float(t), "won": t == 2 + seed % 3}


def length(seed):
    return 5 + seed % 4  # 5 to 8 steps: 7 or 5 end inside a chunk


class Saying(CountingEnv):
    """Says what :func:`values` has, whatever is done; what it says at the reset counts for nothing."""

    def __init__(self):
        super().__init__(length(0))
        for name in HOW:
            self.observation_spec[name] = Unbounded((1,))
        self.observation_spec["won"] = Categorical(2, dtype=torch.bool, shape=(1,))
        self.seed_ = 0

    def _set_seed(self, seed):
        self.seed_, self.length = seed, length(seed)

    def _seen(self, out):
        at_reset = {"high": 1e6, "effort": 1e6, "left": 1e6, "won": True}
        said = values(self.seed_, self.t) if self.t else at_reset
        return out.update({name: torch.tensor([value]) for name, value in said.items()})


def make_env(base=None, **options):
    transforms = policy_transforms(PastPrior(H), observation_steps=1, success="won", measures=HOW, **options)
    return TransformedEnv(Saying() if base is None else base, transforms)


POLICY = ChunkPolicy(lambda data: torch.zeros(*data.batch_size, H, ACTION_DIM))


def assert_by_hand(episode):
    said = [values(episode.seed, t) for t in range(1, length(episode.seed) + 1)]
    assert (episode.success, episode.steps) == (any(each["won"] for each in said), len(said))
    high, effort = max(each["high"] for each in said), sum(each["effort"] for each in said)
    measures = {"high": high, "effort": effort, "left": said[-1]["left"]}
    assert episode.measures == pytest.approx(measures, rel=1e-5)


@pytest.mark.parametrize("execute", [1, 3, 4])
def test_an_episode_combines_what_every_step_says(execute):
    env = make_env(execute=execute)
    for seed in range(4):
        assert_by_hand(play_episode(POLICY, env, seed, success="won", measures=HOW))


@pytest.mark.parametrize("n", [1, 2, 3])
def test_batched_episodes_are_those_played_alone(n):
    """Rows end inside chunks while others go on, and rest at the end."""
    options = {"episodes": 7, "first_seed": 20, "success": "won", "measures": HOW}
    for env in (SerialEnv(n, make_env), make_env(SerialEnv(n, Saying))):
        episodes = evaluate(POLICY, env, **options)
        assert [episode.seed for episode in episodes] == list(range(20, 27))
        for episode in episodes:
            assert_by_hand(episode)


def test_keys_that_are_not_there_are_named():
    env = make_env()
    for options in ({"success": "solved"}, {"success": "won", "measures": {"height": "max"}}):
        with raises(KeyError, *([options["success"]] if len(options) == 1 else options["measures"])):
            play_episode(POLICY, env, 0, **options)


def test_another_way_to_combine_values_is_refused():
    measures, env = {"high": "mean"}, make_env(execute=1)
    play = partial(Play, Saying)
    for use in (partial(ChunkStep, H), play, partial(play_episode, POLICY, env, 0, success="won")):
        with raises(ValueError, "'high'", "max, sum, last", "'mean'"):
            use(measures=measures)


@pytest.mark.parametrize("batched", [False, True])
def test_what_a_chunk_would_hide_from_an_episode_is_refused(batched):
    """Such as a success at the second of four steps, or the largest reward of a single step."""
    for options, asked, fact in (
        ({}, {"success": "won"}, "won"),
        ({"success": "won"}, {"success": "won", "measures": {"high": "max"}}, "high"),
        ({"success": "won", "measures": HOW}, {"success": "won", "measures": {"high": "last"}}, "high"),
        ({"success": "won"}, {"success": "won", "measures": {"reward": "max"}}, "reward"),
        ({"success": "won", "gamma": 0.9}, {"success": "won", "measures": {"reward": "sum"}}, "discounted"),
    ):
        base = SerialEnv(2, Saying) if batched else Saying()
        whole = policy_transforms(PastPrior(H), observation_steps=1, **options)
        with raises(ValueError, fact, "policy_transforms"):
            evaluate(POLICY, TransformedEnv(base, whole), episodes=2, first_seed=0, **asked)
        # Nothing is hidden from an episode that reads every step.
        single = policy_transforms(PastPrior(H), observation_steps=1, execute=1, **options)
        base = SerialEnv(2, Saying) if batched else Saying()
        evaluate(POLICY, TransformedEnv(base, single), episodes=2, first_seed=0, **asked)


def test_chunks_inside_of_numbered_workers_are_looked_at_too():
    env = parallel_env(Saying, partial(policy_transforms, PastPrior(H)), 2)
    with closing(env), raises(ValueError, "won", "policy_transforms"):
        evaluate(POLICY, env, episodes=2, first_seed=0, success="won")


def test_a_fraction_is_no_success():
    for env in (make_env(execute=1), make_env(SerialEnv(2, Saying), execute=1)):
        with raises(ValueError, "'high'", "measures"):
            evaluate(POLICY, env, episodes=2, first_seed=0, success="high")


@pytest.mark.parametrize("options", [{}, {"measures": {"reward": "sum"}}])
def test_a_reward_may_be_summed(options):
    measures = {"reward": "sum"}  # the toy pays t at step t
    env = TransformedEnv(
        Saying(), policy_transforms(PastPrior(H), observation_steps=1, success="won", **options)
    )
    for episode in evaluate(POLICY, env, episodes=3, first_seed=0, success="won", measures=measures):
        assert episode.measures["reward"] == sum(range(1, length(episode.seed) + 1))


def test_a_reward_may_say_success():
    class Paying(Saying):
        def _step(self, tensordict):
            result = super()._step(tensordict)
            return result.set("reward", (result["reward"] >= 6).float())  # up to three times in a chunk

    env = TransformedEnv(Paying(), policy_transforms(PastPrior(H), observation_steps=1, success="reward"))
    for episode in evaluate(POLICY, env, episodes=4, first_seed=0, success="reward"):
        assert episode.success == (length(episode.seed) >= 6)


def test_a_flag_of_success_may_be_counted_too():
    """Over the steps of a chunk, of which the last must not say yet that any succeeded."""
    measures = {"won": "sum"}
    transforms = policy_transforms(PastPrior(H), observation_steps=1, success="won", measures=measures)
    env = TransformedEnv(SerialEnv(2, Saying), transforms)
    for episode in evaluate(POLICY, env, episodes=5, first_seed=0, success="won", measures=measures):
        said = [values(episode.seed, t)["won"] for t in range(1, length(episode.seed) + 1)]
        assert (episode.measures["won"], episode.success) == (sum(said), any(said))


def test_what_tells_of_whole_decisions_may_be_combined_in_any_way():
    """And a success is the largest of its flags."""
    measures = {"step_count": "max", "episode_reward": "max", "executed_steps": "sum", "won": "max"}
    env = make_env().append_transform(StepCounter()).append_transform(RewardSum())
    steps, said = length(1), play_episode(POLICY, env, 1, success="won", measures=measures)
    assert said.measures == {
        "step_count": 2, "episode_reward": steps * (steps + 1) / 2, "executed_steps": steps, "won": 1
    }  # fmt: skip
    measures = {"executed_steps": "sum", "won": "max"}
    transforms = partial(policy_transforms, PastPrior(H), observation_steps=1, success="won")
    with closing(parallel_env(Saying, transforms, 1)) as env:
        (said,) = evaluate(POLICY, env, episodes=1, first_seed=1, success="won", measures=measures)
    assert said.measures == {"executed_steps": steps, "won": 1}


class Touching(Saying):
    """Counts contacts at every step, in a type that is too small for their sum."""

    def __init__(self, dtype):
        super().__init__()
        self.dtype_ = dtype
        self.observation_spec["contacts"] = Unbounded((1,), dtype=dtype)

    def _seen(self, out):
        contacts = 1 if self.dtype_ == torch.bool else 100
        return super()._seen(out).set("contacts", torch.tensor([contacts]).to(self.dtype_))


@pytest.mark.parametrize("dtype", [torch.bool, torch.uint8, torch.int32, torch.float64])
@pytest.mark.parametrize("place", PLACES)
def test_sums_do_not_stay_in_the_type_of_their_terms(place, dtype):
    measures, each = {"contacts": "sum"}, 1 if dtype == torch.bool else 100

    def transforms():
        return policy_transforms(PastPrior(H), observation_steps=1, success="won", measures=measures)

    with closing(placed(place, transforms, (1, 1), lambda length: Touching(dtype))) as env:
        check_env_specs(env)
        played = evaluate(POLICY, env, episodes=3, first_seed=0, success="won", measures=measures)
        for episode in played:
            assert episode.measures["contacts"] == each * length(episode.seed)


@pytest.mark.parametrize("dtype", [torch.float32, torch.int64])
def test_a_success_keeps_its_type(dtype):
    class Telling(Saying):
        def __init__(self):
            super().__init__()
            self.observation_spec["won"] = Unbounded((1,), dtype=dtype)

        def _seen(self, out):
            said = super()._seen(out)
            return said.set("won", said["won"].to(dtype))

    env = make_env(Telling())
    check_env_specs(env)
    assert_by_hand(play_episode(POLICY, env, 0, success="won", measures=HOW))


def test_states_of_an_environment_are_no_measures():
    """A chunk would leave its largest height where the next step reads the last one."""
    transforms = policy_transforms(PastPrior(H), observation_steps=1, measures={"height": "max"})
    refuses(lambda: TransformedEnv(NavigationEnv(), transforms).reset(), ValueError, "height", "another key")
