"""The run folder: where each file of a run stands."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from ccnn_torch.errors import InputError
from ccnn_torch.training import write_whole

__all__ = ["RunFolder"]


@dataclass(frozen=True)
class RunFolder:
    """Paths inside one run folder. `results.json` is written last: a folder that has it is finished."""

    path: Path

    @classmethod
    def create(cls, out: str | None, name: str, resume: str = "ccnn run --resume") -> RunFolder:
        """Make the folder `out`, or `runs/NAME-STAMP`; `resume` is the command that goes on in a folder.

        Raises:
            InputError: the folder holds files already, or cannot be made.
        """
        path = Path(out) if out else Path("runs") / f"{name}-{datetime.now():%Y%m%d-%H%M%S}"
        try:
            if path.exists() and (not path.is_dir() or any(path.iterdir())):
                raise InputError(
                    f"{path} holds files already; give another folder with out=…, "
                    f"or go on with that run: {resume} {path}"
                )
            path.mkdir(parents=True, exist_ok=True)
        except OSError as problem:
            raise InputError(f"{path} cannot be made ({problem.strerror}); give another folder with out=…") from None
        return cls(path)

    @classmethod
    def existing(cls, path: Path) -> RunFolder:
        """A folder to resume.

        Raises:
            InputError: there is no run in it.
        """
        if not (path / "config.yaml").is_file():
            raise InputError(f"{path} has no config.yaml, so there is no run to resume; name a folder made by ccnn run")
        return cls(path)

    @property
    def config(self) -> Path:
        return self.path / "config.yaml"

    @property
    def results(self) -> Path:
        return self.path / "results.json"

    @property
    def auto(self) -> Path:
        """What `methods=auto` has decided so far."""
        return self.path / "auto.json"

    @property
    def finished(self) -> bool:
        return self.results.is_file()

    @property
    def tensorboard(self) -> Path:
        return self.path / "tensorboard"

    @property
    def models(self) -> Path:
        return self.path / "models"

    def checkpoint(self, method: str, phase: str) -> Path:
        return self.path / "checkpoints" / f"{method}-{phase}.safetensors"

    def write_text(self, name: str, content: str) -> None:
        write_whole(self.path / name, content.encode())
