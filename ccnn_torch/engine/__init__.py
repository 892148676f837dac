"""Where jobs run: in this process, in processes of this machine, or on a Dask cluster."""

from ccnn_torch.engine.engine import Engine, check_engine
from ccnn_torch.engine.jobs import Failure, Job, run_jobs

__all__ = ["Engine", "Failure", "Job", "check_engine", "run_jobs"]
