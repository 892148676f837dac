"""Pictures of a run. Each function returns a `Plot`: a matplotlib Figure, a file name and one sentence of caption."""

from ccnn_torch.report.plots._errors import joint_error_plot as joint_error_plot
from ccnn_torch.report.plots._errors import pose_error_plot as pose_error_plot
from ccnn_torch.report.plots._learning import convergence_plot as convergence_plot
from ccnn_torch.report.plots._learning import population_plot as population_plot
from ccnn_torch.report.plots._network import alive_nodes as alive_nodes
from ccnn_torch.report.plots._network import network_plot as network_plot
from ccnn_torch.report.plots._plan import plan_plot as plan_plot
from ccnn_torch.report.plots._progress import progress_plot as progress_plot
from ccnn_torch.report.plots._style import Plot as Plot
from ccnn_torch.report.plots._style import inline_svg as inline_svg
from ccnn_torch.report.plots._style import save_figure as save_figure
from ccnn_torch.report.plots._suite import suite_plot as suite_plot
from ccnn_torch.report.plots._workspace import overview_plot as overview_plot
from ccnn_torch.report.plots._workspace import workspace_plot as workspace_plot
