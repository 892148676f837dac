"""Reading model files: whichever of the three forms, one way to call it, and only what the card vouches for."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np
import onnx
import torch
from google.protobuf.message import DecodeError  # type: ignore[import-untyped]
from numpy.typing import ArrayLike
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from torch import Tensor

from ccnn_torch.compensation._compensator import Compensator, Hook
from ccnn_torch.compensation._domain import Domain
from ccnn_torch.compensation._effects import PhysicalEffects
from ccnn_torch.compensation._facts import check_keys, check_tensors, coordinates, to_json
from ccnn_torch.compensation._geometry import Geometry
from ccnn_torch.compensation._networks import network_from_description
from ccnn_torch.compensation._session import (
    METADATA_KEY,
    TAKE_AGAIN,
    Array,
    open_onnx,
    open_pt2,
    read_pt2_text,
    run_onnx,
    run_pt2,
)
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError, ModelFileError
from ccnn_torch.training import Scaling

__all__ = ["LoadedModel", "load_model"]

Run = Callable[[Array, Array | None], dict[str, Array]]


class HasKinematics(Protocol):
    """What is asked of a mechanism here; `ccnn_torch.mechanisms.Mechanism` is one."""

    name: str

    def describe(self) -> dict[str, Any]:
        """Its name, joints, pose coordinates and parameters as JSON."""


@dataclass(frozen=True)
class LoadedModel:
    """A compensator out of a file.

    Attributes:
        path: the file.
        card: the card that vouches for it.
        facts: what the file says about itself; equal to the card where both say something.
        joints, covariates, pose: coordinates in order.
        compensator: the torch module, where the file is the master (.safetensors); None for exports.
    """

    path: Path
    card: dict[str, Any]
    facts: dict[str, Any]
    joints: tuple[Coordinate, ...]
    covariates: tuple[Coordinate, ...]
    pose: tuple[Coordinate, ...]
    compensator: Compensator | None
    _run: Run

    def __call__(self, joints: ArrayLike, covariates: ArrayLike | None = None) -> dict[str, Array]:
        """Commands of ideal joints, and ideal joints were they commands.

        Args:
            joints: `... x n` [SI].
            covariates: `... x m` [SI] in the order of `covariates`; None where there are none.

        Returns:
            `command`, `deviation`, `ideal` and `deviation_sd`, `... x n` [SI]; `inside_domain` and
            `ideal_inside_domain`, `...`, bool.

        Raises:
            InputError: covariates are missing, or a last dimension is wrong.
        """
        given = self._matrix(joints, self.joints, "joints")
        lead = given.shape[:-1]
        flat = None
        if self.covariates:
            if covariates is None:
                names = ", ".join(c.header for c in self.covariates)
                raise InputError(f"the model needs the covariates {names}; give covariates=… in this order")
            extra = self._matrix(covariates, self.covariates, "covariates")
            flat = np.broadcast_to(extra, (*lead, extra.shape[-1])).reshape(-1, extra.shape[-1])
        found = self._run(given.reshape(-1, given.shape[-1]), flat)
        return {name: value.reshape((*lead, *value.shape[1:])) for name, value in found.items()}

    @property
    def middle(self) -> Array:
        """Middle of the domain's joints, `n` [SI]; where a search for joints begins."""
        edges = [self.facts["domain"]["inputs"][c.name] for c in self.joints]
        return np.array([(edge["low"] + edge["high"]) / 2 for edge in edges])

    def back(self, command: ArrayLike, covariates: ArrayLike | None = None) -> Array:
        """Ideal joints of commands (or of joints fed back), `... x n` [SI]; arguments and errors as a call."""
        return self(command, covariates)["ideal"]

    def require_mechanism(self, mechanism: HasKinematics) -> None:
        """Refuse a mechanism that the model was not made for.

        Raises:
            ModelFileError: name, joints, pose coordinates or a parameter differ.
        """
        made_for, given = self.facts["mechanism"], mechanism.describe()
        for key, what in (("name", "mechanism"), ("joints", "joints"), ("pose", "pose coordinates")):
            if made_for[key] != given[key]:
                raise ModelFileError(
                    f"{self.path}: this model was made for the {what} {_words(made_for[key])}, "
                    f"not for {_words(given[key])}; take the model of that machine"
                )
        ours, theirs = made_for.get("parameters", {}), given.get("parameters", {})
        wrong = [
            k for k in ours if k not in theirs or not math.isclose(ours[k], theirs[k], rel_tol=1e-9, abs_tol=1e-12)
        ]
        if wrong:
            raise ModelFileError(
                f"{self.path}: this model was made for {mechanism.name} with {wrong[0]} = {ours[wrong[0]]:g}, not "
                f"{theirs.get(wrong[0])}; build the mechanism from the model: "
                "mechanism_from_description(model.facts['mechanism'])"
            )

    def hook_for(self, mechanism: HasKinematics) -> Hook:
        """The compensator's hook, for this mechanism's inverse kinematics.

        Raises:
            ModelFileError: the model was made for another mechanism, or the file is an export, which torch cannot
                differentiate.
        """
        self.require_mechanism(mechanism)
        if self.compensator is None:
            raise ModelFileError(f"{self.path}: a torch hook needs the master file; load the .safetensors beside it")
        return self.compensator.hook()

    @staticmethod
    def _matrix(values: ArrayLike, wanted: tuple[Coordinate, ...], what: str) -> Array:
        array = np.asarray(values, dtype=np.float64)
        if array.ndim == 0 or array.shape[-1] != len(wanted):
            names = ", ".join(c.header for c in wanted)
            raise InputError(f"the model takes the {what} {names} as last dimension; got the shape {array.shape}")
        return array


