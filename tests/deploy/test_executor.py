"""A policy beside a control loop: against the same in simulation, on a fake clock, and in a real thread."""

import contextlib
import random
import threading
import time
import warnings
from concurrent.futures import CancelledError, Executor, Future

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import TransformedEnv

from tests.errors import raises, refuses
from tests.toy_env import ACTION_DIM, CountingEnv, Momentum, mlp_actor, stirred
from warmprior import (
    GaussianPrior,
    HistoryObservation,
    Normalizer,
    PastPrior,
    PreviewPrior,
    RealTimeChunking,
    keys,
    policy_transforms,
)
from warmprior.deploy import AsyncExecutor
from warmprior.diagnostics import executed_actions

OBSERVATION_DIM = 2 + ACTION_DIM


def actor(prior, width=0, **options):
    options |= {"observation_dim": OBSERVATION_DIM + width, "generator": torch.Generator().manual_seed(5)}
    return stirred(mlp_actor(prior, hidden_dim=16, nfe=3, clip=1.0, **options))


@pytest.mark.parametrize(("execute", "latency"), [(1, 0), (4, 0), (4, 2), (5, 1), (3, 3)])
@pytest.mark.parametrize("prior", [GaussianPrior(6), PastPrior(6), PreviewPrior(6), Momentum(6)], ids=str)
def test_a_simulated_latency_is_that_of_the_environment(prior, execute, latency):
    """Closed loop: the observations hold the last action, and the policy draws at every decision."""
    env = TransformedEnv(CountingEnv(23), policy_transforms(prior, execute=execute, delay=latency))
    policies = [actor(prior, guidance=RealTimeChunking()) for _ in range(2)]
    with torch.no_grad():
        expected = executed_actions(env.rollout(99, policies[0]))[0]
    robot, found = CountingEnv(23), []
    with AsyncExecutor(policies[1], execute=execute, latency=latency) as executor:
        for _ in range(2):
            data, actions = robot.reset(), []
            while not data["done"]:
                actions.append(executor.act(data["observation"]))
                data = robot.step(data.set("action", actions[-1]))["next"]
            found.append(torch.stack(actions))
            executor.reset()
        assert set(executor.delays) == {latency}
    torch.testing.assert_close(found[0], expected)
    assert not torch.equal(found[0], found[1])  # other noise


class Scripted(TensorDictModuleBase):
    """Action i of a chunk tells which step it was made at and which it is for; keeps what it was given."""

    def __init__(self, length):
        super().__init__()
        self.in_keys, self.out_keys = ["observation"], [("vla_action", "chunk")]
        self.length, self.given = length, []

    def forward(self, data):
        self.given.append(data.clone())
        step = data["observation"][-1, :1]
        target = step + torch.arange(self.length).view(-1, 1)
        return data.set(self.out_keys[0], torch.cat([step.expand_as(target), target], -1))


def running(policy, prior, **options):
    """An executor of a scripted policy that sees one observation."""
    policy.prior, policy.action_dim = prior, 2
    policy.observation_steps = options.pop("observation_steps", 1)
    return AsyncExecutor(policy, **options)


def test_a_module_of_ones_own_may_have_a_network_that_tells_nothing():
    policy = Scripted(4)
    policy.network = torch.nn.Linear(1, 1)
    with running(policy, GaussianPrior(4), latency=0, observation_steps=3) as executor:
        assert executor.act(torch.zeros(1)).shape == (2,)
    assert policy.given[0]["observation"].shape == (3, 1)


class FakeClock(Executor):
    """Computations that end so many ticks after they were begun; the first one ends at once."""

    def __init__(self, durations):
        self.durations, self.tick, self.running = [0, *durations], 0, []

    def submit(self, fn, /, *args, **kwargs):
        future = Future()
        duration = self.durations.pop(0)
        if duration == 0:
            future.set_result(fn(*args, **kwargs))
        else:
            self.running.append((self.tick + duration, future, fn, args))
        return future

    def advance(self):
        self.tick += 1
        for job in [job for job in self.running if job[0] <= self.tick]:
            self.running.remove(job)
            _, future, fn, args = job
            if future.cancelled():
                continue
            try:
                future.set_result(fn(*args))
            except Exception as error:
                future.set_exception(error)


