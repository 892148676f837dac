"""Whether corrected commands reach the wanted pose: made-up machines, measured rows, true poses after a correction.

`python -m ccnn_validation.delivered` draws machines, calls the program as a user does, and moves the true machines by
the files that it wrote. Beside it stands a least-squares fit in SciPy that knows the form of every error. Whoever wrote
this had read the documentation only: kinematics, errors and random numbers are its own, in numpy and scipy, and nothing
of the package is imported.
"""
