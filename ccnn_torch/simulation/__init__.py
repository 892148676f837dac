"""Machines that differ from their nominal model, and their measurement.

`job` puts effects of the library on a machine (`ccnn simulate`). `case_study` has the two case studies of the paper,
whose deviations are given functions of time. `realistic` has machines with causes of their own formulas, so
that the suite judges the effects and learners by errors that were not made by `effects/`. Both give a calibration the
same `Simulation`. `places` has what `identification.simulated` draws its machines with: their error is in the
parameters, and it is known exactly.
"""