def drive(executor, clock, ticks):
    actions = []
    for tick in range(ticks):
        actions.append(executor.act(torch.tensor([float(tick)])))
        clock.advance()
    return torch.stack(actions)


def test_measured_delays_on_a_fake_clock(monkeypatch):
    """P = 12, H = 6: decisions every 4 steps, or as soon as the last one took effect."""
    durations = [2, 1, 5, 1, 1, 1, 1]
    clock, policy = FakeClock(durations), Scripted(12)
    monkeypatch.setattr("warmprior.deploy.executor.RECENT", 3)
    executor = running(policy, PreviewPrior(6), execute=4, delay=1)
    executor._thread = clock
    actions = drive(executor, clock, 31)
    # Every action is the one for the step at which it is executed, whoever is late.
    assert actions[:, 1].tolist() == [float(i) for i in range(31)]
    # Begun at 4, 8, 12, at 17 as soon as the one of 12 took effect, 21, 25, 29.
    made = [0] * 6 + [4] * 3 + [8] * 8 + [12] * 1 + [17] * 4 + [21] * 4 + [25] * 4 + [29]
    assert actions[:, 0].tolist() == [float(i) for i in made]
    assert [int(data["observation"]) for data in policy.given] == [0, 4, 8, 12, 17, 21, 25, 29]
    assert executor.delays == (1, 1, 1)
    # What was expected: 1 until there was a measurement, then the largest of the last three.
    delays = [int(data["rtc", "delay"]) for data in policy.given]
    assert delays == [0, 1, 2, 2, 5, 5, 5, 1]
    for data in policy.given[1:]:
        step, left = float(data["observation"]), int(data["history", "forecast_steps"])
        expected = step + torch.arange(float(left))
        assert left >= 6 and data["history", "forecast"][:left, 1].tolist() == expected.tolist()
        assert not data["history", "forecast"][left:].any()


def recorded():
    data = {"observation": 3 * torch.rand(20, OBSERVATION_DIM) + 1, "action": 5 * torch.rand(20, 2) + 9}
    return TensorDict(data, [20])


def test_raw_units_and_last_actions_that_networks_see():
    raw = recorded()
    normalizer = Normalizer.fit(raw)
    prior, width = GaussianPrior(4), HistoryObservation.width(4, ACTION_DIM)
    inside, outside = (
        AsyncExecutor(
            actor(prior, width, observation_key=keys.CONDITIONED), execute=3, latency=1, normalizer=n
        )
        for n in (None, normalizer)
    )
    for i in range(9):
        row = raw[i]
        one = inside.act(normalizer.normalize(row)["observation"])
        two = outside.act(row["observation"])
        torch.testing.assert_close(normalizer.denormalize(TensorDict({"action": one}))["action"], two)


class Entries(Scripted):
    def forward(self, data):
        assert data["observation", "image"].shape == (2, 3, 4, 4)
        return super().forward(data.clone().set("observation", data["observation", "state"]))


def test_a_policy_that_does_not_say_what_it_sees_is_given_everything():
    executor = running(Entries(6), GaussianPrior(6), execute=3, latency=1, observation_steps=2)
    seen = TensorDict({"state": torch.tensor([7.0]), "image": torch.zeros(3, 4, 4).byte()})
    assert executor.act(seen).tolist() == [7.0, 7.0]


class Slow(Scripted):
    """Waits for leave from its second call on."""

    def __init__(self, length):
        super().__init__(length)
        self.leave, self.threads = threading.Event(), []

    def forward(self, data):
        self.threads.append(threading.current_thread())
        if len(self.threads) > 1:
            assert self.leave.wait(30)
        return super().forward(data)


