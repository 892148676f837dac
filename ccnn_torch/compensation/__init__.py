"""Compensator (guard, limit, fixed point), its hook on inverse kinematics, and model files."""

from ccnn_torch.doors import door

TYPE_CHECKING = False
if TYPE_CHECKING:
    from ccnn_torch.compensation.any_machine import build_machine as build_machine, machine_of as machine_of
    from ccnn_torch.compensation.compensator import (
        Compensator as Compensator,
        Solution as Solution,
    )
    from ccnn_torch.compensation.domain import Domain as Domain
    from ccnn_torch.compensation.effects import (
        PhysicalEffects as PhysicalEffects,
        expand_effects as expand_effects,
    )
    from ccnn_torch.compensation.expansions import expand as expand
    from ccnn_torch.compensation.fit import fit_compensator as fit_compensator
    from ccnn_torch.compensation.machine import Machine as Machine, Rule as Rule
    from ccnn_torch.compensation.model_files.identified import sign_model as sign_model
    from ccnn_torch.compensation.model_files.load import (
        LoadedModel as LoadedModel,
        load_compensation as load_compensation,
        load_model as load_model,
    )
    from ccnn_torch.compensation.model_files.save import (
        FORMS as FORMS,
        card_name as card_name,
        save_model as save_model,
    )
    from ccnn_torch.compensation.model_files.signature import new_key_pair as new_key_pair
    from ccnn_torch.compensation.networks import (
        UncertainNetwork as UncertainNetwork,
        network_from_description as network_from_description,
        register_network as register_network,
    )
    from ccnn_torch.compensation.targets.export import export_model as export_model
else:
    __getattr__, __all__ = door(__name__)
