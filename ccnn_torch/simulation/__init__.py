"""Machines that differ from their nominal model, and their measurement.

`job` puts effects of the library on a machine (`ccnn simulate`). `case_study` has the two case studies of the paper,
whose deviations are given functions of time, and the `Simulation` that they and the realistic machines of
`ccnn_validation.realistic` are to a calibration. `places` has what `identification.simulated` draws its machines with:
their error is in the parameters, and it is known exactly.
"""
