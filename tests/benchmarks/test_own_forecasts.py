import json

import own_forecasts
import pytest
import torch

from warmprior import GaussianPrior, Normalizer, VelocityMLP, WarmPriorActor
from warmprior.data import open_demonstrations
from warmprior.saving import save_policy

H = 4
SEEN = ["robot0_eef_pos", "object"]


def test_errors_of_demonstrations_seen_and_held_out(dataset, tmp_path, capsys):
    """The mean of the Gaussian source is 0, so its error is the size of the actions after the first H."""
    steps = open_demonstrations(dataset).steps(SEEN)
    normalizer = Normalizer.fit(steps)
    seen = steps["observation"].shape[-1]
    network = VelocityMLP(steps["action"].shape[-1], seen, H, observation_steps=2)
    save_policy(WarmPriorActor(network, GaussianPrior(H), normalizer=normalizer), tmp_path / "policy")
    out = tmp_path / "rows.jsonl"
    argv = [str(tmp_path / "policy"), "--dataset", str(dataset), "--observations", *SEEN]
    assert own_forecasts.main([*argv, "--demonstrations", "2", "--rows", str(out)]) == 0
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    assert [(row["demonstrations"], row["nfe"]) for row in rows] == [
        *(("trained on", nfe) for nfe in (9, 1)),
        *(("held out", nfe) for nfe in (9, 1)),
    ]
    actions = normalizer.normalize(steps)["action"]
    number = steps["episode"]
    for row, part in zip(rows[::2], (number < number.unique()[2], number == number.unique()[2]), strict=True):
        for k in range(H):
            after = [a[H + k :] for a in (actions[part & (number == n)] for n in number.unique()) if len(a)]
            assert row["mean_error"][k] == pytest.approx(float(torch.cat(after).square().mean().sqrt()))
    assert "held out" in capsys.readouterr().out
