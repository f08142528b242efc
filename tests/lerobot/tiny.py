"""LeRobot's own flow policies with random weights, small and without a hub."""

import contextlib
import importlib
from importlib.metadata import PackageNotFoundError, version
from types import SimpleNamespace
from typing import Any
from unittest import mock

import torch

STATE, ACTION, PADDED, LENGTH, STEPS = 6, 7, 12, 8, 4
CAMERA = "observation.images.top"
SIZES = {"chunk_size": LENGTH, "n_action_steps": LENGTH, "max_state_dim": 8, "max_action_dim": PADDED}


def installed() -> str | None:
    try:
        return version("lerobot")
    except PackageNotFoundError:
        return None


N15 = installed() == "0.5.1"
"""Whether the release is that of GR00T N1.5, where no other family is supported (``make test-groot-n15``)."""

# Of the heads of GR00T.
ATTENTION = {"positional_embeddings": None, "num_attention_heads": 2, "attention_head_dim": 16}
ATTENTION |= {"dropout": 0.0, "final_dropout": False}
DIFFUSION = {**ATTENTION, "norm_type": "ada_norm", "output_dim": 32, "interleave_self_attention": True}
WIDTHS = {"input_embedding_dim": 32, "backbone_embedding_dim": 32, "hidden_size": 32}


def features(image: tuple[int, ...] | None = (3, 64, 64)) -> dict[str, Any]:
    from lerobot.configs.types import FeatureType, PolicyFeature

    inputs = {"observation.state": PolicyFeature(type=FeatureType.STATE, shape=(STATE,))}
    if image is not None:
        inputs[CAMERA] = PolicyFeature(type=FeatureType.VISUAL, shape=image)
    outputs = {"action": PolicyFeature(type=FeatureType.ACTION, shape=(ACTION,))}
    return {"input_features": inputs, "output_features": outputs, "device": "cpu"}


def make_smolvla(kind: Any = None, config: Any = None, **options: Any) -> Any:
    from lerobot.policies.smolvla import smolvlm_with_expert as backbone
    from lerobot.policies.smolvla.configuration_smolvla import SmolVLAConfig
    from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy

    chosen = {"resize_imgs_with_padding": (64, 64), "num_vlm_layers": 2, "load_vlm_weights": False}
    chosen |= {"num_steps": STEPS, **features(), **SIZES, **options}
    with tiny_smolvlm(backbone):
        return (kind or SmolVLAPolicy)((config or SmolVLAConfig)(**chosen))


@contextlib.contextmanager
def tiny_smolvlm(backbone: Any) -> Any:
    """SmolVLA's vision-language model, for whatever is built inside."""
    from transformers import SmolVLMConfig

    text = {"model_type": "llama", "hidden_size": 64, "intermediate_size": 128, "num_hidden_layers": 2}
    text |= {"num_attention_heads": 4, "num_key_value_heads": 2, "head_dim": 16}
    text |= {"vocab_size": 64, "pad_token_id": 0}
    vision = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 1, "num_attention_heads": 2}
    vision |= {"image_size": 64, "patch_size": 16}
    tokens = {"image_token_id": 1, "pad_token_id": 0}
    model = SmolVLMConfig(text_config=text, vision_config=vision, scale_factor=2, **tokens)
    tokenizer = SimpleNamespace(fake_image_token_id=2, global_image_token_id=3)
    processor = SimpleNamespace(tokenizer=tokenizer)
    with (
        mock.patch.object(backbone.AutoConfig, "from_pretrained", lambda *a, **k: model),
        mock.patch.object(backbone.AutoProcessor, "from_pretrained", lambda *a, **k: processor),
        contextlib.redirect_stdout(None),
    ):
        yield


def make_pi(family: str, kind: Any = None, config: Any = None, **options: Any) -> Any:
    modeling = importlib.import_module(f"lerobot.policies.{family}.modeling_{family}")
    configuration = importlib.import_module(f"lerobot.policies.{family}.configuration_{family}")
    name = family.upper()
    chosen = {"num_inference_steps": STEPS, "image_resolution": (64, 64), "dtype": "float32"}
    chosen |= {**features(), **SIZES, **options}
    with tiny_gemma(modeling):
        policy = kind or getattr(modeling, f"{name}Policy")
        return policy((config or getattr(configuration, f"{name}Config"))(**chosen))


