"""A policy of Stable-Baselines3 whose critic also sees the true robot, unlike its actor.

[Pinto2018] L. Pinto et al., "Asymmetric Actor Critic for Image-Based Robot Learning", RSS.
"""

from typing import Any

import torch
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import MlpExtractor
from typing_extensions import override


class _HiddenLayers(MlpExtractor):
    """Hidden layers of actor and critic; the actor's have only the first features as input."""

    def __init__(self, actor_features: int, num_features: int, *arguments: Any) -> None:
        super().__init__(num_features, *arguments)
        self._actor_features = actor_features
        self.policy_net = MlpExtractor(actor_features, *arguments).policy_net

    @override
    def forward_actor(self, features: torch.Tensor) -> torch.Tensor:
        return super().forward_actor(features[:, : self._actor_features])


class AsymmetricPolicy(ActorCriticPolicy):
    """`MlpPolicy` whose actor does not see the last columns of the observation.

    Args:
        actor_features: Number of columns that the actor sees, from the first.
        *arguments, **options: Arguments of `ActorCriticPolicy`.
    """

    def __init__(self, *arguments: Any, actor_features: int, **options: Any) -> None:
        self._actor_features = actor_features
        super().__init__(*arguments, **options)

    @override
    def _build_mlp_extractor(self) -> None:
        options = (self.net_arch, self.activation_fn, self.device)
        self.mlp_extractor = _HiddenLayers(self._actor_features, self.features_dim, *options)
