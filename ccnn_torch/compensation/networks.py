"""Networks in model files: described by JSON beside their tensors, built again from it, never unpickled."""

from __future__ import annotations

import importlib
from typing import Any, Protocol, cast, runtime_checkable

from torch import Tensor, nn

from ccnn_torch.errors import InputError, ModelFileError

# Kind -> the class, or its module; imported when a file needs it.
_KINDS: dict[str, str | type[DescribedNetwork]] = {
    "constant": "ccnn_torch.learners.constant:ConstantNetwork",
    "grnn": "ccnn_torch.learners.grnn_network:GRNNNetwork",
    "gp": "ccnn_torch.learners.gaussian_process:GPNetwork",
    "masked": "ccnn_torch.evolution.masked_network:MaskedNetwork",
    "forward": "ccnn_torch.compensation.machine:ForwardMachine",
    "inverse": "ccnn_torch.compensation.inverse_machine:InverseMachine",
    "expanded": "ccnn_torch.compensation.expanded_machine:ExpandedMachine",
}


class DescribedNetwork(Protocol):
    """What a learner's network offers so that a model file can hold it; a class that is an `nn.Module` as well."""

    def describe(self) -> dict[str, Any]:
        """JSON with the key `kind` and everything that `from_description` needs; the tensors are stored beside it."""

    @classmethod
    def from_description(cls, description: dict[str, Any]) -> nn.Module:
        """A network of the described shape, with any values: its `state_dict` is loaded afterwards."""


@runtime_checkable
class UncertainNetwork(Protocol):
    """A network that knows how sure it is."""

    def variance(self, features: Tensor) -> Tensor:
        """Variance of a newly measured standardised output, above 0 and finite: `... x i` -> `... x o`."""


def register_network(kind: str, network: type[DescribedNetwork]) -> None:
    """Make a kind of network known to model files; call it where the class is defined.

    A file that is loaded once more registers its class anew.

    Raises:
        InputError: the kind is taken by another class.
    """
    before = _KINDS.get(kind, network)
    if isinstance(before, str) or _place(before) != _place(network):
        raise InputError(f"a network of kind '{kind}' is registered already; give the new one another kind")
    _KINDS[kind] = network


def _place(network: type[DescribedNetwork]) -> tuple[str, str]:
    return network.__module__, network.__qualname__


def describe_network(network: nn.Module) -> dict[str, Any]:
    """The network's own description."""
    if not callable(getattr(network, "describe", None)):
        raise InputError(
            f"the network {type(network).__name__} cannot be stored: give it describe() and from_description(), "
            "and ccnn_torch.compensation.register_network(kind, class)"
        )
    description = cast(DescribedNetwork, network).describe()
    if description.get("kind") not in _KINDS:
        raise InputError(
            f"networks of kind {description.get('kind')!r} are unknown; call "
            "ccnn_torch.compensation.register_network(kind, class) in the file of the learner"
        )
    return description


def network_from_description(description: dict[str, Any]) -> nn.Module:
    """Inverse of `describe_network`, without the values.

    Raises:
        ModelFileError: the kind is unknown here.
    """
    kind = description.get("kind")
    found = _KINDS.get(kind) if isinstance(kind, str) else None
    if found is None:
        raise ModelFileError(
            f"the model holds a network of kind {kind!r}, which is unknown here; import the file that registers it"
        )
    if isinstance(found, str):
        module, _, name = found.partition(":")
        found = cast(type[DescribedNetwork], getattr(importlib.import_module(module), name))
    return found.from_description(description)