@contextlib.contextmanager
def tiny_gemma(modeling: Any) -> Any:
    """The language models of pi0 and pi0.5, for whatever is built inside."""
    whole = modeling.PaliGemmaForConditionalGenerationWithPiGemma
    expert, sizes = modeling.PiGemmaForCausalLM, modeling.GemmaConfig

    def small_whole(config: Any) -> Any:
        config.text_config.vocab_size = config._vocab_size = 64
        config.image_token_index = config.image_token_id = 63
        vision = config.vision_config
        vision.hidden_size, vision.intermediate_size = 32, 64
        vision.num_hidden_layers, vision.num_attention_heads, vision.patch_size = 1, 2, 16
        vision.projection_dim = config.projection_dim = 32
        return whole(config=config)

    def small_expert(config: Any) -> Any:
        config.vocab_size = 64
        return expert(config=config)

    def gemma(variant: str) -> Any:
        return sizes(width=32, depth=2, mlp_dim=64, num_heads=8, num_kv_heads=1, head_dim=8)

    with (
        mock.patch.object(modeling, "get_gemma_config", gemma),
        mock.patch.object(modeling, whole.__name__, small_whole),
        mock.patch.object(modeling, expert.__name__, small_expert),
    ):
        yield


def make_groot(kind: Any = None, config: Any = None, **options: Any) -> Any:
    from lerobot.policies.groot.configuration_groot import GrootConfig
    from lerobot.policies.groot.modeling_groot import GrootPolicy

    chosen = {**features(), **SIZES, "use_bf16": False, **options}
    with tiny_groot():
        return (kind or GrootPolicy)((config or GrootConfig)(**chosen))


