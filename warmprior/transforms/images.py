"""Images from a simulator's cameras, and features from a frozen encoder that replace them."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Composite, Unbounded

from warmprior import keys
from warmprior.checks import check_distinct, check_keys, check_whole_numbers
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.network import encoded, network_observation, precision_of
from warmprior.modules.resize import resized
from warmprior.options.data import IMAGE_SIZE, Resize
from warmprior.transforms.inner_step import EnvTransform

_SIM_STATE = ": build the environment with sim_state=True"


class CameraImages(EnvTransform):
    """A transform that adds one image per camera to an observation vector.

    The images are rendered from the environment's state (``RobosuiteEnv(..., sim_state=True)``). Rendering
    takes several times as long as a control step, so only the observations that the next decision reads are
    rendered. Append it directly to the simulator, inside the workers of batched environments
    (:func:`policy_transforms` does so).

    Args:
        cameras: names of the simulator's cameras; the image of ``"agentview"`` becomes
            ``("observation", "agentview_image")``, uint8 ``[3, size, size]``.
        size: side of the images in pixels.

    Keyword Args:
        rendered: heights and widths at which the cameras are rendered, before their images are resized; by
            default ``size``.
        resize: see :func:`~warmprior.modules.resize.resized`.

    Raises:
        ValueError: if there are no cameras, one is named twice or (in an environment) does not exist.
        KeyError: if the environment does not write its state.
        RuntimeError: if the environment is not a simulator.
        ImportError: if this machine cannot render.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from warmprior import CameraImages
        >>> from warmprior.envs import RobosuiteEnv
        >>> env = TransformedEnv(  # doctest: +SKIP
        ...     RobosuiteEnv("lift", sim_state=True), CameraImages(["agentview"], 84))
        >>> CameraImages(["agentview", "agentview"])
        Traceback (most recent call last):
            ...
        ValueError: cameras of CameraImages must be different names, got ['agentview', 'agentview']
    """

    def __init__(
        self,
        cameras: Sequence[str],
        size: int = IMAGE_SIZE,
        *,
        rendered: Sequence[Sequence[int]] | None = None,
        resize: Resize = "squeeze",
    ) -> None:
        super().__init__(in_keys=[keys.OBSERVATION, keys.SIM_STATE], out_keys=[keys.OBSERVATION])
        self.cameras = tuple(cameras)
        check_distinct("cameras of CameraImages", self.cameras)
        check_whole_numbers(size=size)
        self.size, self.resize = size, resize
        self.rendered = [(size, size)] * len(self.cameras) if rendered is None else list(map(tuple, rendered))

    @property
    def _simulator(self) -> Any:
        base: Any = None if self.container is None else self.container.base_env
        if not hasattr(base, "render_frame"):
            raise RuntimeError(
                "CameraImages renders a simulator: append it to TransformedEnv(RobosuiteEnv(...)), inside "
                f"batched environments, not to {type(base).__name__}"
            )
        return base

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        check_keys(next_tensordict, [keys.SIM_STATE], "CameraImages", _SIM_STATE)
        simulator, numbers = self._simulator, next_tensordict.get(keys.SIM_STATE).cpu().numpy()
        vector = next_tensordict.get(keys.OBSERVATION)
        entries = {keys.STATE: vector}
        for camera, shape in zip(self.cameras, self.rendered, strict=True):
            image = torch.from_numpy(simulator.render_frame(camera, shape, numbers)).permute(2, 0, 1)
            image = resized(image, (self.size, self.size), self.resize)
            entries[f"{camera}_image"] = image.contiguous().to(vector.device)
        return next_tensordict.set(keys.OBSERVATION, TensorDict(entries))

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Replace the vector by entries for the vector and the images."""
        check_keys(observation_spec, [keys.SIM_STATE], "CameraImages", _SIM_STATE)
        vector, shape = observation_spec[keys.OBSERVATION], (3, self.size, self.size)
        image = Bounded(0, 255, shape=shape, dtype=torch.uint8, device=vector.device)
        images = {f"{camera}_image": image.clone() for camera in self.cameras}
        observation_spec[keys.OBSERVATION] = Composite({keys.STATE: vector, **images})
        return observation_spec


class EncodeObservation(EnvTransform):
    """A transform that writes the features ``[*B, To, d_o]`` of a frozen policy's image encoder.

    Agents in the policy's source space and their critics read the features, so the encoder runs once per
    decision and replay buffers hold vectors. Let the policy read them too:
    ``actor.replace(observation_key=keys.FEATURES)``. Append it after :func:`policy_transforms`, outside
    batched environments, because inside every worker would hold a copy of the encoder.

    Args:
        actor: the policy; its network is copied as it is then, and not trained further.

    Raises:
        ValueError: if the network has no encoder (:attr:`VelocityNetwork.encodes`).
        KeyError: if the environment lacks the policy's observation.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import EncodeObservation, ImageEncoder, PastPrior, VelocityMLP, VisionNetwork
        >>> from warmprior import WarmPriorActor
        >>> encoder = ImageEncoder(["cam"], 3, image_size=32, crop_size=28, backbone="small")
        >>> network = VisionNetwork(encoder, VelocityMLP(2, encoder.observation_dim, 4))
        >>> images = torch.zeros(5, 2, 3, 32, 32, dtype=torch.uint8)
        >>> data = TensorDict({"observation": {"state": torch.zeros(5, 2, 3), "cam": images}}, [5])
        >>> EncodeObservation(WarmPriorActor(network, PastPrior(4)))(data)["features"].shape
        torch.Size([5, 2, 67])
    """

    def __init__(self, actor: WarmPriorActor) -> None:
        super().__init__(in_keys=[actor.observation_key], out_keys=[keys.FEATURES])
        if not getattr(actor.network, "encodes", False):
            raise ValueError(f"{type(actor.network).__name__} has no encoder: leave EncodeObservation out")
        self.network = copy.deepcopy(actor.network).eval().requires_grad_(False)

    def train(self, mode: bool = True) -> EncodeObservation:
        """Stay in evaluation mode."""
        return super().train(False)

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the features."""
        check_keys(tensordict, self.in_keys, "EncodeObservation")
        observation = tensordict.get(self.in_keys[0])
        batch, device = tensordict.batch_size, next(self.network.parameters()).device
        features = encoded(self.network, network_observation(observation, batch).to(device))
        assert isinstance(features, torch.Tensor)
        features = features.reshape(*batch, *features.shape[1:])
        return tensordict.set(self.out_keys[0], features.to(tensordict.device or device))

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self.forward(next_tensordict)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the features."""
        network = self.network
        shape = (*observation_spec.shape, network.observation_steps, network.observation_dim)
        like = {"dtype": precision_of(network), "device": observation_spec.device}
        observation_spec[self.out_keys[0]] = Unbounded(shape, **like)
        return observation_spec