def test_a_slow_policy_does_not_hold_the_loop_up():
    policy = Slow(8)
    executor = running(policy, PastPrior(8), execute=5, timeout=0.05)
    started = time.monotonic()
    for tick in range(8):  # decided at 5; three more steps are left of the first chunk
        assert executor.act(torch.tensor([float(tick)])).tolist() == [0.0, tick]
    assert time.monotonic() - started < 5  # it waited for nothing but the first chunk
    for _ in range(2):
        refuses(lambda: executor.act(torch.tensor([8.0])), TimeoutError, 3, "0.05")
    assert executor.delays == ()
    policy.leave.set()
    executor.timeout = 30.0
    assert executor.act(torch.tensor([8.0])).tolist() == [5.0, 8.0]
    assert executor.delays == (3,)
    assert policy.threads[0] is policy.threads[1] is not threading.current_thread()
    executor.close()
    assert not policy.threads[0].is_alive()
    refuses(lambda: executor.act(torch.zeros(1)), RuntimeError, "closed")


class Failing(Scripted):
    def __init__(self, length, fails):
        super().__init__(length)
        self.fails, self.decisions, self.interruption = fails, 0, None

    def forward(self, data):
        if self.interruption is not None:
            raise self.interruption
        self.decisions += 1
        if self.decisions - 1 in self.fails:
            raise ZeroDivisionError("the camera fell off")
        return super().forward(data)


def failing(fails, latency):
    policy = Failing(8, fails)
    return policy, running(policy, GaussianPrior(8), execute=4, timeout=30.0, latency=latency)


def test_a_decision_that_fails_is_tried_again_while_actions_are_left():
    policy, executor = failing({1, 2}, latency=1)
    with pytest.warns(UserWarning, match=r"camera.*\b4 actions"):
        found = [executor.act(torch.tensor([float(tick)])) for tick in range(12)]
    # Which decision an action is of, and for which step: those of the steps 4 and 5 failed.
    assert [action[1].item() for action in found] == list(range(12))
    assert [action[0].item() for action in found] == [0.0] * 7 + [6.0] * 4 + [10.0]
    last = policy.given[1]["history"]
    assert last["actions"][-6:].tolist() == [[0.0, float(tick)] for tick in range(6)]
    assert int(last["forecast_steps"]) == 2 and last["forecast"][:2, 1].tolist() == [6.0, 7.0]
    assert not last["forecast"][2:].any()


@pytest.mark.filterwarnings("ignore:a decision failed")
@pytest.mark.parametrize("latency", [None, 1])
def test_an_error_reaches_the_loop_once_no_action_is_left(latency):
    policy, executor = failing(range(1, 99), latency)
    with executor:
        for tick in range(8):
            assert executor.act(torch.tensor([float(tick)]))[1] == tick
        for _ in range(3):
            refuses(lambda: executor.act(torch.tensor([8.0])), ZeroDivisionError, "camera")
        policy.fails = ()
        while True:  # in a thread, the last call may still have failed
            with contextlib.suppress(ZeroDivisionError):
                assert executor.act(torch.tensor([9.0]))[0] == 9.0
                return


@pytest.mark.parametrize("interruption", [SystemExit, KeyboardInterrupt])
def test_an_interruption_in_the_thread_is_raised_once(interruption):
    """Also while actions are left; afterwards the robot goes on."""
    policy, executor = failing((), None)
    with executor:
        for tick in range(4):
            executor.act(torch.tensor([float(tick)]))
        policy.interruption = interruption
        raised = 0
        for tick in range(4, 30):
            try:
                executor.act(torch.tensor([float(tick)]))
            except interruption:
                raised += 1
                policy.interruption = None
        assert raised == 1


def test_a_reset_forgets_what_is_under_way():
    policy = Slow(8)
    with running(policy, GaussianPrior(8), execute=4) as executor:
        for tick in range(6):
            executor.act(torch.tensor([float(tick)]))
        executor.reset()
        policy.leave.set()
        assert executor.act(torch.tensor([100.0])).tolist() == [100.0, 100.0]
        assert executor.act(torch.tensor([101.0])).tolist() == [100.0, 101.0]
        last = policy.given[-1]
        assert not any(value.any() for value in last["history"].values())
        assert int(last["rtc", "delay"]) == 0


