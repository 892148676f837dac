"""Neural compensation of robot kinematics: every source of error as one deviation of the actuated joints.

The names below are loaded on first use, so that `ccnn --help` does not wait for torch.
"""

from __future__ import annotations

from importlib import import_module

from ccnn_torch.version import __version__

# As of `typing`, whose import takes longer than all that is needed here; Ctrl-C in it would be a traceback.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from ccnn_torch.api import calibrate as calibrate
    from ccnn_torch.api import diagnose_motion as diagnose_motion
    from ccnn_torch.api import identify as identify
    from ccnn_torch.api import verify as verify
    from ccnn_torch.compensation import Compensator as Compensator
    from ccnn_torch.compensation import export_model as export_model
    from ccnn_torch.compensation import load_model as load_model
    from ccnn_torch.compensation import save_model as save_model
    from ccnn_torch.diagnosis import diagnose as diagnose
    from ccnn_torch.mechanisms import Mechanism as Mechanism
    from ccnn_torch.mechanisms import load_mechanism as load_mechanism
    from ccnn_torch.pseudoerror import joint_deviations as joint_deviations
    from ccnn_torch.records import load_records as load_records

_HOMES = {
    "Compensator": "ccnn_torch.compensation",
    "Mechanism": "ccnn_torch.mechanisms",
    "calibrate": "ccnn_torch.api",
    "diagnose": "ccnn_torch.diagnosis",
    "diagnose_motion": "ccnn_torch.api",
    "export_model": "ccnn_torch.compensation",
    "identify": "ccnn_torch.api",
    "joint_deviations": "ccnn_torch.pseudoerror",
    "load_mechanism": "ccnn_torch.mechanisms",
    "load_model": "ccnn_torch.compensation",
    "load_records": "ccnn_torch.records",
    "save_model": "ccnn_torch.compensation",
    "verify": "ccnn_torch.api",
}

__all__ = [*_HOMES, "__version__"]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'ccnn_torch' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)
