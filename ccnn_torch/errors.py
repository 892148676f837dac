"""Typed errors. Each carries one clear sentence that names the file, row, column or key, and what would be right."""

from __future__ import annotations

_NO_MEMORY = ("can't allocate memory", "Failed to allocate memory", "bad_alloc", "not enough memory", "out of memory")


class CcnnError(Exception):
    """Anything this package raises on purpose."""


class InputError(CcnnError):
    """Bad input from outside: records, a config, a mechanism file. The command line shows it and exits with 2."""


class RowsError(InputError):
    """Too few rows, or rows out of reach. If they are from a file, it is named."""


class WriteError(InputError):
    """A file or folder cannot be written: the disk is full, or permission is missing. An old file is unchanged."""


class ModelFileError(InputError):
    """A model file or its card is damaged, foreign, tampered with, or made for another mechanism."""


class MethodFailedError(CcnnError):
    """A learner could not be trained on this data; a run notes the sentence in its results and continues. Or the first
    method of an identification did not converge: its files are there, and the command exits with 2."""


class FallbackWarning(UserWarning):
    """A model file gave a command outside the limits in its card; the joints are then commanded without correction."""


def out_of_memory(problem: Exception) -> bool:
    """Whether an error says that memory could not be had, in the words of Python, torch or ONNX Runtime."""
    return isinstance(problem, MemoryError) or any(words in str(problem) for words in _NO_MEMORY)


def raise_if_out_of_memory(problem: Exception) -> None:
    """Raise MemoryError where an error says that memory could not be had: no fault of the file that was read."""
    if out_of_memory(problem):
        raise MemoryError from None


class OutsideDomainWarning(UserWarning):
    """A command is outside the domain that a compensator was trained on; the safe correction is used there."""
