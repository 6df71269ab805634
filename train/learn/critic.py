"""A policy of Stable-Baselines3 whose critic sees more than its actor: the true robot.

[Pinto2018] L. Pinto et al., "Asymmetric Actor Critic for Image-Based Robot Learning", RSS.
"""

from typing import Any

import torch
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import MlpExtractor
from typing_extensions import override


class _Networks(MlpExtractor):
    """Hidden layers of actor and critic; those of the actor take the first features alone."""

    def __init__(self, actor_features: int, num_features: int, *arguments: Any) -> None:
        super().__init__(num_features, *arguments)
        self._actor_features = actor_features
        self.policy_net = MlpExtractor(actor_features, *arguments).policy_net

    @override
    def forward_actor(self, features: torch.Tensor) -> torch.Tensor:
        return super().forward_actor(features[:, : self._actor_features])


class KnowingCritic(ActorCriticPolicy):
    """`MlpPolicy` whose actor does not see the last columns of the observation.

    Args:
        actor_features: Columns that it sees, the first ones.
        *arguments, **options: As of `ActorCriticPolicy`.
    """

    def __init__(self, *arguments: Any, actor_features: int, **options: Any) -> None:
        self._actor_features = actor_features
        super().__init__(*arguments, **options)

    @override
    def _build_mlp_extractor(self) -> None:
        options = (self.net_arch, self.activation_fn, self.device)
        self.mlp_extractor = _Networks(self._actor_features, self.features_dim, *options)
