"""Neural compensation of robot kinematics: every source of error as one deviation of the actuated joints."""

__version__ = "0.1.0"