def test_a_loop_in_inference_mode_has_guided_chunks():
    """The thread is not in that mode, and gradients need tensors that were not made in it."""
    found = []
    for mode in (torch.inference_mode, torch.no_grad):
        guided = actor(PastPrior(6), guidance=RealTimeChunking())
        with AsyncExecutor(guided, execute=4, timeout=None) as executor, mode():
            found.append(executor.act(torch.zeros(OBSERVATION_DIM)))
            for _ in range(12):
                executor.act(torch.zeros(OBSERVATION_DIM))
    assert torch.equal(*found)


def test_chunks_that_no_robot_should_get():
    class Wrong(Scripted):
        def forward(self, data):
            return data.set(self.out_keys[0], torch.full((self.length, 2), torch.nan))

    for policy, error, fact in ((Wrong(8), FloatingPointError, "NaN"), (Scripted(7), ValueError, "[7, 2]")):
        with raises(error, fact):
            running(policy, GaussianPrior(8), execute=4, latency=1).act(torch.zeros(1))


@pytest.mark.parametrize(
    ("options", "facts"),
    [
        *(({"execute": 6, "delay": 3}, (8, 6, 3, 5)), ({"latency": 5}, (5, 8, 4))),
        *(({"latency": 1.5}, ("latency", 1.5)), ({"execute": 2.5}, ("execute", 2.5))),
        ({"prior": None}, ("Scripted", "prior", "action_dim")),
        ({"observation_steps": 0}, ("observation_steps", 0)),
        *(
            ({"delay": 0.06}, (0.06, "control_rate")),
            ({"delay": float("nan"), "control_rate": 20}, ("delay",)),
        ),
        ({"delay": 0.06, "control_rate": 0}, ("control_rate", 0)),
        ({"control_rate": -5}, ("control_rate",)),
        *(({"latency": "1"}, ("latency",)), ({"execute": "2"}, ("execute",))),
        *(({"delay": float("inf")}, ("delay",)), ({"timeout": "0.1"}, ("timeout",))),
        ({"delay": 1.0, "control_rate": 50}, ("delay", 50)),
    ],
)
def test_options_that_cannot_be(options, facts):
    refuses(lambda: running(Scripted(8), **{"prior": GaussianPrior(8)} | options), ValueError, *facts)
    assert not [t for t in threading.enumerate() if t.name.startswith("warmprior-policy")]


class Passing(Future):
    """Waiting for it makes the time pass, unless that is not to take any."""

    def exception(self, timeout=None):
        while timeout != 0 and not self.done():
            self.clock.advance()
        return super().exception(0)


class RandomClock(FakeClock):
    """Decisions take any number of ticks, up to more than a chunk has; some fail, some are never begun."""

    def __init__(self, length, seed):
        super().__init__([])
        self.random, self.length = random.Random(seed), length

    def submit(self, fn, /, *args, **kwargs):
        fate, long = self.random.random(), self.random.random() < 0.1
        if fate < 0.02:
            raise RuntimeError("cannot schedule new futures after shutdown")
        future = Passing()
        future.clock = self
        if fate < 0.04:
            future.cancel()
            return future
        run = args if fate > 0.1 else (None,)  # which no policy can read
        duration = self.random.randint(0, 2 * self.length if long else 3)
        self.running.append((self.tick + duration, future, fn, run))
        return future


class Longer(PreviewPrior):
    """Remembers more than it predicts."""

    name = "longer-for-executors"
    history_length = 17