def load_model(path: str | Path) -> LoadedModel:
    """Read a .safetensors, .onnx or .pt2 file whose SHA-256 stands in a card in its folder.

    Raises:
        ModelFileError: there is no file or no card, no card vouches for the file, or it is not a model of ours.
    """
    path = Path(path)
    content = _read(path)
    card = _card_of(path, hashlib.sha256(content).hexdigest())
    try:
        facts, run, compensator = _open(path, content)
    except ModelFileError as reason:
        raise ModelFileError(f"{path}: {reason}") from None
    different = [key for key in facts if card.get(key) != facts[key]]
    if different:
        raise ModelFileError(
            f"{path}: its card says something else about '{different[0]}' than the file; the card was edited or "
            "belongs to another run: take both again from where they were written"
        )
    named = {key: coordinates(facts[key]) for key in ("joints", "covariates", "pose")}
    return LoadedModel(path, card, facts, **named, compensator=compensator, _run=run)


def _words(value: str | list[str]) -> str:
    return value if isinstance(value, str) else ", ".join(value)


def _read(path: Path) -> bytes:
    try:
        content = path.read_bytes()
    except OSError as reason:
        raise ModelFileError(f"{path}: cannot be read: {reason.strerror}; give a .safetensors, .onnx or .pt2") from None
    if not content:
        raise ModelFileError(f"{path}: the file is empty; take it again from where it was written")
    return content


def _card_of(path: Path, digest: str) -> dict[str, Any]:
    """The card in the file's folder that lists this SHA-256, under whatever name."""
    names = sorted({path.parent / "card.json", *path.parent.glob("*.card.json")})
    present = [name for name in names if name.is_file()]
    if not present:
        raise ModelFileError(
            f"{path}: there is no card.json beside it to vouch for it; copy the card from the folder it was written "
            "to, or name a model file"
        )
    for name in present:
        try:
            card = json.loads(name.read_text(encoding="utf-8"))
        except (UnicodeDecodeError, json.JSONDecodeError):
            raise ModelFileError(f"{name}: this card is damaged; take it again from where it was written") from None
        files = card.get("files") if isinstance(card, dict) else None
        if isinstance(files, dict) and digest in files.values():
            found: dict[str, Any] = card
            return found
    raise ModelFileError(
        f"{path}: its SHA-256 is in none of the cards beside it ({', '.join(name.name for name in present)}): the file "
        "is damaged, altered or foreign; take it again from where it was written, with its card"
    )


