"""Reading model files: one way to call them, only what a card vouches for, and every output held to its promise."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ccnn_torch.compensation.model_files.metadata import (
    RUN_ERRORS,
    TAKE_AGAIN,
    Array,
    card_of,
    coordinates,
    open_export,
    run_onnx,
    said,
)
from ccnn_torch.compensation.model_files.signature import check_signature
from ccnn_torch.compensation.outputs import DAMPED, EXACT, FLAGS, NOT_FINITE, NUMBERS, OUTSIDE, WAYS
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import FallbackWarning, InputError, ModelFileError, raise_if_out_of_memory
from ccnn_torch.plugins import code_refused

# An export runs without torch, whose import takes longer than all else.
if TYPE_CHECKING:
    from ccnn_torch.compensation.compensator import Compensator
    from ccnn_torch.effects.found_machine import FoundMachine
    from ccnn_torch.mechanisms import Mechanism

MODEL_FORMS, MACHINE_FORMS = (".safetensors", ".onnx"), (".yaml", ".yml", ".json")
# From here an input counts as infinite; as in a `Domain`, but for the joints of a machine.
_HUGE = 1e300
# Of the limit: how far command + deviation may be from the joints, and of the half range: from the domain's edge.
# Exports agree with their master to 1e-9 of the limit.
_SLACK = 1e-6
_EDGE = 1e-9


@dataclass(frozen=True)
class Promise:
    """What holds for every row of a model with n joints and d inputs, the joints first.

    Attributes:
        limit: of |deviation|, `n` [SI]: the card's `most_deviation`.
        sd: standard deviation where the deviation is taken as 0, `n` [SI].
        huge: magnitude from which an input counts as infinite, `d` [SI].
        centre, low, high: replacements of an input that is no number, and for an infinite one, `d` [SI].
        half_range: unit of the rows of `directions`, `d` [SI].
        directions: `k x d` [1], with `least` and `most`, `k` [1]: inside the domain, directions · (x - centre) /
            half_range is between the two.
    """

    limit: Array
    sd: Array
    huge: Array
    centre: Array
    low: Array
    high: Array
    half_range: Array
    directions: Array
    least: Array
    most: Array

    @classmethod
    def of_card(cls, facts: Mapping[str, Any]) -> Promise:
        """Out of facts of the right form (`read_facts`, `description_of`)."""
        domain, principal = facts["domain"], facts["domain"]["principal"]
        # By name: JSON has its keys in another order.
        edges = [domain["inputs"][c["name"]] for c in facts["joints"] + facts["covariates"]]
        limits = [facts["limits"][c["name"]] for c in facts["joints"]]
        low, high = (np.array([edge[k] for edge in edges], dtype=float) for k in ("low", "high"))
        # As floats at once: of an integer of more than 64 bits numpy makes an object, which has no `hypot`.
        centre, half_range, least, most = (
            np.array(principal[k], dtype=float) for k in ("centre", "half_range", "low", "high")
        )
        limit, safe, sd = (
            np.array([entry[k] for entry in limits], dtype=float)
            for k in ("most_deviation", "safe_correction", "safe_sd")
        )
        huge = np.full(len(centre), _HUGE)
        if "machine" in facts:
            from ccnn_torch.compensation.machine import FARTHEST

            huge[: len(limits)] = FARTHEST
        return cls(
            limit,
            np.hypot(safe, sd),
            huge,
            centre,
            low,
            high,
            half_range,
            np.concatenate([np.eye(len(centre)), np.array(principal["directions"], dtype=float)]),
            np.concatenate([(low - centre) / half_range, least]),
            np.concatenate([(high - centre) / half_range, most]),
        )

    def cleaned(self, inputs: Array) -> tuple[Array, Array]:
        """Finite inputs `s x d` [SI], as a `Domain` makes them, and which were not, `s x d`, bool."""
        strange = ~(np.abs(inputs) < self.huge)
        edge = np.where(np.isnan(inputs), self.centre, np.where(inputs > 0, self.high, self.low))
        return np.where(strange, edge, inputs), strange

    def inside(self, inputs: Array) -> Array:
        """Whether inputs `s x d` [SI] are in the domain, `s`, bool."""
        return np.asarray(self.within(inputs).all(-1))

    def within(self, inputs: Array) -> Array:
        """Whether inputs `s x d` [SI] are between each two edges, of the inputs and then of their principal directions,
        `s x 2d`, bool."""
        y = ((inputs - self.centre) / self.half_range) @ self.directions.T
        return np.asarray((y >= self.least - _EDGE) & (y <= self.most + _EDGE))


def as_matrix(values: ArrayLike, wanted: tuple[Coordinate, ...], what: str) -> Array:
    """Rows of what a caller gives, `... x len(wanted)` [SI]."""
    names = ", ".join(c.header for c in wanted)
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"the model takes numbers, the {what} {names} as last dimension") from None
    if array.ndim == 0 or array.shape[-1] != len(wanted):
        raise InputError(f"the model takes the {what} {names} as last dimension; got the shape {array.shape}")
    return array


def as_rows(
    joints: ArrayLike,
    covariates: ArrayLike | None,
    coordinates: tuple[tuple[Coordinate, ...], tuple[Coordinate, ...]],
) -> tuple[Array, Array | None, tuple[int, ...]]:
    """Rows of joints `s x n`, of covariates `s x m` (None where the model has none), and the leading dimensions.

    Args:
        coordinates: joints and covariates of the model, in order.

    Raises:
        InputError: covariates are missing, or a last dimension is wrong.
    """
    given = as_matrix(joints, coordinates[0], "joints")
    lead, flat = given.shape[:-1], None
    if coordinates[1]:
        if covariates is None:
            names = ", ".join(c.header for c in coordinates[1])
            raise InputError(f"the model needs the covariates {names}; give covariates=… in this order")
        extra = as_matrix(covariates, coordinates[1], "covariates")
        if extra.shape[:-1] not in (lead, ()):
            raise InputError(f"covariates for {lead} rows of joints must have as many rows, got {extra.shape[:-1]}")
        flat = np.broadcast_to(extra, (*lead, extra.shape[-1])).reshape(-1, extra.shape[-1])
    return given.reshape(-1, given.shape[-1]), flat, lead


@np.errstate(invalid="ignore", over="ignore")
def kept(
    found: Mapping[str, Any], joints: Array, covariates: Array | None, promise: Promise, ways: Collection[str] = WAYS
) -> dict[str, Array]:
    """The outputs, with what breaks the promise replaced by the safe fallback.

    A row falls back where an output is missing, of another shape or kind, or not finite, where |deviation| or
    |ideal - joints| is above the limit, or where command + deviation is not the joints. It then has command = ideal =
    joints and deviation 0, outside the domain. A row is inside only where it is also inside the card's domain. Joints
    that are no number count as the middle of the domain, infinite ones as its edge.

    Args:
        joints: `s x n` [SI], anything.
        covariates: `s x m` [SI], anything; None without any.
        ways: what was asked for.

    Returns:
        What was asked for of `command`, `deviation`, `ideal` and `deviation_sd`, `s x n` [SI], all finite;
        `inside_domain`, `ideal_inside_domain` and `fallback`, `s`, bool; `status` and `ideal_status`, `s`, int64: 0
        exact, 1 outside what was measured or fallen back, 2 an input is not finite, 3 damped.
    """
    rows, n = joints.shape
    inputs = joints if covariates is None else np.concatenate([joints, covariates], -1)
    inputs, strange = promise.cleaned(inputs)
    given = inputs[:, :n]

    safe = {"command": given, "deviation": np.zeros_like(given), "ideal": given}
    safe["deviation_sd"] = np.broadcast_to(promise.sd, given.shape)
    floats = [name for way in ways for name in NUMBERS[way]]
    flags_of = {way: names for way, names in FLAGS.items() if way in ways}
    # Where an output is no such numbers there are none.
    there = {name: _of_kind(found.get(name), (rows, n), np.float64) for name in floats}
    flags = {name: _of_kind(found.get(name), (rows,), np.bool_) for name, _ in flags_of.values()}
    states = {name: _of_kind(found.get(name), (rows,), np.int64) for _, name in flags_of.values()}
    whole = all(value is not None for value in (*there.values(), *flags.values(), *states.values()))
    numbers = safe | {name: value for name, value in there.items() if value is not None}

    command, deviation, ideal, sd = numbers.values()
    rounding = _SLACK * promise.limit + 8 * np.spacing(np.abs(given) + np.abs(deviation))
    # Written so that a NaN is not good.
    good = np.isfinite(command) & np.isfinite(ideal) & (np.abs(deviation) <= promise.limit * (1 + _EDGE))
    good &= (np.abs(command + deviation - given) <= rounding) & (np.abs(ideal - given) <= promise.limit + rounding)
    good &= (sd >= 0) & (sd < np.inf)
    kept_rows: Array = np.logical_and(good.all(-1), whole)

    checked = {name: np.where(kept_rows[:, None], numbers[name], safe[name]) for name in floats}
    known = kept_rows & ~strange.any(-1)
    for way, (name, state) in flags_of.items():
        at = checked["command"] if way == "command" else given
        # Of what is missing no row is kept.
        flag, told = (np.zeros(rows) if v is None else v for v in (flags[name], states[state]))
        checked[name] = known & (flag > 0) & promise.inside(np.concatenate([at, inputs[:, n:]], -1))
        of_row = np.where(known & (told == DAMPED), DAMPED, np.where(checked[name], EXACT, OUTSIDE))
        checked[state] = np.where(strange.any(-1) | (told == NOT_FINITE), NOT_FINITE, of_row)
    return checked | {"fallback": ~kept_rows}


def _of_kind(value: Any, shape: tuple[int, ...], kind: type) -> Array | None:
    """The output, None where it is no array of this shape and kind."""
    right = isinstance(value, np.ndarray) and value.shape == shape and value.dtype == kind
    return value if right else None


TOGETHER = "several inputs together"
"""What is beyond what was measured where no input is by itself."""


@dataclass
class LoadedModel:
    """A compensator out of a file, or an identified machine as one that has learned nothing.

    Of the latter an ideal joint vector means the pose f(q; nominal), and the command is that of the identified machine
    at this pose.

    Attributes:
        path: the file.
        card: the card that vouches for it; of a machine the `columns` and `joint_map` of its file.
        facts: the file's metadata, equal to the card where both have a key; of a machine the nominal one's `mechanism`.
        joints, covariates, pose: coordinates in order; geometry alone has no covariates.
        make: gives the compensator, where the file is no export.
        session_of: gives a session of ONNX Runtime for some of the outputs, where it is one.
        machine: as an identification found it; None for a model that has learned.
        signed: whether a signature was asked for: then what no signature covers is not believed.
    """

    path: Path
    card: dict[str, Any]
    facts: dict[str, Any]
    joints: tuple[Coordinate, ...]
    covariates: tuple[Coordinate, ...]
    pose: tuple[Coordinate, ...]
    make: Callable[[], Compensator] | None
    session_of: Callable[[frozenset[str]], Any] | None
    machine: FoundMachine | None
    signed: bool

    def __call__(
        self, joints: ArrayLike, covariates: ArrayLike | None = None, ways: Collection[str] = WAYS
    ) -> dict[str, Array]:
        """Commands of ideal joints, and ideal joints were they commands.

        Every number is finite for every input. A row in which the file breaks what its card promises, say by a
        deviation above the limit, falls back: the joints are commanded as they are; `FallbackWarning` gives their
        number.

        Args:
            joints: `... x n` [SI].
            covariates: `... x m` [SI] in the order of `covariates`; None where there are none.
            ways: `command`, `back` and `sd`, or those of them that are wanted: each takes its time.

        Returns:
            Of these `command`, `deviation`, `ideal` and `deviation_sd`, `... x n` [SI]; `inside_domain`,
            `ideal_inside_domain` and `fallback`, `...`, bool. A machine has no `deviation_sd`: there is no learner.

        Raises:
            InputError: covariates are missing, or a last dimension is wrong.
            ModelFileError: the machine cannot be commanded.
            MemoryError: the rows do not fit into memory; give fewer at once.
        """
        rows, flat, lead = as_rows(joints, covariates, (self.joints, self.covariates))
        promise = self._promise
        try:
            found = self.run(rows, flat, ways)
        except RUN_ERRORS as reason:
            raise_if_out_of_memory(reason)
            # A graph may take one row and no two.
            found = {}
        checked = kept(found, rows, flat, promise, ways)
        bad = checked["fallback"]
        if bad.any():
            warnings.warn(
                f"{self.path}: in {bad.sum()} of {len(bad)} rows (the first is row {bad.argmax() + 1}) the file breaks "
                "what its card promises (finite, |deviation| within the limit); the joints are commanded as they are "
                "there",
                FallbackWarning,
                stacklevel=2,
            )
        if self.machine is not None:
            checked.pop("deviation_sd", None)
        return {name: value.reshape((*lead, *value.shape[1:])) for name, value in checked.items()}

    def beyond(self, joints: Array, covariates: Array | None) -> set[str]:
        """Names of the inputs that are beyond what was measured, margin included, in one of the rows; and `TOGETHER`
        where each one is within, and several together are not.

        Args:
            joints: as commanded, `s x n` [SI].
            covariates: `s x m` [SI]; None where there are none.
        """
        inputs = joints if covariates is None else np.concatenate([joints, covariates], -1)
        alone, together = np.split(~self._promise.within(self._promise.cleaned(inputs)[0]), 2, axis=-1)
        names = [c.name for c in (*self.joints, *self.covariates)]
        found = {name for k, name in enumerate(names) if alone[:, k].any()}
        return found | ({TOGETHER} if (together.any(-1) & ~alone.any(-1)).any() else set())

    def run(self, joints: Array, covariates: Array | None, ways: Collection[str] = WAYS) -> dict[str, Array]:
        """What the file itself gives for joints `s x n` and covariates `s x m`; raises what it likes."""
        if self.session_of is not None:
            outputs = frozenset(name for way in ways for name in (*NUMBERS[way], *FLAGS.get(way, ())))
            return run_onnx(self.session_of(outputs), joints, covariates)
        import torch

        assert self.compensator is not None
        beside = None if covariates is None else torch.tensor(covariates)
        with torch.no_grad():
            found = self.compensator.run(torch.tensor(joints), beside, ways)
            return {name: value.numpy() for name, value in found.items()}

    @cached_property
    def compensator(self) -> Compensator | None:
        """The torch module; that of a machine is made when it is first asked for. None for exports.

        Raises:
            ModelFileError: the machine cannot be commanded.
        """
        return None if self.make is None else self.make()

    @cached_property
    def _promise(self) -> Promise:
        if self.machine is None:
            return Promise.of_card(self.facts)
        from ccnn_torch.compensation.model_files.master import description_of

        assert self.compensator is not None
        return Promise.of_card(description_of(self.compensator))

    @property
    def columns(self) -> dict[str, str]:
        """The map of columns that its run had: header in a file -> ``name[unit]`` or ``ignore``."""
        return dict(self.card.get("columns") or {})

    @property
    def joint_map(self) -> dict[str, str]:
        """Joint -> sum of columns, where the controller of its run counts otherwise."""
        return dict(self.card.get("joint_map") or {})

    @cached_property
    def region(self) -> Array:
        """Lowest and highest joints of the domain, `n x 2` [SI]; of a machine those measured, or of its workspace."""
        if self.machine is None:
            edges = [self.facts["domain"]["inputs"][c.name] for c in self.joints]
            return np.array([[edge["low"], edge["high"]] for edge in edges])
        if not len(self.machine.joints):
            from ccnn_torch.compensation.fit import rows_of

            joints = rows_of(self.machine).joints.numpy()
            fine = joints[np.isfinite(joints).all(-1)]
            return np.stack([fine.min(0), fine.max(0)], -1)
        return np.asarray(self.machine.joints)

    @property
    def measured(self) -> Array:
        """Lowest and highest joints of the records, `n x 2` [SI]; the region where these are not known."""
        return np.asarray(self.region if self.machine is None or (m := self.machine.measured) is None else m)

    @property
    def middle(self) -> Array:
        """Joints to begin a search from: middle of those measured, of a machine without any its home, `n` [SI]."""
        if self.machine is None or self.machine.measured is not None:
            return np.asarray(self.measured.mean(-1))
        return np.asarray(self.machine.nominal.home_joints)

    def back(self, command: ArrayLike, covariates: ArrayLike | None = None) -> Array:
        """Ideal joints of commands (or of joints fed back), `... x n` [SI]; arguments and errors as a call."""
        return self(command, covariates)["ideal"]

    def mechanism(self, allow_code: bool = False) -> Mechanism:
        """The nominal mechanism that it was made for, its frames as they were fitted then.

        Raises:
            InputError: it is a user's own and `allow_code` is not given, or its file is missing.
        """
        from ccnn_torch.mechanisms import mechanism_from_description

        with code_refused(f"{self.path}: its mechanism", allow_code):
            return mechanism_from_description(self.facts["mechanism"], allow_code=True)

    def identified(self, allow_code: bool = False) -> Mechanism:
        """The machine with identified parameters as its nominal ones, without effects; errors as of `mechanism`."""
        if self.machine is not None:
            return self.machine.identified
        mechanism = self.mechanism(allow_code)
        values = self.facts.get("machine", {}).get("identified")
        return mechanism if values is None else mechanism.with_nominal(mechanism.nominal.new_tensor(values))


def read_model(path: Path) -> bytes:
    """The file's bytes.

    Raises:
        ModelFileError: its name is of another kind of file, it cannot be read, or is empty.
    """
    if path.suffix == ".pt2":
        raise ModelFileError(
            f"{path}: a .pt2 is never read back, because opening one can run code that it contains; give the "
            ".safetensors or .onnx beside it, or, if you trust its author, open it yourself in Python: "
            f"torch.export.load({str(path)!r}).module()"
        )
    if path.suffix not in MODEL_FORMS:
        raise ModelFileError(f"{path}: a model file ends in {' or '.join(MODEL_FORMS)}, not in '{path.suffix}'")
    if path.exists() and not path.is_file():
        raise ModelFileError(f"{path}: is no file; give a {' or '.join(MODEL_FORMS)}")
    try:
        content = path.read_bytes()
    except OSError as reason:
        raise ModelFileError(f"{path}: cannot be read: {reason.strerror}; give a {' or '.join(MODEL_FORMS)}") from None
    if not content:
        raise ModelFileError(f"{path}: the file is empty; take it again from where it was written")
    return content


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
            if path.suffix == ".safetensors":
                from ccnn_torch.compensation.model_files.master import open_master

                facts, compensator = open_master(content)
                runs: dict[str, Any] = {"make": lambda: compensator, "session_of": None}
            else:
                facts, session_of = open_export(content)
                runs = {"make": None, "session_of": session_of}
    except InputError as reason:
        raise ModelFileError(f"{path}: {reason}") from None
    different = [key for key in facts if card.get(key) != facts[key]]
    if different:
        raise ModelFileError(
            f"{path}: its card says something else about '{different[0]}' than the file; the card was edited or "
            "belongs to another run: take both again from where they were written"
        )
    named: dict[str, Any] = {key: coordinates(facts[key]) for key in ("joints", "covariates", "pose")}
    model = LoadedModel(path, card, facts, **named, **runs, machine=None, signed=public_key is not None)
    n, centre = len(model.joints), model._promise.centre[None]
    try:
        model.run(centre[:, :n], centre[:, n:] if model.covariates else None)
    except RUN_ERRORS as reason:
        raise_if_out_of_memory(reason)
        raise ModelFileError(f"{path}: cannot be run ({said(reason)})" + TAKE_AGAIN) from None
    return model


def load_compensation(
    path: str | Path, *, public_key: str | Path | None = None, allow_code: bool = False
) -> LoadedModel:
    """A model file (.safetensors, .onnx) or an identified machine (.yaml, .json), by what the name ends in.

    Args:
        path: the file.
        public_key, allow_code: as `load_model`.

    Raises:
        ModelFileError, InputError: see `load_model` and `load_geometry`.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in (*MACHINE_FORMS, *MODEL_FORMS, ".pt2") and Path(path).is_file():
        raise ModelFileError(
            f"{path}: is no model file; one ends in {', '.join(MODEL_FORMS)}, or is an identified.yaml"
        )
    load = load_model
    if suffix in MACHINE_FORMS:
        from ccnn_torch.compensation.model_files.identified import load_geometry

        load = load_geometry
    return load(path, public_key=public_key, allow_code=allow_code)
