"""`ccnn sign`: a signature beside a model that is passed on, and the keys for it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ccnn_torch.errors import InputError

__all__ = ["sign"]


def sign(
    model: Annotated[Path | None, typer.Argument(help="A .safetensors or .onnx file, or identified.yaml.")] = None,
    key: Annotated[Path | None, typer.Option("--key", metavar="PRIVATE.pem", help="Private Ed25519 key.")] = None,
    new_key: Annotated[str | None, typer.Option("--new-key", metavar="NAME", help="Make a pair of keys.")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Say nothing.")] = False,
) -> None:
    """Sign a model and its card by Ed25519: MODEL.sig tells whoever has the public key that neither was changed.

    With --new-key it writes NAME.private.pem, which is yours alone, and NAME.public.pem, which you give to those who
    use your models; they run ccnn compensate MODEL … --public-key NAME.public.pem. A signature is of one file and the
    card as they are: sign again after a model was written again. It needs pip install 'ccnn-torch[sign]'.

    Examples:

    ccnn sign --new-key our_robots

    ccnn sign runs/ur10/model.onnx --key our_robots.private.pem
    """
    if (model is None) == (new_key is None) or (model is None) != (key is None):
        raise InputError("ccnn sign takes either MODEL and --key PRIVATE.pem, or --new-key NAME alone")
    from ccnn_torch.compensation import new_key_pair, sign_model

    if new_key is not None:
        private, public = new_key_pair(new_key)
        said = f"{private}: keep it to yourself. {public}: give it to those who use your models."
    else:
        assert model is not None and key is not None
        said = f"{sign_model(model, key)}: written; pass it on with {model.name} and its card."
    if not quiet:
        typer.echo(said)
