"""An exported decision: against the policy that it was exported from."""

import json
import random

import pytest
import torch
from tensordict import TensorDict

from tests.errors import raises, refuses
from tests.toy_env import mlp_actor, stirred
from warmprior import (
    CVAEPrior,
    GaussianPrior,
    HistoryObservation,
    Normalizer,
    PastPrior,
    PreviewPrior,
    RealTimeChunking,
)
from warmprior.__main__ import main
from warmprior.deploy import AsyncExecutor, export_policy, load_exported
from warmprior.envs import navigation_demonstrations
from warmprior.history import advance, cold_history
from warmprior.saving import save_policy
from warmprior.training import NetworkOptions, TrainingConfig, train_policy

D_O, D_A = 3, 2


def policy(prior, **options):
    steps = {"observation": 5 * torch.rand(30, D_O), "action": 3 * torch.rand(30, D_A)}
    options = {"normalizer": Normalizer.fit(TensorDict(steps, [30])), "nfe": 2, "hidden_dim": 8, **options}
    return stirred(mlp_actor(prior, observation_dim=D_O, action_dim=D_A, **options)).eval()


def decisions(prior, width=D_O, steps=2, dim=D_A):
    """Return a cold decision, one in the middle of a chunk, and a warm one."""
    g = torch.Generator().manual_seed(1)
    history = cold_history([], prior.history_length, prior.prediction_length, dim)
    for executed in (0, 2, prior.chunk_length):
        chunk = torch.randn(prior.prediction_length, dim, generator=g)
        history = advance(history, chunk, torch.tensor([executed]))
        yield TensorDict({"observation": torch.randn(steps, width, generator=g), "history": history})


def chunks(actor, datas):
    g = torch.Generator().manual_seed(4)
    with torch.no_grad():
        return torch.stack([actor(data.clone(), generator=g)["vla_action", "chunk"] for data in datas])


@pytest.fixture
def uncompiled(monkeypatch):
    """Let the exported graph itself stand for the native code, which a compiler takes seconds to make."""
    monkeypatch.setattr(
        torch._inductor,
        "aoti_compile_and_package",
        lambda program, package_path: torch.export.save(program, package_path),
    )

    def load(path):
        module = torch.export.load(path).module()
        return lambda *inputs: module(*inputs)

    monkeypatch.setattr(torch._inductor, "aoti_load_package", load)


PRIORS = [
    GaussianPrior(4),
    PastPrior(4),
    PastPrior(4, correlation=0.5),
    PreviewPrior(4, sigma=0.3),
]


@pytest.mark.parametrize(
    ("prior", "options"),
    [*((prior, {}) for prior in PRIORS), (PRIORS[1], {"solver": "heun", "clip": 1.5, "temperature": 0.0})],
    ids=str,
)
def test_an_exported_policy_draws_and_decides_like_the_policy(prior, options, uncompiled, tmp_path):
    own, nfe = (2, 4) if options else (1, 2)  # two steps: those of Heun evaluate twice
    actor = policy(prior, nfe=own, **options)
    exported = load_exported(export_policy(actor, tmp_path / "policy.pt2", nfe=nfe))
    expected = chunks(actor.replace(nfe=nfe), decisions(prior))
    torch.testing.assert_close(chunks(exported, decisions(prior)), expected)
    assert expected.std(0).min() > 0


def test_an_executor_runs_it_in_place_of_the_policy(uncompiled, tmp_path):
    actor = policy(PastPrior(4))
    exported = load_exported(export_policy(actor, tmp_path / "policy.pt2"))
    runs = []
    for one in (actor, exported):
        torch.manual_seed(0)
        with AsyncExecutor(one, execute=3, latency=1) as executor:
            runs.append(torch.stack([executor.act(torch.full((D_O,), float(i % 5))) for i in range(11)]))
    torch.testing.assert_close(runs[1], runs[0])
    with AsyncExecutor(exported, latency=0) as executor, raises(ValueError, "state", 3, 4):
        executor.act(torch.zeros(4))


def test_a_policy_that_sees_the_history_and_a_learned_source_are_exported_too(uncompiled, tmp_path):
    prior = PastPrior(2)
    width = D_O + HistoryObservation.width(2, D_A)
    actor = stirred(
        mlp_actor(
            prior,
            observation_dim=width,
            action_dim=D_A,
            hidden_dim=8,
            observation_key=("prior", "observation"),
        )
    ).eval()
    datas = [HistoryObservation()(data) for data in decisions(prior)]
    exported = load_exported(export_policy(actor, tmp_path / "seen.pt2"))
    assert exported.shapes == {"state": (D_O,)}
    torch.testing.assert_close(chunks(exported, datas), chunks(actor, datas))

    few = {"training": TrainingConfig(iterations=4), "network": NetworkOptions("mlp,hidden_dim=8")}
    learnt = train_policy(navigation_demonstrations(), CVAEPrior(4), **few, description=None).replace(nfe=2)
    exported = load_exported(export_policy(learnt, tmp_path / "cvae.pt2"))
    datas = list(decisions(learnt.prior, 9, dim=1))
    torch.testing.assert_close(chunks(exported, datas), chunks(learnt, datas))


