"""What a model gives, by what it is asked for, and the status of a command."""

NUMBERS = {"command": ("command", "deviation"), "back": ("ideal",), "sd": ("deviation_sd",)}
FLAGS = {"command": ("inside_domain", "status"), "back": ("ideal_inside_domain", "ideal_status")}
"""Outputs by what is asked for: numbers of each joint; whether it is inside the domain, and its status."""
WAYS = tuple(NUMBERS)
OUTPUTS = (
    "command",
    "deviation",
    "inside_domain",
    "ideal",
    "ideal_inside_domain",
    "deviation_sd",
    "status",
    "ideal_status",
)
EXACT, OUTSIDE, NOT_FINITE, DAMPED = range(4)
"""Status of a command: exact; outside what was measured; an input is not finite, and the command is the joints; damped
near a singular pose, at a limit or not settled, and the command is the nearest safe one."""
