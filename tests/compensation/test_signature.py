"""Signed models: what was changed on the way, or signed by somebody else, is refused."""

from __future__ import annotations

import builtins
import json
import shutil
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from stand_ins import tripod_joints

from ccnn_torch.compensation import load_compensation, load_model, new_key_pair, sign_model
from ccnn_torch.errors import InputError, ModelFileError
from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.mechanisms.mechanism_file import mechanism_text
from ccnn_torch.records import write_table
from ccnn_torch.verification.promise import promise_of

Cli = Callable[..., tuple[int, str, str]]


@pytest.fixture
def copied(folder: Path, tmp_path: Path) -> Path:
    shutil.copytree(folder, tmp_path / "copy")
    return tmp_path / "copy"


@pytest.fixture
def keys(tmp_path: Path) -> tuple[Path, Path]:
    return new_key_pair(tmp_path / "ours")


def test_from_a_new_key_to_a_checked_command(copied: Path, tmp_path: Path, cli: Cli, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    joints = tripod_joints(4).numpy()
    write_table(tmp_path / "in.csv", {f"q{k + 1}[m]": joints[:, k] for k in range(3)})
    code, out, err = cli("sign", "--new-key", "ours")
    assert (code, err) == (0, "") and "ours.private.pem: keep it secret" in out
    assert stat.S_IMODE((tmp_path / "ours.private.pem").stat().st_mode) == 0o600
    for form in ("safetensors", "onnx"):
        model = copied / f"model.{form}"
        use = ("compensate", model, "in.csv", "out.csv", "--public-key", "ours.public.pem")
        code, _, err = cli(*use)
        assert code == 2 and f"has no signature model.{form}.sig beside it" in err and len(err.splitlines()) == 1
        code, out, err = cli("sign", model, "--key", "ours.private.pem")
        assert (code, err) == (0, "") and f"model.{form}.sig: written" in out
        assert cli(*use)[0] == 0
        assert load_model(model, public_key="ours.public.pem").card["seed"] == 4
    code, _, err = cli("sign", "--new-key", "ours")
    assert code == 2 and "is there already, and a key is never overwritten" in err
    for words in (("sign",), ("sign", model), ("sign", model, "--new-key", "x"), ("sign", "--key", "ours.private.pem")):
        code, _, err = cli(*words)
        assert code == 2 and "either MODEL and --key PRIVATE.pem, or --new-key NAME alone" in err


def test_whatever_was_changed_is_refused(copied: Path, keys: tuple[Path, Path]) -> None:
    private, public = keys
    model = copied / "model.onnx"
    signature = sign_model(model, private)
    load_model(model, public_key=public)
    card = copied / "card.json"
    good = card.read_text()
    told = json.loads(good)
    # What only the card says: nothing but the signature vouches for it.
    card.write_text(json.dumps(told | {"notes": ["tested by the maker"]}))
    load_model(model)
    with pytest.raises(ModelFileError, match="over this model and its card: one of them was changed"):
        load_model(model, public_key=public)
    card.write_text(good)
    # Another model of the same folder under this one's name.
    arm = copied / "arm.onnx"
    shutil.copy(signature, copied / "arm.onnx.sig")
    with pytest.raises(ModelFileError, match="one of them was changed"):
        load_model(arm, public_key=public)
    content = signature.read_bytes()
    for wrong in (content[:-4], b"", b"no signature", b"00" * 64, content[::-1]):
        signature.write_bytes(wrong)
        with pytest.raises(ModelFileError, match=r"is no signature|one of them was changed"):
            load_model(model, public_key=public)
    signature.write_bytes(content)
    load_model(model, public_key=public)


def test_another_key_and_files_that_are_no_keys(copied: Path, keys: tuple[Path, Path], tmp_path: Path) -> None:
    private, public = keys
    model = copied / "model.safetensors"
    sign_model(model, private)
    theirs = new_key_pair(tmp_path / "theirs")[1]
    with pytest.raises(ModelFileError, match=r"is not one of .*theirs\.public\.pem"):
        load_model(model, public_key=theirs)
    for wrong in (private, model, copied / "card.json"):
        with pytest.raises(InputError, match="is no public Ed25519 key in PEM"):
            load_model(model, public_key=wrong)
    with pytest.raises(InputError, match=r"no\.pem: the key cannot be read: No such file"):
        load_model(model, public_key=tmp_path / "no.pem")
    for wrong in (public, model):
        with pytest.raises(InputError, match="is no private Ed25519 key in PEM"):
            sign_model(model, wrong)


def test_keys_of_other_kinds_and_locked_ones(copied: Path, tmp_path: Path) -> None:
    from cryptography.hazmat.primitives import serialization
    from cryptography.hazmat.primitives.asymmetric import ec, ed25519

    pem, pkcs8 = serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8
    curve, locked = tmp_path / "curve.pem", tmp_path / "locked.pem"
    curve.write_bytes(ec.generate_private_key(ec.SECP256R1()).private_bytes(pem, pkcs8, serialization.NoEncryption()))
    secret = serialization.BestAvailableEncryption(b"secret")
    locked.write_bytes(ed25519.Ed25519PrivateKey.generate().private_bytes(pem, pkcs8, secret))
    for path, sentence in ((curve, "is no private Ed25519 key"), (locked, "is locked by a password")):
        with pytest.raises(InputError, match=sentence):
            sign_model(copied / "model.onnx", path)


def test_an_identified_machine_is_signed_without_a_card(tmp_path: Path, keys: tuple[Path, Path]) -> None:
    private, public = keys
    mechanism, path = load_mechanism("tripod"), tmp_path / "identified.yaml"
    with pytest.raises(ModelFileError, match="there is no such file"):
        sign_model(path, private)
    path.write_text(mechanism_text(mechanism, dict(zip("Lr", mechanism.nominal.tolist(), strict=True))))
    with pytest.raises(ModelFileError, match="has no signature"):
        load_compensation(path, public_key=public)
    assert sign_model(path, private).name == "identified.yaml.sig"
    signed = load_compensation(path, public_key=public)
    # No signature covers the identified.json beside it.
    entries = {name: {"value": value} for name, value in zip("Lr", mechanism.nominal.tolist(), strict=True)}
    figures = {"promise": {"rows": 7}, "parameters": entries}
    path.with_suffix(".json").write_text(json.dumps(figures), encoding="utf-8")
    assert promise_of(load_compensation(path)) == {"rows": 7} and promise_of(signed) is None
    path.write_text(path.read_text().replace("value: 1.0", "value: 1.1"))
    with pytest.raises(ModelFileError, match="one of them was changed"):
        load_compensation(path, public_key=public)


def test_a_file_that_no_card_vouches_for_is_not_signed(copied: Path, keys: tuple[Path, Path]) -> None:
    (copied / "model.onnx").write_bytes(b"something else")
    with pytest.raises(ModelFileError, match="SHA-256 is in none of the cards"):
        sign_model(copied / "model.onnx", keys[0])
    with pytest.raises(ModelFileError, match="never read back"):
        sign_model(copied / "model.pt2", keys[0])


def test_without_the_extra_there_is_one_sentence(copied: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def missing(name: str, *rest: Any, **keys: Any) -> Any:
        if name.startswith("cryptography"):
            raise ImportError(name)
        return real(name, *rest, **keys)

    monkeypatch.setattr(builtins, "__import__", missing)
    load_model(copied / "model.safetensors")
    with pytest.raises(InputError, match=r"pip install 'ccnn-torch\[sign\]'"):
        load_model(copied / "model.safetensors", public_key="any.pem")
    with pytest.raises(InputError, match=r"pip install 'ccnn-torch\[sign\]'"):
        new_key_pair("any")
