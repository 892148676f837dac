"""The command line: `ccnn COMMAND …` = `python -m ccnn_torch COMMAND …`, one file per command.

Exit codes: 0 done, 2 bad input (one sentence on stderr), 130 interrupted, 1 a bug (with its traceback). `ccnn verify`
also ends with 1 where a promise is not kept.
"""

from ccnn_torch.cli.application import app as app
from ccnn_torch.cli.application import main as main
