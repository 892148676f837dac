"""Reading a model file's bytes and the card in its folder that vouches for them by SHA-256."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from ccnn_torch.compensation.model_files.metadata import from_json
from ccnn_torch.errors import ModelFileError

MODEL_FORMS = (".safetensors", ".onnx")


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


def card_of(path: Path, content: bytes) -> tuple[dict[str, Any], bytes]:
    """The card in the file's folder that lists the SHA-256 of these bytes, under any name; and the card's bytes.

    Raises:
        ModelFileError: there is none, or a card is damaged.
    """
    digest = hashlib.sha256(content).hexdigest()
    names = sorted({path.parent / "card.json", *path.parent.glob("*.card.json")})
    present = [name for name in names if name.is_file()]
    if not present:
        raise ModelFileError(
            f"{path}: there is no card.json beside it to vouch for it; copy the card from the folder it was written "
            "to, or name a model file"
        )
    for name in present:
        try:
            text = name.read_bytes()
            card = from_json(text)
        except OSError as reason:
            raise ModelFileError(f"{name}: cannot be read: {reason.strerror}") from None
        except ValueError:
            raise ModelFileError(f"{name}: this card is damaged; take it again from where it was written") from None
        files = card.get("files") if isinstance(card, dict) else None
        if isinstance(files, dict) and digest in files.values():
            found: dict[str, Any] = card
            for key in ("columns", "joint_map"):
                told = found.get(key) or {}
                if not isinstance(told, dict) or not all(isinstance(value, str) for value in told.values()):
                    raise ModelFileError(
                        f"{name}: {key} is no table of names and texts; take the card again from where it was written"
                    )
            return found, text
    raise ModelFileError(
        f"{path}: its SHA-256 is in none of the cards beside it ({', '.join(name.name for name in present)}): the file "
        "is damaged, altered or foreign; take it again from where it was written, with its card"
    )
