"""Signatures of model files by Ed25519 (RFC 8032): who passed a model on, and that nothing was changed since."""

from __future__ import annotations

import binascii
import hashlib
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ccnn_torch.errors import InputError, ModelFileError

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

# What is signed begins with it, so that no signature made for another purpose is one of a model.
_PURPOSE = b"ccnn_torch model signature 1\n"


def signature_path(model: Path) -> Path:
    """`model.onnx.sig` of `model.onnx`."""
    return model.with_name(model.name + ".sig")


def new_key_pair(name: str | Path) -> tuple[Path, Path]:
    """Write NAME.private.pem, which its owner alone can read, and NAME.public.pem; returns both paths.

    Raises:
        InputError: one of the files is there already, or cannot be written.
    """
    _, ed25519, serialization = _cryptography()
    private, public = Path(f"{name}.private.pem"), Path(f"{name}.public.pem")
    for path in (private, public):
        if path.exists():
            raise InputError(f"{path}: is there already, and a key is never overwritten; give another name")
    key = ed25519.Ed25519PrivateKey.generate()
    pem, plain = serialization.Encoding.PEM, serialization.NoEncryption()
    contents = {
        private: (key.private_bytes(pem, serialization.PrivateFormat.PKCS8, plain), 0o600),
        public: (key.public_key().public_bytes(pem, serialization.PublicFormat.SubjectPublicKeyInfo), 0o644),
    }
    for path, (content, mode) in contents.items():
        try:
            # Never open to others, not even for a moment, and never over a file that has just appeared.
            with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as stream:
                stream.write(content)
        except OSError as reason:
            raise InputError(f"{path}: cannot be written: {reason.strerror}") from None
    return private, public


def sign_content(model: bytes, card: bytes, key: str | Path) -> bytes:
    """The text of a signature file: of a model's bytes and its card's, by the private key in a PEM file."""
    _, ed25519, serialization = _cryptography()
    content = _read_key(key)
    try:
        private: Any = serialization.load_pem_private_key(content, None)
    except TypeError:
        raise InputError(f"{key}: is locked by a password; give a private key without one") from None
    except _key_errors():
        private = None
    if not isinstance(private, ed25519.Ed25519PrivateKey):
        raise InputError(f"{key}: is no private Ed25519 key in PEM; make one with ccnn sign --new-key NAME")
    found: Ed25519PrivateKey = private
    return found.sign(_message(model, card)).hex().encode() + b"\n"


def check_signature(path: Path, model: bytes, card: bytes, key: str | Path) -> None:
    """Refuse a model without a signature by this key.

    Args:
        model, card: bytes of either file, as they are going to be used.
        key: PEM file with the public key.

    Raises:
        InputError: the key cannot be read, or is no public Ed25519 key.
        ModelFileError: there is no signature, or it is not one of this key over this model and card.
    """
    exceptions, ed25519, serialization = _cryptography()
    content = _read_key(key)
    try:
        public: Any = serialization.load_pem_public_key(content)
    except _key_errors():
        public = None
    if not isinstance(public, ed25519.Ed25519PublicKey):
        raise InputError(f"{key}: is no public Ed25519 key in PEM; ask whoever signed the model for it")
    found: Ed25519PublicKey = public
    beside = signature_path(path)
    try:
        signature = binascii.unhexlify(beside.read_bytes().strip())
    except OSError:
        raise ModelFileError(
            f"{path}: has no signature {beside.name} beside it; take it from whoever signed the model, or leave out "
            "the public key to trust the card alone"
        ) from None
    except ValueError:
        raise ModelFileError(f"{beside}: is no signature; take it again from whoever signed the model") from None
    try:
        found.verify(signature, _message(model, card))
    except exceptions.InvalidSignature:
        raise ModelFileError(
            f"{path}: its signature {beside.name} is not one of {key} over this model and its card: one of them was "
            "changed, or another key signed; take all again from whoever signed the model"
        ) from None


def _message(model: bytes, card: bytes) -> bytes:
    return _PURPOSE + hashlib.sha256(model).digest() + hashlib.sha256(card).digest()


def _read_key(path: str | Path) -> bytes:
    try:
        return Path(path).read_bytes()
    except OSError as reason:
        raise InputError(f"{path}: the key cannot be read: {reason.strerror}") from None


def _key_errors() -> tuple[type[Exception], ...]:
    exceptions, _, _ = _cryptography()
    return ValueError, exceptions.UnsupportedAlgorithm


def _cryptography() -> tuple[Any, Any, Any]:
    """Modules of the extra `sign`; a model is loaded without it where no key is given."""
    try:
        from cryptography import exceptions
        from cryptography.hazmat.primitives import serialization
        from cryptography.hazmat.primitives.asymmetric import ed25519
    except ImportError:
        raise InputError("signatures need the package cryptography: pip install 'ccnn-torch[sign]'") from None
    return exceptions, ed25519, serialization
