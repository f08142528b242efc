import importlib
import pickle

import torch

from lab.methods.bridge import BridgeCoupling
from lab.methods.methods import METHODS, Method
from tests.errors import raises
from warmprior import OTCoupling, ReflowCoupling, VelocityMLP, WarmPriorActor
from warmprior.history import cold_history
from warmprior.training import TrainingConfig

H = 3


def test_methods_are_equal_if_and_only_if_they_do_the_same():
    for one, two in (
        (("past", H), ("past,correlation=0.0,sigma=0.5", H)),
        (("past,sigma=0.3", H), ("past", H, 0.3)),
        (("gaussian", H), ("gaussian", H, 0.3)),  # --sigma belongs to those that take it
        (("past,sigma=1", H), ("past", H, 1.0)),
        (("step,stall=1,start_time=0.7", H), ("step,start_time=0.7,stall=1", H)),
    ):
        first, second = Method(*one), Method(*two)
        assert first == second and hash(first) == hash(second) and first.config() == second.config()
    past = Method("past", H)
    for other in (("past", H + 1), ("past", H, 0.3), ("past,correlation=0.5", H), ("preview", H)):
        assert Method(*other) != past and Method(*other).config() != past.config()


def test_a_prior_of_ones_own_is_another_once_it_is_edited(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    file = tmp_path / "edited_prior.py"
    code = "from warmprior import PastPrior\nclass Mine(PastPrior):\n    name = 'mine'\n"
    file.write_text(code)
    one, same = (Method("edited_prior:Mine", H).config() for _ in range(2))
    (tmp_path / "built_on_it.py").write_text(
        "import edited_prior\nclass More(edited_prior.Mine):\n    name = 'more'\n"
    )
    (tmp_path / "helped_by_it.py").write_text(
        "from warmprior import PastPrior\nfrom numbers_of_mine import gain\n"
        "class Helped(PastPrior):\n    name = 'helped'\n"
        "    def mean(self, history):\n        loc, warm = super().mean(history)\n"
        "        return gain() * loc, warm\n"
    )
    (tmp_path / "numbers_of_mine.py").write_text(
        "import torch\nimport edited_prior as my\ndef gain():\n    return my.Mine.default_sigma\n"
    )
    others = ("built_on_it:More", "helped_by_it:Helped")
    before = [Method(name, H).config() for name in others]
    file.write_text(code + "    default_sigma = 0.05\n")
    assert one == same != Method("edited_prior:Mine", H).config()
    after = [Method(name, H).config() for name in others]
    assert all(old != new for old, new in zip(before, after, strict=True))


def test_what_else_is_imported_from_a_package_makes_no_other_prior(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "parts_of_mine").mkdir()
    for name in ("__init__", "helpers", "tasks"):
        (tmp_path / "parts_of_mine" / f"{name}.py").touch()
    (tmp_path / "parts_of_mine" / "priors.py").write_text(
        "import parts_of_mine.helpers\nfrom warmprior import PastPrior\n"
        "class Packed(PastPrior):\n    name = 'packed'\n"
    )
    before = Method("parts_of_mine.priors:Packed", H).config()
    importlib.import_module("parts_of_mine.tasks")
    assert Method("parts_of_mine.priors:Packed", H).config() == before


def test_a_prior_of_ones_own_may_build_on_classes_without_a_source(tmp_path, monkeypatch):
    """Python writes some in C, and packages compile others."""
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "built_on_c.py").write_text(
        "from _thread import _local\nfrom warmprior import PastPrior\nimport numpy.random\n"
        "class Local(PastPrior, _local):\n    name = 'local'\n"
        "class Random(PastPrior, numpy.random.BitGenerator):\n    name = 'random'\n"
        "    def __init__(self, chunk_length):\n        super().__init__(chunk_length)\n"
    )
    for name in ("Local", "Random"):
        assert Method(f"built_on_c:{name}", H).config()["code"]


def test_a_temperature_that_is_named_twice_is_played_once():
    assert Method("past", H).temperatures((1.0, 0.5, 1.0)) == [1.0, 0.5]


def test_every_method_arrives_in_a_fresh_process():
    for text in (*METHODS, "tests.benchmarks.drift:Widening"):
        method = Method(text, H)
        again = pickle.loads(pickle.dumps(method))
        assert again == method and again.sigma == method.sigma and str(again) == str(method)
        assert method.prediction_length == (2 * H if method.name in ("preview", "warm-start") else H)


def test_what_cannot_be_is_named():
    for arguments, *facts in (
        *((("nobodys", H), "'nobodys'", "gaussian, past"), (("past,age=3", H), "age", "sigma, correlation")),
        *((("gaussian,sigma=0.3", H), "sigma"), (("past,sigma=0.3", H, 0.5), "sigma")),
        (("bridge,sigma=1", H), "sigma", "noise"),
        (("warmprior:PastPrior", H), "warmprior:PastPrior"),
        (("tests.modules.test_user_prior:Forgetful,gain=0.5", H), "Forgetful", "'gain'"),
    ):
        with raises(ValueError, *facts):
            Method(*arguments)


def test_a_regression_draws_nothing_and_is_trained_at_the_start_alone():
    method = Method("regression", H)
    source = method.prior().distribution(cold_history([2], H, H, 1))
    assert (source.sample() == 0).all() and not source.warm.any()
    assert method.recipe(TrainingConfig()).times == "start" and not method.is_flow
    assert method.nfes((9, 3)) == [1] and Method("past", H).nfes((1, 9, 1)) == [9, 1]


def test_history_is_withheld_from_those_alone_that_remember():
    training = TrainingConfig(cold_probability=0.5)
    remember = {name for name in METHODS if Method(name, H).recipe(training).cold_probability}
    assert remember == {"past", "preview", "forecast", "history", "step", "cvae-history", "a2a", "mip-past"}
    vector = {name for name in METHODS if Method(name, H).needs_vector}
    assert vector == {"forecast", "ot", "bridge", "step", "cvae", "cvae-history", "leap"}
    assert not Method("ot,observation_weight=0", H).needs_vector


def test_the_noise_of_a_bridge_is_an_option_with_a_name_of_its_own():
    """It is no sigma of a source: rows name it, and --sigma leaves it alone."""
    for noise, options in ((0.1, ""), (1.0, "noise=1.0"), (0.5, "noise=0.5")):
        method = Method(f"bridge,noise={noise}", H, 0.3)
        coupling = method.coupling()
        assert isinstance(coupling, BridgeCoupling) and coupling.config()["sigma"] == noise
        assert (method.options, method.sigma, method.is_straight) == (options, 1.0, False)
    assert Method("bridge", H) == Method("bridge,noise=0.1", H) and Method("ot", H).is_straight


def test_couplings_are_those_of_the_table():
    assert type(Method("ot", H).coupling()) is OTCoupling and Method("past", H).coupling() is None
    method = Method("reflow,teacher_nfe=2", H)
    teacher = WarmPriorActor(VelocityMLP(1, 1, H, 1, hidden_dim=8), method.prior())
    coupling = method.coupling(teacher)
    assert isinstance(coupling, ReflowCoupling) and method.teacher == Method("gaussian", H)
    a0, seen = torch.randn(4, H, 1), torch.randn(4, 1, 1)
    expected = ReflowCoupling(teacher, 2)(a0, a0, seen)[1]
    assert torch.equal(coupling(a0, a0, seen)[1], expected)
