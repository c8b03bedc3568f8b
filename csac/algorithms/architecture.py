"""Network hyperparameters that all algorithms share: activation and layer norm of actor and critics."""

from __future__ import annotations

from dataclasses import dataclass

from csac.algorithms.networks import Hidden
from csac.types import Activation


@dataclass(frozen=True)
class Architecture:
    """Activation and layer norm of the hidden layers of actor and critics."""

    activation: Activation = "relu"
    """Activation of the hidden layers."""
    layer_norm: bool = False
    """Whether hidden layers are normalised over their outputs before the activation."""
    actor_activation: Activation | None = None
    """Activation of the actor, if it differs from `activation`."""
    critic_activation: Activation | None = None
    """Activation of the critics, if it differs from `activation`."""
    actor_layer_norm: bool | None = None
    """Whether the actor has layer norm, if it differs from `layer_norm`."""
    critic_layer_norm: bool | None = None
    """Whether the critics have layer norm, if it differs from `layer_norm`."""

    @property
    def actor_hidden(self) -> Hidden:
        """Activation and layer norm of the actor's hidden layers."""
        return self._hidden(self.actor_activation, self.actor_layer_norm)

    @property
    def critic_hidden(self) -> Hidden:
        """Activation and layer norm of each critic's hidden layers."""
        return self._hidden(self.critic_activation, self.critic_layer_norm)

    def _hidden(self, activation: Activation | None, layer_norm: bool | None) -> Hidden:
        return Hidden(activation or self.activation, self.layer_norm if layer_norm is None else layer_norm)
