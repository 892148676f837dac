"""Reading model files: whichever of the two forms, one way to call it, and only what the card vouches for."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike

from ccnn_torch.compensation.compensator import Compensator, Hook
from ccnn_torch.compensation.guard import Promise, as_rows, kept
from ccnn_torch.compensation.model_files.card import card_of, read_model
from ccnn_torch.compensation.model_files.master import Run, open_model
from ccnn_torch.compensation.model_files.metadata import coordinates
from ccnn_torch.compensation.model_files.onnx_session import RUN_ERRORS, TAKE_AGAIN, Array, said
from ccnn_torch.compensation.model_files.signature import check_signature
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import FallbackWarning, InputError, ModelFileError, raise_if_out_of_memory
from ccnn_torch.mechanisms import Mechanism, mechanism_from_description
from ccnn_torch.plugins import code_refused


@dataclass(frozen=True)
class LoadedModel:
    """A compensator out of a file.

    Attributes:
        path: the file.
        card: the card that vouches for it.
        facts: the file's metadata; equal to the card where both have a key.
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
    _promise: Promise

    def __call__(self, joints: ArrayLike, covariates: ArrayLike | None = None) -> dict[str, Array]:
        """Commands of ideal joints, and ideal joints were they commands.

        Every number is finite for every input. A row in which the file breaks what its card promises, say by a
        deviation above the limit, falls back: the joints are commanded as they are; `FallbackWarning` gives their
            number.

        Args:
            joints: `... x n` [SI].
            covariates: `... x m` [SI] in the order of `covariates`; None where there are none.

        Returns:
            `command`, `deviation`, `ideal` and `deviation_sd`, `... x n` [SI]; `inside_domain`, `ideal_inside_domain`
            and `fallback`, `...`, bool.

        Raises:
            InputError: covariates are missing, or a last dimension is wrong.
            MemoryError: the rows do not fit into memory; give fewer at once.
        """
        rows, flat, lead = as_rows(joints, covariates, (self.joints, self.covariates))
        try:
            found = self._run(rows, flat)
        except RUN_ERRORS as reason:
            raise_if_out_of_memory(reason)
            # A graph may take one row and no two.
            found = {}
        checked = kept(found, rows, flat, self._promise)
        bad = checked["fallback"]
        if bad.any():
            warnings.warn(
                f"{self.path}: in {bad.sum()} of {len(bad)} rows (the first is row {bad.argmax() + 1}) the file breaks "
                "what its card promises (finite, |deviation| within the limit); the joints are commanded as they are "
                "there",
                FallbackWarning,
                stacklevel=2,
            )
        return {name: value.reshape((*lead, *value.shape[1:])) for name, value in checked.items()}

    @property
    def columns(self) -> dict[str, str]:
        """The map of columns that its run had: header in a file -> ``name[unit]`` or ``ignore``."""
        return dict(self.card.get("columns") or {})

    @property
    def joint_map(self) -> dict[str, str]:
        """Joint -> sum of columns, where the controller of its run counts otherwise."""
        return dict(self.card.get("joint_map") or {})

    @property
    def region(self) -> Array:
        """Lowest and highest joints of the domain, `n x 2` [SI]."""
        edges = [self.facts["domain"]["inputs"][c.name] for c in self.joints]
        return np.array([[edge["low"], edge["high"]] for edge in edges])

    @property
    def middle(self) -> Array:
        """Middle of the domain's joints, `n` [SI]; where a search for joints begins."""
        middle: Array = self.region.mean(-1)
        return middle

    def back(self, command: ArrayLike, covariates: ArrayLike | None = None) -> Array:
        """Ideal joints of commands (or of joints fed back), `... x n` [SI]; arguments and errors as a call."""
        return self(command, covariates)["ideal"]

    def require_mechanism(self, mechanism: Mechanism) -> None:
        """Refuse a mechanism that the model was not made for.

        Raises:
            ModelFileError: name, joints, pose coordinates or a parameter differ.
        """
        made_for, given = {"name": "", "joints": [], "pose": []} | self.facts["mechanism"], mechanism.describe()
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

    def hook_for(self, mechanism: Mechanism) -> Hook:
        """The compensator's hook, for this mechanism's inverse kinematics.

        Raises:
            ModelFileError: the model was made for another mechanism, or the file is an export, which torch cannot
                differentiate.
        """
        self.require_mechanism(mechanism)
        if self.compensator is None:
            raise ModelFileError(f"{self.path}: a torch hook needs the master file; load the .safetensors beside it")
        return self.compensator.hook()


def load_model(path: str | Path, *, public_key: str | Path | None = None, allow_code: bool = False) -> LoadedModel:
    """Read a .safetensors or .onnx file whose SHA-256 is in a card in its folder.

    Args:
        path: the file.
        public_key: PEM file with an Ed25519 key, by which the file and its card must be signed (`ccnn sign`).
        allow_code: run the Python file that a master names for a user's own mechanism.

    Raises:
        ModelFileError: there is no file or no card, no card vouches for the file, its signature is missing or wrong, it
            is not a model of ours, or it names code that was not allowed.
        InputError: the key is none, or the package for signatures is missing.
    """
    path = Path(path)
    content = read_model(path)
    card, card_content = card_of(path, content)
    if public_key is not None:
        check_signature(path, content, card_content, public_key)
    try:
        with code_refused("its metadata", allow_code):
            facts, run, compensator = open_model(path, content)
    except InputError as reason:
        raise ModelFileError(f"{path}: {reason}") from None
    different = [key for key in facts if card.get(key) != facts[key]]
    if different:
        raise ModelFileError(
            f"{path}: its card says something else about '{different[0]}' than the file; the card was edited or "
            "belongs to another run: take both again from where they were written"
        )
    named = {key: coordinates(facts[key]) for key in ("joints", "covariates", "pose")}
    promise = Promise.of_card(facts)
    model = LoadedModel(path, card, facts, **named, compensator=compensator, _run=run, _promise=promise)
    n = len(model.joints)
    try:
        run(promise.centre[None, :n], promise.centre[None, n:] if model.covariates else None)
    except RUN_ERRORS as reason:
        raise_if_out_of_memory(reason)
        raise ModelFileError(f"{path}: cannot be run ({said(reason)})" + TAKE_AGAIN) from None
    return model


def machine_of_model(model: LoadedModel, allow_code: bool = False) -> Mechanism:
    """The machine of a model, identified parameters as the nominal ones; effects and what was learned left out."""
    mechanism = mechanism_from_description(model.facts["mechanism"], allow_code)
    identified = model.facts.get("machine", {}).get("identified")
    return mechanism if identified is None else mechanism.with_nominal(torch.tensor(identified, dtype=torch.float64))


def _words(value: str | list[str]) -> str:
    return value if isinstance(value, str) else ", ".join(value)
