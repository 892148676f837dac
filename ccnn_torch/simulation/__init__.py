"""Machines that differ from their nominal model, and their measurement.

`job` puts effects of the library on a machine (`ccnn simulate`). `cases` has the two case studies of the paper, whose
deviations are given functions of time. `machines/` has realistic machines with causes of their own formulas, so that
the suite judges the effects and learners by errors that were not made by `effects/`. All three give a calibration the
same `Simulation` (`case_study`). `places`, `instrument` and `random_numbers` are the parts that
`identification.simulated` draws its machines with: their error is in the parameters, and it is known exactly.
"""
