"""Evolution of networks: genomes, encoding, operators, joined evaluation, coevolution, refinement, masked networks."""

from ccnn_torch.evolution.coevolution import Coevolution as Coevolution
from ccnn_torch.evolution.genome import Genome as Genome
from ccnn_torch.evolution.masked_network import MaskedNetwork as MaskedNetwork
from ccnn_torch.evolution.network import alive_nodes as alive_nodes, forward as forward, prune as prune
from ccnn_torch.evolution.refinement import refine as refine
from ccnn_torch.evolution.settings import CCNNSettings as CCNNSettings
