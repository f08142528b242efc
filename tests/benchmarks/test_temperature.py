from itertools import product

import robomimic

from tests.benchmarks.drift import arguments, task
from tests.benchmarks.script_parts import refused, stored
from warmprior.envs.tasks import EVALUATION_SEED
from warmprior.training import load_policy, play_episode


def test_temperatures_are_played_with_one_training(tmp_path, capfd):
    out = tmp_path / "runs" / "out"
    argv = arguments(out, prior=["gaussian", "past"], nfe=1, seeds=1, checkpoints=1, temperature=[1, 0])
    assert robomimic.main(argv) == 0
    rows = stored(out)
    cells = [(row["prior"], row["temperature"]) for row in rows]
    assert cells == list(product(("gaussian", "past"), (1.0, 0.0)))
    assert len({row["policy"] for row in rows}) == 2
    drift = task(None)
    for row in rows:
        policy = load_policy(out.parent / "policies" / row["policy"] / "policy_000020")
        policy = policy.replace(temperature=row["temperature"])
        env, said = drift.env(policy), {"success": drift.success, "measures": drift.measures}
        seeds = range(EVALUATION_SEED, EVALUATION_SEED + 7)
        won = [play_episode(policy, env, seed, nfe=1, policy_seed=0, **said).success for seed in seeds]
        assert row["outcomes"] == "".join("01"[one] for one in won)
    assert "noise x 0" in (out / "report.md").read_text()
    assert "temperature" in refused(robomimic.main, arguments(tmp_path / "two", temperature=-1), capfd)
