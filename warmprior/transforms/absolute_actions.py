"""Absolute poses as actions for an environment that takes pose deltas."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.data import Bounded, Composite

from warmprior import keys
from warmprior.checks import check_keys, check_shape
from warmprior.rotation import matrix_to_rotvec, rotation_6d_to_matrix
from warmprior.transforms.inner_step import EnvTransform, observed

_DELTA, _ABSOLUTE = 7, 10  # numbers per arm
_REACH = 2.0  # metres, the bound of positions in the action spec; it only limits random samples


class AbsoluteActions(EnvTransform):
    r"""A transform of target poses into deltas from the gripper's current pose.

    Per arm an action holds a position in metres in the world, the first two rows of a rotation matrix (any
    two that are not parallel) and the gripper, as :func:`~warmprior.envs.absolute_actions` computes them:
    ``"action"`` ``[*B, 10 * arms]``. The wrapped environment gets ``[*B, 7 * arms]``,

    .. math:: \mathrm{clip}\bigl((p^* - p) / s_p\bigr), \quad
              \mathrm{clip}\bigl(\log(R^* R^\top) / s_R\bigr)

    and the gripper, where :math:`(p, R)` is the gripper's pose before the step, ``"eef_pose"`` ``[*B, arms,
    3, 4]`` (:mod:`warmprior.keys`). A pose beyond the reach of one control step is approached at full speed.
    It acts on every control step: append it directly to the environment (:func:`policy_transforms` does so).

    Args:
        output_max: ``[6]``, the motion at an input of 1, in metres and radians, see
            :func:`~warmprior.envs.delta_conventions`.
        base_rotation: ``[arms, 3, 3]``, the rotation from the frame of the deltas to the world, from the same
            function; by default one arm whose frame is the world's.

    Raises:
        ValueError: if the shapes do not fit each other, or (in an environment) its actions.
        KeyError: if the environment writes no pose.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import AbsoluteActions
        >>> transform = AbsoluteActions([0.05] * 3 + [0.5] * 3)
        >>> here = torch.eye(3, 4)[None]  # at the origin, turned by nothing
        >>> action = torch.tensor([0.02, 0.0, 0.3, 1, 0, 0, 0, 1, 0, -1])
        >>> transform.inv(TensorDict({"action": action, "eef_pose": here}))["action"]
        tensor([ 0.4000,  0.0000,  1.0000,  0.0000,  0.0000,  0.0000, -1.0000])
    """

    def __init__(
        self,
        output_max: Tensor | Sequence[float],
        base_rotation: Tensor | None = None,
    ) -> None:
        super().__init__(in_keys_inv=[keys.ACTION], out_keys_inv=[keys.ACTION])
        # In double precision, like the simulator's: a delta is a small difference of large numbers.
        scale = torch.as_tensor(output_max, dtype=torch.float64)
        rotation = torch.eye(3)[None] if base_rotation is None else base_rotation
        check_shape("output_max of AbsoluteActions", scale, (6,))
        check_shape("base_rotation of AbsoluteActions", rotation, ("arms", 3, 3))
        self.arms = len(rotation)
        self.scale, self.base_rotation = nn.Buffer(scale), nn.Buffer(rotation.double())

    @property
    def one_step(self) -> Tensor:
        """The largest change of each action entry in a control step, ``[10 * arms]``; 0 for the gripper."""
        position, turn = self.scale[:3], self.scale[3:].amin()
        return torch.cat((position, turn.expand(6), turn.new_zeros(1))).repeat(self.arms)

    def delta(self, action: Tensor, pose: Tensor) -> Tensor:
        """Return the delta ``[*B, 7 * arms]`` to actions ``[*B, 10 * arms]`` from ``[*B, arms, 3, 4]``."""
        target, now = action.double().unflatten(-1, (self.arms, _ABSOLUTE)), pose.double()
        move = target[..., :3] - now[..., 3]
        turn = rotation_6d_to_matrix(target[..., 3:9]) @ now[..., :3].mT
        step = torch.stack((move, matrix_to_rotvec(turn)), -2) @ self.base_rotation
        delta = torch.cat((step.flatten(-2) / self.scale, target[..., 9:]), -1)
        return delta.clamp(-1, 1).flatten(-2).to(action.dtype)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        pose = observed(tensordict, keys.EEF_POSE, "AbsoluteActions")
        action = tensordict.get(keys.ACTION)
        return tensordict.set(keys.ACTION, self.delta(action, pose))

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        """Replace the deltas by absolute poses."""
        if (parent := self.parent) is not None:
            hint = ": make the environment with eef_pose=True"
            check_keys(parent.observation_spec, [keys.EEF_POSE], "AbsoluteActions", hint)
        actions = input_spec["full_action_spec"]
        leaf = actions[keys.ACTION]
        expected = (*leaf.shape[:-1], self.arms * _DELTA)
        check_shape(f"the environment's action, for AbsoluteActions of {self.arms} arm(s),", leaf, expected)
        limit = torch.tensor(([_REACH] * 3 + [1.0] * 7) * self.arms, device=leaf.device)
        limit = limit.to(leaf.dtype).expand(*leaf.shape[:-1], self.arms * _ABSOLUTE)
        actions[keys.ACTION] = Bounded(-limit, limit, device=leaf.device)
        return input_spec
