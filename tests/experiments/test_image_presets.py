"""What the presets do where policies see images."""

from __future__ import annotations

from dataclasses import replace

import pytest

from warmprior.envs import rendering
from warmprior.experiments import (
    PRESETS,
    DataOptions,
    NetworkOptions,
    Recipe,
    RunOptions,
    comparison_preset,
    presets,
    recipe,
)

IMAGE = DataOptions(obs="image")


@pytest.fixture
def offline(monkeypatch):
    def weights():
        raise OSError(
            "ImageNet's weights of ResNet-18 cannot be had (no route to host): connect once"
        )

    for place in (presets, recipe):
        monkeypatch.setattr(place, "imagenet_weights", weights)
    monkeypatch.setattr(recipe, "require_rendering", lambda: "egl")


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_presets_of_states_are_untouched(name):
    assert comparison_preset(Recipe(run=RunOptions(preset=name))) is PRESETS[name]


def test_the_papers_encoder_where_its_weights_can_be_had(monkeypatch):
    for place in (presets, recipe):
        monkeypatch.setattr(place, "imagenet_weights", dict)
    found = comparison_preset(Recipe(data=IMAGE, run=RunOptions(preset="paper")))
    # Table 4: 84 x 84 pixels, 76 x 76 random crop, ResNet-18 from ImageNet, batches of 256.
    assert (found.data.image_size, found.network.crop_size) == (84, 76)
    assert (found.network.encoder, found.training.batch_size) == ("resnet18-imagenet", 256)
    assert not found.data.fast_rendering and not found.network.share_encoder


def test_where_they_cannot_be_had_it_starts_from_random_ones_and_says_so(offline, capsys):
    found = comparison_preset(Recipe(data=IMAGE, run=RunOptions(preset="paper")))
    assert found.network.encoder == "resnet18"
    told = capsys.readouterr().out
    assert "no route to host" in told and "starts from random weights" in told


def test_small_presets_need_no_weights(offline, capsys):
    for name in ("quick", "cpu"):
        found = comparison_preset(Recipe(data=IMAGE, run=RunOptions(preset=name)))
        assert found.network.encoder == "small"
        found.check()
    assert capsys.readouterr().out == ""


def test_asked_for_elsewhere_missing_weights_are_an_error_before_any_work(offline):
    with pytest.raises(OSError, match="cannot be had"):
        replace(PRESETS["quick"], data=IMAGE).check()
    replace(PRESETS["quick"], data=IMAGE, network=NetworkOptions(encoder="resnet18")).check()


def test_without_a_renderer_images_are_refused_as_an_option(monkeypatch):
    monkeypatch.setattr(rendering, "rendering_backend", lambda: None)
    with pytest.raises(ValueError, match=r"--obs image needs .*libegl1.*libosmesa6"):
        IMAGE.check()
