"""Compensator (guard, limit, fixed point), its hook on inverse kinematics, and model files."""

from ccnn_torch.compensation.compensator import Compensator as Compensator
from ccnn_torch.compensation.compensator import Solution as Solution
from ccnn_torch.compensation.compensator import default_limit as default_limit
from ccnn_torch.compensation.compensator import fit_compensator as fit_compensator
from ccnn_torch.compensation.domain import Domain as Domain
from ccnn_torch.compensation.effects.effects import Care as Care
from ccnn_torch.compensation.effects.effects import PhysicalEffects as PhysicalEffects
from ccnn_torch.compensation.effects.effects import effect_deviation as effect_deviation
from ccnn_torch.compensation.effects.effects import expand_effects as expand_effects
from ccnn_torch.compensation.effects.settled import settled_effects as settled_effects
from ccnn_torch.compensation.geometry.identified import Geometry as Geometry
from ccnn_torch.compensation.geometry.identified import fit_geometry_module as fit_geometry_module
from ccnn_torch.compensation.geometry.identified import geometric_deviation as geometric_deviation
from ccnn_torch.compensation.geometry.identified import settled_damping as settled_damping
from ccnn_torch.compensation.model_files.identified import IdentifiedGeometry as IdentifiedGeometry
from ccnn_torch.compensation.model_files.identified import load_compensation as load_compensation
from ccnn_torch.compensation.model_files.identified import sign_model as sign_model
from ccnn_torch.compensation.model_files.load import LoadedModel as LoadedModel
from ccnn_torch.compensation.model_files.load import load_model as load_model
from ccnn_torch.compensation.model_files.save import FORMS as FORMS
from ccnn_torch.compensation.model_files.save import card_name as card_name
from ccnn_torch.compensation.model_files.save import save_model as save_model
from ccnn_torch.compensation.model_files.signature import new_key_pair as new_key_pair
from ccnn_torch.compensation.networks import UncertainNetwork as UncertainNetwork
from ccnn_torch.compensation.networks import network_from_description as network_from_description
from ccnn_torch.compensation.networks import register_network as register_network
