"""Our own mechanism file: which mechanism, which keys, and every parameter's nominal and identified value.

mechanism: five_bar
keys: {}
parameters:
  A1x: {value: -0.5057, nominal: -0.5, unit: m}
  …
columns: {A1: "q1[deg]"}   # where the records had other headers
joint_map: {q3: "J3 - J2"}   # where the controller counts its joints otherwise
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ccnn_torch.display import visible
from ccnn_torch.errors import InputError
from ccnn_torch.files.read import CONFIG_LIMIT, read_text
from ccnn_torch.files.yaml_file import dump_yaml, parse_yaml
from ccnn_torch.mechanisms.mechanism import Mechanism
from ccnn_torch.units import LARGEST

_FORM = "a mechanism file has mechanism, keys and parameters: {NAME: {value: …, nominal: …, unit: …}}"


class MechanismFile:
    """A mechanism file: `spec` and `keys` build the mechanism; `columns`, `joint_map` are as its records had them."""

    def __init__(self, path: str, content: Mapping[str, Any]) -> None:
        """Check the form; names and units are checked against the mechanism by `parameters_of`."""
        self.path = path
        spec, keys, parameters = (content.get(k) for k in ("mechanism", "keys", "parameters"))
        if not isinstance(spec, str) or not isinstance(keys, Mapping) or not isinstance(parameters, Mapping):
            raise InputError(f"{path}: {_FORM}")
        maps = [content.get(key) or {} for key in ("columns", "joint_map")]
        for key, found, example in zip(("columns", "joint_map"), maps, ("A1: 'q1[deg]'", "q3: 'J3 - J2'"), strict=True):
            if not isinstance(found, Mapping) or not all(isinstance(v, str) for pair in found.items() for v in pair):
                raise InputError(f"{path}: {key}: must map texts to texts, e.g. {{{example}}}")
        self.columns, self.joint_map = (dict(found) for found in maps)
        self.spec, self.keys = spec, dict(keys)
        self._entries: Mapping[str, Any] = parameters

    def parameters_of(self, mechanism: Mechanism, what: str) -> dict[str, float]:
        """Values by name, `what` being "value" or "nominal" [SI]."""
        known = {p.name: p.unit for p in mechanism.geometry}
        wrong = sorted(set(known) ^ set(self._entries))
        if wrong:
            raise InputError(
                f"{self.path}: parameters: {mechanism.name} has {', '.join(known)}; check {', '.join(map(str, wrong))}"
            )
        found = {}
        for name, unit in known.items():
            entry = self._entries[name]
            value = entry.get(what) if isinstance(entry, Mapping) else None
            if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= LARGEST:
                shown = visible(repr(value))
                raise InputError(f"{self.path}: parameters.{name}.{what}: must be a finite number, not {shown}")
            if entry.get("unit") != unit:
                raise InputError(f"{self.path}: parameters.{name}.unit: must be {unit}, not {entry.get('unit')!r}")
            found[name] = float(value)
        return found


def read_mechanism_file(path: str, content: bytes | None = None) -> MechanismFile | None:
    """Contents of the file, or None where it is no mechanism file: has no key `mechanism`, or cannot be read at all."""
    try:
        text = read_text(path, CONFIG_LIMIT) if content is None else content.decode("utf-8")
        tree = parse_yaml(text, path)
    except (InputError, UnicodeDecodeError):
        # The caller knows what else the file should have been, and reports it.
        return None
    if not isinstance(tree, Mapping) or "mechanism" not in tree:
        return None
    return MechanismFile(path, tree)


def mechanism_text(
    mechanism: Mechanism,
    nominal: Mapping[str, float],
    columns: Mapping[str, str] | None = None,
    joint_map: Mapping[str, str] | None = None,
) -> str:
    """A mechanism file's text; `load_mechanism` of it gives the same mechanism with the same parameters, bit by bit.

    Args:
        nominal: what was there before, by name [SI].
        columns: the headers that its records mapped.
        joint_map: the joints as sums of its records' columns.
    """
    about = mechanism.describe()
    tree = {
        "mechanism": about["spec"],
        "keys": about["keys"],
        "parameters": {
            p.name: {"value": about["parameters"][p.name], "nominal": nominal[p.name], "unit": p.unit}
            for p in mechanism.geometry
        },
        **({"columns": dict(columns)} if columns else {}),
        **({"joint_map": dict(joint_map)} if joint_map else {}),
    }
    return dump_yaml(tree, width=120)