def test_what_cannot_be_exported_is_refused_in_one_sentence(uncompiled, tmp_path):
    class Uniform(PastPrior):
        name = "uniform-of-the-exported"

        def distribution(self, history, observation=None):
            source = super().distribution(history)
            return type(source)(source.loc + random.random(), source.scale, source.warm)

    class Branching(PastPrior):
        name = "branching-of-the-exported"

        def mean(self, history):
            loc, warm = super().mean(history)
            return (2 * loc if int(history["steps"]) > 2 else loc), warm

    path = tmp_path / "policy.pt2"
    with raises(ValueError, "Real-Time Chunking"):
        export_policy(policy(PastPrior(4), guidance=RealTimeChunking()), path)
    refuses(lambda: export_policy(policy(Uniform(4)), path), ValueError, "torch.randn")
    refuses(lambda: export_policy(policy(Branching(4)), path), ValueError, "Branching")
    save_policy(policy(PastPrior(4)), tmp_path)
    refuses(lambda: export_policy(policy(PastPrior(4)), tmp_path / "config.pt2"), ValueError, "config.json")
    assert not path.exists()


def test_a_file_for_another_machine_or_of_other_code_is_not_loaded(uncompiled, tmp_path, monkeypatch):
    path = export_policy(policy(PastPrior(4)), tmp_path / "policy.pt2")
    loaded = []
    monkeypatch.setattr(torch._inductor, "aoti_load_package", loaded.append)
    description = json.loads(path.with_suffix(".json").read_text())
    for change, *facts in (
        ({"processor": "riscv64 toy DEFAULT"}, "riscv64 toy DEFAULT", "export on the robot"),
        ({"torch": "1.0"}, "torch 1.0", "export on the robot"),
        ({"program": "0" * 64}, "policy.pt2", "policy.json"),
    ):
        path.with_suffix(".json").write_text(json.dumps(description | change))
        refuses(lambda: load_exported(path), ValueError, *facts)
    for damaged, fact in (([], "policy.json"), ({"program": "0"}, "inputs")):
        path.with_suffix(".json").write_text(json.dumps(damaged))
        refuses(lambda: load_exported(path), ValueError, fact, "export")
    path.with_suffix(".json").unlink()
    refuses(lambda: load_exported(path), FileNotFoundError, "policy.json")
    assert not loaded


def test_the_command_exports_a_saved_policy(uncompiled, tmp_path, capsys):
    save_policy(policy(PastPrior(4)), tmp_path / "saved")
    assert main(["export", str(tmp_path / "saved"), str(tmp_path / "policy.pt2"), "--nfe", "1"]) == 0
    assert "load_exported" in capsys.readouterr().out
    assert json.loads((tmp_path / "policy.json").read_text())["nfe"] == 1


@pytest.mark.slow
@pytest.mark.parametrize("prior", PRIORS, ids=str)
def test_native_code_decides_like_the_policy(prior, tmp_path):
    actor = policy(prior, hidden_dim=64, nfe=3)
    exported = load_exported(export_policy(actor, tmp_path / "policy.pt2"))
    found, expected = chunks(exported, decisions(prior)), chunks(actor, decisions(prior))
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-5)


def test_entries_are_checked_and_cast_before_native_code_reads_them(uncompiled, tmp_path):
    """The exported graph checks them itself, so the stand-in here takes anything, as native code does."""
    actor = policy(PastPrior(4)).train()
    exported = load_exported(export_policy(actor, tmp_path / "policy.pt2"))
    assert actor.network.training  # the caller's policy is as before
    data, given = next(decisions(actor.prior)), []
    exported._run = lambda *inputs: given.extend(inputs) or torch.zeros(4, D_A)
    wide = data.clone().set("observation", data["observation"].double().T.contiguous().T)
    exported(wide)
    assert all(value.is_contiguous() for value in given)
    assert [value.dtype for value in given if value.is_floating_point()] == [torch.float32] * 4
    torch.testing.assert_close(given[0], data["observation"])
    for wrong in (torch.zeros(1, D_O), torch.zeros(2, D_O - 1)):
        with raises(ValueError, "observation", D_O, 2):
            exported(data.clone().set("observation", wrong))


def test_torch_export_takes_a_policy_and_its_entries_as_keywords():
    """As TorchRL's tutorial on export does with its own actors."""
    actor = policy(PastPrior(4), temperature=0.0)
    data = list(decisions(actor.prior))[-1]
    entries = {"observation": data["observation"], **{f"history_{k}": v for k, v in data["history"].items()}}
    with torch.no_grad():
        program = torch.export.export(actor, args=(), kwargs=entries, strict=False)
        *_, expected = actor(**entries)
    torch.testing.assert_close(program.module()(**entries)[-1], expected)
    refuses(lambda: actor(**entries, observations=1), TypeError, "observations", "observation")
