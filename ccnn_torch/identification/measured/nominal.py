"""The nominal machine of a config."""

from __future__ import annotations

from ccnn_torch.errors import InputError
from ccnn_torch.identification.config import IdentifyConfig
from ccnn_torch.mechanisms import Mechanism, SerialArm, load_mechanism


def nominal_machine(config: IdentifyConfig) -> Mechanism:
    """The mechanism that the config names, with as many parameters a link as it asks for."""
    mechanism = load_mechanism(config.mechanism, **config.mechanism_keys)
    if config.links == "given":
        return mechanism
    if not isinstance(mechanism, SerialArm):
        raise InputError(f"links: {mechanism.name} is no serial arm; remove the key")
    return mechanism.with_link_frames()