def tiny_groot() -> Any:
    """The real action head behind an embedding of tokens."""
    from lerobot.policies.groot.groot_n1_7 import GR00TN17ActionHead, GR00TN17Config
    from lerobot.policies.groot.modeling_groot import GrootPolicy
    from transformers.feature_extraction_utils import BatchFeature

    diffusion = {**DIFFUSION, "num_layers": 4}
    head = {"diffusion_model_cfg": diffusion, "vl_self_attention_cfg": {**ATTENTION, "num_layers": 1}}
    head |= {"action_horizon": LENGTH, "num_inference_timesteps": STEPS, "max_num_embodiments": 4}
    head |= {"max_state_dim": 8, "max_action_dim": PADDED, "use_alternate_vl_dit": True}
    sizes = GR00TN17Config(**WIDTHS, **head, state_dropout_prob=0.0)

    class Model(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.config, self.action_head = sizes, GR00TN17ActionHead(sizes)
            self.embedding = torch.nn.Embedding(64, 32)

        def _seen(self, inputs: Any) -> Any:
            tokens = inputs["input_ids"]
            mask = torch.ones_like(tokens, dtype=torch.bool)
            image = torch.arange(tokens.shape[1]) < tokens.shape[1] // 2
            features = {"backbone_features": self.embedding(tokens), "backbone_attention_mask": mask}
            return BatchFeature(data=features | {"image_mask": image.expand_as(mask)})

        def forward(self, inputs: Any) -> Any:
            head = self.action_head
            return head(self._seen(inputs), head.prepare_input(inputs))

        def get_action(self, inputs: Any, options: Any = None) -> Any:
            head = self.action_head
            return head.get_action(self._seen(inputs), head.prepare_input(inputs), options)

    return mock.patch.object(GrootPolicy, "_create_groot_model", lambda self: Model())


def make_groot_n15(**options: Any) -> Any:
    """The real model behind an embedding of tokens, in lerobot 0.5.1."""
    from lerobot.policies.groot import groot_n1, modeling_groot
    from lerobot.policies.groot.configuration_groot import GrootConfig
    from transformers.feature_extraction_utils import BatchFeature

    class Backbone(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.embedding = torch.nn.Embedding(64, 32)

        def prepare_input(self, inputs: Any) -> Any:
            return BatchFeature(data=inputs)

        def forward(self, inputs: Any) -> Any:
            tokens = inputs["eagle_input_ids"]
            mask = torch.ones_like(tokens, dtype=torch.bool)
            features = self.embedding(tokens)
            return BatchFeature(data={"backbone_features": features, "backbone_attention_mask": mask})

    diffusion = {**DIFFUSION, "num_layers": 2, "cross_attention_dim": 32}
    head = {"diffusion_model_cfg": diffusion, "vl_self_attention_cfg": {**ATTENTION, "num_layers": 1}}
    head |= {"max_seq_len": 64, "max_state_dim": 8, "max_num_embodiments": 32, "num_target_vision_tokens": 4}
    actions = {"action_dim": PADDED, "action_horizon": LENGTH}
    head |= {"num_inference_timesteps": STEPS, **WIDTHS, **actions}
    sizes = groot_n1.GR00TN15Config(backbone_cfg={}, action_head_cfg=head, **actions)
    chosen = {**features(), **SIZES, "use_bf16": False, **options}
    model = groot_n1.GR00TN15

    def built(*args: Any, **kwargs: Any) -> Any:
        return model(sizes, local_model_path="")

    with (
        mock.patch.object(groot_n1, "EagleBackbone", Backbone),
        mock.patch.object(model, "from_pretrained", built),
        contextlib.redirect_stdout(None),
    ):
        return modeling_groot.GrootPolicy(GrootConfig(**chosen))


def make_multi_task_dit(**options: Any) -> Any:
    from lerobot.policies.multi_task_dit import modeling_multi_task_dit as modeling
    from lerobot.policies.multi_task_dit.configuration_multi_task_dit import MultiTaskDiTConfig
    from transformers import CLIPTextConfig

    sizes = {"hidden_size": 32, "intermediate_size": 64, "projection_dim": 32, "vocab_size": 64}
    config = CLIPTextConfig(**sizes, num_hidden_layers=1, num_attention_heads=2, eos_token_id=2)
    chosen = {"n_obs_steps": 2, "horizon": LENGTH, "n_action_steps": 4, "num_integration_steps": STEPS}
    chosen |= {"hidden_dim": 32, "num_layers": 2, "num_heads": 2, "dropout": 0.0}
    chosen |= {"objective": "flow_matching", **features(image=None), **options}
    small = classmethod(lambda kind, *args, **kwargs: kind(config))
    with mock.patch.object(modeling.CLIPTextModel, "from_pretrained", small):
        return modeling.MultiTaskDiTPolicy(MultiTaskDiTConfig(**chosen))


def make_xvla(**options: Any) -> Any:
    from lerobot.policies.xvla.configuration_xvla import XVLAConfig
    from lerobot.policies.xvla.modeling_xvla import XVLAPolicy

    stages = {"embed_dim": [16] * 4, "num_heads": [2] * 4, "num_groups": [2] * 4, "depths": [1] * 4}
    coders = {"layers": 1, "attention_heads": 2, "ffn_dim": 32}
    text = {f"{coder}_{size}": n for coder in ("encoder", "decoder") for size, n in coders.items()}
    text |= {"vocab_size": 64, "d_model": 32, "max_position_embeddings": 64, "pad_token_id": 1}
    tokens = {"image_token_id": 63, "pad_token_id": 1, "bos_token_id": 0, "eos_token_id": 2}
    vision = {**stages, "window_size": 2, "projection_dim": 32}
    chosen = {"florence_config": {"vision_config": vision, "text_config": text, **tokens}}
    chosen |= {"hidden_size": 32, "depth": 2, "num_heads": 2, "len_soft_prompts": 2, "max_len_seq": 256}
    chosen |= {"action_mode": "auto", "num_denoising_steps": STEPS, **SIZES, **features(), **options}
    return XVLAPolicy(XVLAConfig(**chosen))


MAKERS = (
    {"groot": make_groot_n15}
    if N15
    else {
        "smolvla": make_smolvla,
        "pi0": lambda **options: make_pi("pi0", **options),
        "pi05": lambda **options: make_pi("pi05", **options),
        "groot": make_groot,
        "multi_task_dit": make_multi_task_dit,
        "xvla": make_xvla,
    }
)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def width(family: str) -> int:
    return ACTION if family == "multi_task_dit" else PADDED


def observations(family: str, size: int, seed: int = 0) -> dict[str, torch.Tensor]:
    """What the policy's preprocessor makes of observations."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    tokens = torch.randint(3, 60, (size, 5), generator=generator)
    if family == "groot":
        seen = {"state": normal(size, 1, 8), "embodiment_id": torch.zeros(size, dtype=torch.long)}
        return seen | {"eagle_input_ids" if N15 else "input_ids": tokens}
    language = {
        "observation.language.tokens": tokens,
        "observation.language.attention_mask": torch.ones_like(tokens, dtype=torch.bool),
    }
    if family == "multi_task_dit":
        return {"observation.state": normal(size, 2, STATE), **language}
    images = torch.rand(size, 3, 64, 64, generator=generator)
    return {"observation.state": normal(size, STATE), CAMERA: images, **language}


def windows(family: str, size: int, history: int, lead: int = 0, seed: int = 0) -> dict[str, Any]:
    """A training batch whose actions have ``history`` more in front."""
    generator = torch.Generator().manual_seed(seed + 1)
    batch = observations(family, size, seed)
    actions = torch.randn(size, history + LENGTH - lead, ACTION, generator=generator)
    is_pad = torch.zeros(actions.shape[:2], dtype=torch.bool)
    if family == "groot":  # padded by its preprocessor, which takes no longer chunks
        padded = torch.zeros(size, LENGTH, PADDED)
        padded[..., :ACTION] = actions[:, history:]
        mask = torch.zeros_like(padded)
        mask[..., :ACTION] = 1
        return {
            **batch,
            "action": padded,
            "action_mask": mask,
            "action_is_pad": is_pad[:, history:],
            "action_history": actions[:, :history],
            "action_history_is_pad": is_pad[:, :history],
        }
    return {**batch, "action": actions, "action_is_pad": is_pad}