def _open(path: Path, content: bytes) -> tuple[dict[str, Any], Run, Compensator | None]:
    """Facts, a way to run it, and the module where there is one; by what the name ends in."""
    if path.suffix == ".safetensors":
        facts, compensator = _open_master(content)
        return facts, lambda joints, covariates: _run_module(compensator, joints, covariates), compensator
    if path.suffix == ".onnx":
        facts, session = _open_onnx(content)
        return facts, lambda joints, covariates: run_onnx(session, joints, covariates), None
    if path.suffix == ".pt2":
        facts = _facts(read_pt2_text(content))
        program = open_pt2(content)
        check_tensors(facts, {name.removeprefix("compensator."): v for name, v in program.state_dict.items()})
        module = program.module()
        return facts, lambda joints, covariates: run_pt2(module, joints, covariates), None
    raise ModelFileError(f"a model file ends in .safetensors, .onnx or .pt2, not in '{path.suffix}'")


def _facts(text: str | None) -> dict[str, Any]:
    try:
        facts = check_keys(json.loads(text or "null"))
    except json.JSONDecodeError:
        raise ModelFileError("what it says about itself is no JSON" + TAKE_AGAIN) from None
    # Two texts can mean one number (long decimals do), so the text itself must be the one we would write.
    if to_json(facts) != text:
        raise ModelFileError("what it says about itself was edited after it was written")
    return facts


def _open_master(content: bytes) -> tuple[dict[str, Any], Compensator]:
    try:
        tensors = load_tensors(content)
        # The header's length stands in the first eight bytes, the header behind it; load() keeps it to itself.
        header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
    except (SafetensorError, ValueError):
        raise ModelFileError("it is damaged, or no safetensors file" + TAKE_AGAIN) from None
    facts = _facts(header.get("__metadata__", {}).get(METADATA_KEY))
    check_tensors(facts, tensors)
    return facts, _rebuild(facts, tensors)


def _open_onnx(content: bytes) -> tuple[dict[str, Any], Any]:
    try:
        model = onnx.load_from_string(content)
    except DecodeError:
        raise ModelFileError("it is damaged, or no ONNX file" + TAKE_AGAIN) from None
    facts = _facts({entry.key: entry.value for entry in model.metadata_props}.get(METADATA_KEY))
    if model.graph.input[0].type.tensor_type.elem_type != onnx.TensorProto.DOUBLE:
        raise ModelFileError(
            "this is the single precision variant for controllers, which gives one row's deviation; use the .onnx "
            "file without 'float32' in its name"
        )
    return facts, open_onnx(content)


def _rebuild(facts: Mapping[str, Any], tensors: dict[str, Tensor]) -> Compensator:
    """The module out of its description and tensors."""
    parts: dict[str, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        part, _, rest = name.partition(".")
        parts.setdefault(part, {})[rest] = value
    network = network_from_description(facts["network"])
    network.load_state_dict(parts.get("network", {}))
    geometry = network_from_description(facts["geometry"]) if "geometry" in facts else None
    if geometry is not None:
        geometry.load_state_dict(parts.get("geometry", {}))
    effects = network_from_description(facts["effects"]) if "effects" in facts else None
    if effects is not None:
        effects.load_state_dict(parts.get("effects", {}))
    return Compensator(
        network.requires_grad_(False),
        Scaling(**parts["scaling"]),
        Domain(**parts["domain"]),
        tensors["limit"],
        tensors["safe"],
        coordinates(facts["joints"]),
        coordinates(facts["covariates"]),
        facts["lipschitz"],
        facts["iterations"],
        tensors["sd_scale"],
        tensors["safe_sd"],
        cast(Geometry | None, geometry),
        cast(PhysicalEffects | None, effects),
    )


def _run_module(compensator: Compensator, joints: Array, covariates: Array | None) -> dict[str, Array]:
    given = [torch.tensor(v) for v in (joints, covariates) if v is not None]
    with torch.no_grad():
        return {name: value.numpy() for name, value in compensator.solve(*given)._asdict().items()}
