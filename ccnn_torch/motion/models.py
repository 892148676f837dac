"""Nominal models by their names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ccnn_torch.errors import InputError
from ccnn_torch.files.read import CONFIG_LIMIT, read_text
from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.motion.nominal import Nominal
from ccnn_torch.motion.servo import servo
from ccnn_torch.motion.simulators import own_simulator
from ccnn_torch.plugins import is_plugin


def nominal_of(mechanism: str, keys: Mapping[str, Any], units: Sequence[str]) -> Nominal:
    """The nominal model by its name.

    Args:
        mechanism: `servo`, a simulator `file.py:NAME`, an MJCF with position actuators, or a mechanism.
        keys: of the built-in servo (`KEYS`), or of the mechanism.
        units: of the joints in the logs.

    Raises:
        InputError: a name or a key is not known, or the model has another number of joints than the logs.
    """
    n = len(units)
    if mechanism == "servo":
        return servo(keys, n)
    nothing = Nominal(mechanism, ({},) * n, (None,) * n, (None,) * n)
    if is_plugin(mechanism):
        return replace(nothing, simulator=own_simulator(mechanism, keys))
    if Path(mechanism).suffix.lower() in (".xml", ".mjcf") and Path(mechanism).is_file():
        from ccnn_torch.motion.mujoco_model import mujoco_nominal

        if "<mujoco" in read_text(mechanism, CONFIG_LIMIT, "write an MJCF"):
            return mujoco_nominal(mechanism, keys, units)
    own = [joint.unit for joint in load_mechanism(mechanism, **keys).joints]
    if own != list(units):
        raise InputError(
            f"{mechanism}: has {len(own)} joints ({', '.join(own)}), and the logs {len(units)} ({', '.join(units)}); "
            "name the commands command1… and the positions q1… in the mechanism's order"
        )
    return nothing
