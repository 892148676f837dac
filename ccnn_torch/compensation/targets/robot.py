"""Identified geometry for simulators: a machine's corrected parameters as URDF, MuJoCo model and DH table."""

from __future__ import annotations

from ccnn_torch.compensation.model_files.identified import IdentifiedGeometry
from ccnn_torch.compensation.model_files.load import LoadedModel
from ccnn_torch.errors import MethodFailedError
from ccnn_torch.mechanisms import SerialArm
from ccnn_torch.mechanisms.mechanism_file import dh_text, mjcf_text, urdf_text


def print_robot(model: LoadedModel | IdentifiedGeometry) -> dict[str, str]:
    """Contents of the files by name: `robot.urdf`, `robot.xml` (MJCF), and `robot.yaml` where the arm has a DH table.

    Raises:
        MethodFailedError: the model has no identified links, or its machine is no serial arm.
    """
    arm = _arm(model)
    texts = {"robot.urdf": urdf_text(arm), "robot.xml": mjcf_text(arm)}
    return texts if arm.convention == "urdf" else texts | {"robot.yaml": dh_text(arm)}


def _arm(model: LoadedModel | IdentifiedGeometry) -> SerialArm:
    if isinstance(model, IdentifiedGeometry):
        if isinstance(model.identified, SerialArm):
            return model.identified
        raise MethodFailedError(
            f"a URDF is a tree, and '{model.identified.name}' is no serial arm; its parameters are in identified.yaml"
        )
    machine = None if model.compensator is None else model.compensator.machine
    if machine is None or not isinstance(machine.mechanism, SerialArm):
        raise MethodFailedError(
            "this model has no identified links of an arm to write; train with geometry=identify, or give the "
            "identified.yaml of ccnn identify"
        )
    arm = machine.real
    assert isinstance(arm, SerialArm)
    return arm
