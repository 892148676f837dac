"""Uncertain parameters of a MuJoCo model: place, unit, and the model with other values."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ccnn_torch.coordinates import Parameter
from ccnn_torch.errors import InputError

Array = NDArray[np.float64]

# Fields that may be parameters, with their units about a turning and along a sliding joint, and whether they are >= 0.
_FIELDS: dict[tuple[str, str], tuple[str, str, bool]] = {
    ("joint", "stiffness"): ("N*m/rad", "N/m", True),
    ("joint", "damping"): ("N*m*s/rad", "N*s/m", True),
    ("joint", "frictionloss"): ("N*m", "N", True),
    ("joint", "qpos_spring"): ("rad", "m", False),
    ("body", "mass"): ("kg", "kg", True),
    ("body", "pos"): ("m", "m", False),
    ("body", "ipos"): ("m", "m", False),
    ("geom", "pos"): ("m", "m", False),
    ("site", "pos"): ("m", "m", False),
    ("actuator", "kp"): ("N*m/rad", "N/m", True),
    ("tendon", "stiffness"): ("N/m", "N/m", True),
    ("tendon", "frictionloss"): ("N", "N", True),
}
_AXES = "xyz"
_COUNTS = {"joint": "njnt", "body": "nbody", "geom": "ngeom", "site": "nsite", "actuator": "nu", "tendon": "ntendon"}
# Models with other parameters that are kept.
_MODELS = 256


@dataclass(frozen=True)
class ModelParameter:
    """A number of the model that may be wrong.

    Attributes:
        kind, of: the element, ``joint``, ``body``, ``geom``, ``site``, ``actuator`` or ``tendon``, and its name.
        field: ``stiffness``, ``damping``, ``frictionloss``, ``qpos_spring``, ``mass``, ``pos``, ``ipos``, or ``kp`` of
            a position servo.
        scale: plausible error [SI].
        axis: ``x``, ``y`` or ``z`` of a position.
        cause: as `Parameter.cause`.
    """

    kind: str
    of: str
    field: str
    scale: float
    axis: str | None = None
    cause: str | None = None

    @property
    def name(self) -> str:
        """`shoulder kp`, `tool pos x`."""
        return " ".join(part for part in (self.of, self.field, self.axis) if part)


class ModelNumbers:
    """The parameters of a compiled model."""

    def __init__(self, mujoco: Any, path: Path, model: Any, parameters: tuple[ModelParameter, ...]) -> None:
        """mujoco: the package; path: of the model, for sentences."""
        self.mujoco, self.path, self.model, self.parameters = mujoco, path, model, parameters
        self._models: dict[bytes, Any] = {}
        cells = [self._cells(model, p)[0] for p in parameters]
        self.nominal = [float(array[index]) * sign for array, index, sign in cells]

    def element(self, kind: str, name: str) -> int:
        """Its number."""
        wanted = getattr(self.mujoco.mjtObj, f"mjOBJ_{kind.upper()}")
        found = int(self.mujoco.mj_name2id(self.model, wanted, name))
        if found < 0:
            names = [self.mujoco.mj_id2name(self.model, wanted, i) for i in range(getattr(self.model, _COUNTS[kind]))]
            known = ", ".join(n for n in names if n and not n.startswith("ccnn_torch ")) or "none with a name"
            raise InputError(f"{self.path}: has no {kind} '{name}'; it has {known}")
        return found

    def declared(self) -> list[Parameter]:
        """Them with unit and nominal value."""
        found = []
        for p, value in zip(self.parameters, self.nominal, strict=True):
            turning, sliding, positive = _FIELDS[p.kind, p.field]
            unit = turning if self._turns(p) else sliding
            found.append(Parameter(p.name, unit, value, scale=p.scale, low=0.0 if positive else None, cause=p.cause))
        return found

    def model_with(self, values: Array) -> Any:
        """The model with these parameters, `k`; kept, since the same come again."""
        key = values.tobytes()
        if key not in self._models:
            if len(self._models) >= _MODELS:
                self._models.clear()
            model = copy.copy(self.model)
            for p, value in zip(self.parameters, values.tolist(), strict=True):
                for array, index, sign in self._cells(model, p):
                    array[index] = sign * value
            # Weights and inertias that follow from what was changed.
            self.mujoco.mj_setConst(model, self.mujoco.MjData(model))
            self._models[key] = model
        return self._models[key]

    def _turns(self, p: ModelParameter) -> bool:
        if p.kind not in ("joint", "actuator"):
            return False
        joint = self.element(p.kind, p.of)
        if p.kind == "actuator":
            joint = int(self.model.actuator_trnid[joint, 0])
        return bool(self.model.jnt_type[joint] == self.mujoco.mjtJoint.mjJNT_HINGE)

    def _cells(self, model: Any, p: ModelParameter) -> list[tuple[Array, int, float]]:
        """Place of a parameter in a model: array, index in it, sign."""
        if (p.kind, p.field) not in _FIELDS:
            known = ", ".join(f"{kind} {field}" for kind, field in _FIELDS)
            raise InputError(f"{self.path}: '{p.kind} {p.field}' is no parameter; there are {known}")
        element = getattr(model, p.kind)(self.element(p.kind, p.of))
        if p.field == "kp":
            # A position servo: force = kp (command - position) - kv speed.
            return [(element.gainprm, 0, 1.0), (element.biasprm, 1, -1.0)]
        array = getattr(element, p.field)
        if len(array) == 3 and p.axis not in tuple(_AXES):
            raise InputError(f"{self.path}: parameter '{p.name}' is a place; give its axis, x, y or z")
        return [(array, _AXES.index(p.axis) if p.axis and len(array) == 3 else 0, 1.0)]
