"""Writing model files: one safetensors master, its exports, and the card that vouches for them all by SHA-256."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from safetensors.torch import save

from ccnn_torch.compensation.compensator import Compensator
from ccnn_torch.compensation.model_files.master import OPTIONAL, fingerprint
from ccnn_torch.compensation.model_files.metadata import METADATA_KEY, to_json
from ccnn_torch.compensation.targets.onnx_export import export_float32, export_onnx
from ccnn_torch.errors import MethodFailedError
from ccnn_torch.files.write import write_whole

FORMS = ("safetensors", "onnx", "float32.onnx")

# Written by this command itself; a field of these names would be lost.
_OWN = ("files", "date", "notes")


def card_name(method: str) -> str:
    """`card.json` for the run's model, `METHOD.card.json` beside it for one of several."""
    return "card.json" if method == "model" else f"{method}.card.json"


def save_model(
    folder: str | Path,
    compensator: Compensator,
    fields: Mapping[str, Any],
    method: str = "model",
    forms: Collection[str] = FORMS,
) -> dict[str, Path]:
    """Write METHOD.safetensors, .onnx, .float32.onnx and the card; each whole or not at all, the card last.

    The master and the exports are byte-identical for one model and one set of fields; what changes from run to run
    is in the card alone.

    Args:
        folder: made where it is not there.
        compensator: fitted.
        fields: `mechanism` (its `describe()`), `metrics`, `data_sha256`, `seed`: these go into every file and must not
            hold times or paths; further ones go into the card alone. An older card may be given: what it says of that
            model's files and numbers is left out.
        method: name of the files.
        forms: which to write; the master is always written, and the exports take seconds each.

    Returns:
        The files by what they are: `safetensors`, `onnx`, `float32.onnx`, `card`. Where single precision cannot
        hold the model, `float32.onnx` is missing and the card's `notes` say so.

    Raises:
        InputError: a field is missing or no JSON, or the network cannot be described.
        MethodFailedError: an export does not give the model's numbers, to 1e-12 of the limit or what the network needs.
    """
    contents = model_contents(compensator, fields, method, forms)
    paths = {kind: Path(folder) / name for kind, (name, _) in contents.items()}
    for kind, (_, content) in contents.items():
        write_whole(paths[kind], content)
    return paths


def model_contents(
    compensator: Compensator, fields: Mapping[str, Any], method: str = "model", forms: Collection[str] = FORMS
) -> dict[str, tuple[str, bytes | str]]:
    """Names and contents of what `save_model` writes, by what they are; arguments and errors as there."""
    facts = fingerprint(compensator, fields)
    text = to_json(facts)
    tensors = {name: value.detach().cpu().contiguous().clone() for name, value in compensator.state_dict().items()}
    contents = {"safetensors": save(tensors, metadata={METADATA_KEY: text})}
    notes = settled_notes(compensator)
    if "onnx" in forms:
        contents["onnx"] = export_onnx(compensator, text)
    if "float32.onnx" in forms:
        try:
            contents["float32.onnx"] = export_float32(compensator, text)
        except MethodFailedError as reason:
            notes.append(f"{method}.float32.onnx was not written: {reason}")
    card = {
        **{key: value for key, value in fields.items() if key not in (*facts, *_OWN, *OPTIONAL)},
        **facts,
        "files": {f"{method}.{kind}": hashlib.sha256(content).hexdigest() for kind, content in contents.items()},
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "notes": notes,
    }
    files = {kind: (f"{method}.{kind}", content) for kind, content in contents.items()}
    return files | {"card": (card_name(method), to_json(card, indent=2) + "\n")}


def settled_notes(compensator: Compensator) -> list[str]:
    """A sentence where the machine's command does not settle everywhere in and around the domain."""
    if not compensator.unsettled:
        return []
    return [
        f"Around the measured region the command does not settle at {compensator.unsettled:.1%} of the poses away from "
        "singular ones, most of them at the edge of the machine's reach; such rows have status 3."
    ]