@pytest.mark.filterwarnings("ignore:a decision failed")
@pytest.mark.parametrize("prior", [GaussianPrior(8), PastPrior(8), PreviewPrior(8), Longer(6)], ids=str)
@pytest.mark.parametrize("count", [3_000, pytest.param(50_000, marks=pytest.mark.slow)])
def test_whatever_is_slow_late_or_fails(prior, count):
    """Actions and histories are of the steps that were executed; some calls wait, and some do not."""
    length, remembered = prior.prediction_length, prior.history_length
    policy, clock = Scripted(length), RandomClock(length, seed=0)
    executor = running(policy, prior, execute=5)
    executor._thread = clock
    done, errors, held, calls = [], 0, 0, 0
    while calls < count:
        calls += 1
        executor.timeout = 0.0 if calls // 1000 % 2 else None
        try:
            # The policy is shown how much was executed, which is where its chunk begins.
            action = executor.act(torch.tensor([float(len(done))]))
        except TimeoutError:
            held += 1
        except (RuntimeError, AttributeError, CancelledError):
            errors += 1
        else:
            assert action[1] == len(done)
            done.append(action)
        clock.advance()
        for given in policy.given if calls % 20 == 0 else ():
            now, history = int(given["observation"]), given["history"]
            last = done[max(0, now - remembered) : now]
            assert int(history["steps"]) == len(last)
            expected = torch.stack([torch.zeros(2)] * (remembered - len(last)) + last)
            assert torch.equal(history["actions"], expected)
            left = int(history["forecast_steps"])
            assert history["forecast"][:left, 1].tolist() == list(range(now, now + left))
            assert not history["forecast"][left:].any()
        policy.given.clear()
    assert len(done) > count / 2 and errors and held
    assert max(executor.delays) > 1


def test_several_threads_take_turns():
    found = []
    with running(Scripted(8), PreviewPrior(4), execute=3, timeout=None) as executor:

        def loop():
            for _ in range(100):
                action = executor.act(torch.zeros(1))
                found.append(action[1].item())
                executor.expected_delay  # noqa: B018

        threads = [threading.Thread(target=loop) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(60)
    assert len(found) == 400 and int(executor._history["steps"]) == 4


def test_the_policys_own_normaliser():
    raw = recorded()
    normalizer = Normalizer.fit(raw)
    own, given = (
        AsyncExecutor(actor(PastPrior(4), **options), execute=3, latency=1, normalizer=n)
        for options, n in (({"normalizer": normalizer}, None), ({}, normalizer))
    )
    for row in raw:
        action = own.act(row["observation"])
        assert torch.equal(action, given.act(row["observation"])) and action.min() > 5
    plain = actor(PastPrior(4), normalizer=normalizer).replace(normalizer=None)
    assert AsyncExecutor(plain, latency=0).act(raw[0]["observation"]).abs().max() <= 1
    with raises(ValueError, "'action'"):
        AsyncExecutor(plain, latency=0, normalizer=Normalizer.fit(raw, ("observation",)))


@pytest.mark.parametrize("assign", [False, True])
def test_statistics_that_are_loaded_between_two_episodes(assign):
    def bounds(high):
        numbers = {
            "observation": torch.full((OBSERVATION_DIM,), high),
            "action": torch.full((ACTION_DIM,), high),
        }
        return Normalizer({key: -value for key, value in numbers.items()}, numbers)

    policy, other = (mlp_actor(PastPrior(4), normalizer=bounds(high)) for high in (1.0, 9.0))
    raw, found = torch.ones(OBSERVATION_DIM), []
    with AsyncExecutor(policy, latency=0) as executor:
        executor.act(raw)
        policy.load_state_dict(other.state_dict(), assign=assign)
        executor.reset()
        for each in (executor, AsyncExecutor(policy, latency=0)):
            torch.manual_seed(0)
            found.append(each.act(raw))
    assert torch.equal(*found)


def test_a_delay_behind_what_is_guided():
    """Guidance refuses such delays: the robot goes on all the same."""
    guided = actor(PreviewPrior(6), guidance=RealTimeChunking(execution_horizon=2))
    clock = FakeClock([4, *[1] * 20])
    executor = AsyncExecutor(guided, execute=4)
    executor._thread = clock
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(40):
            executor.act(torch.zeros(OBSERVATION_DIM))
            clock.advance()
    assert 4 in executor.delays


@pytest.mark.parametrize(
    ("delay", "rate", "steps"), [(None, None, 1), (3, None, 3), (0.06, 50, 3), (0.061, 50, 4), (0.0, 20, 0)]
)
def test_delays_in_steps_or_seconds(delay, rate, steps):
    executor = AsyncExecutor(actor(PreviewPrior(8)), delay=delay, control_rate=rate)
    assert executor.expected_delay == steps
    past = AsyncExecutor(actor(PastPrior(8)), delay=delay, control_rate=rate)
    assert past.execute == 8 - steps  # what the prediction leaves
