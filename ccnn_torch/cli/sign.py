"""`ccnn sign`: sign a model file, and make the keys for it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ccnn_torch.errors import InputError


def sign(
    model: Annotated[Path | None, typer.Argument(help="A .safetensors or .onnx file, or identified.yaml.")] = None,
    key: Annotated[Path | None, typer.Option("--key", metavar="PRIVATE.pem", help="Private Ed25519 key.")] = None,
    new_key: Annotated[str | None, typer.Option("--new-key", metavar="NAME", help="Make a pair of keys.")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing.")] = False,
) -> None:
    """Sign a model and its card with Ed25519: by MODEL.sig and the public key others verify that neither was changed.

    With --new-key it writes NAME.private.pem, which you keep secret, and NAME.public.pem, which you give to the users
    of your models; they run ccnn compensate MODEL … --public-key NAME.public.pem. A signature covers one file and its
    card: sign again whenever the model is rewritten. It needs pip install 'ccnn-torch[sign]'.

    Examples:

    ccnn sign --new-key our_robots

    ccnn sign runs/ur10/model.onnx --key our_robots.private.pem
    """
    if (model is None) == (new_key is None) or (model is None) != (key is None):
        raise InputError("ccnn sign takes either MODEL and --key PRIVATE.pem, or --new-key NAME alone")
    from ccnn_torch.compensation import new_key_pair, sign_model

    if new_key is not None:
        private, public = new_key_pair(new_key)
        message = f"{private}: keep it secret. {public}: give it to the users of your models."
    else:
        assert model is not None and key is not None
        message = f"{sign_model(model, key)}: written; pass it on with {model.name} and its card."
    if not quiet:
        typer.echo(message)
