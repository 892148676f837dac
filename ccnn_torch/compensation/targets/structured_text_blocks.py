"""The function blocks around the programs, the self-test and the README of an export as Structured Text."""

from __future__ import annotations

__all__ = [
    "COMPENSATE",
    "FIXED_POINT",
    "IDEAL",
    "README",
    "SD",
    "SECANT",
    "SELFTEST",
]

COMPENSATE = """(* Command for ideal joints: command + deviation = joints. *)
FUNCTION_BLOCK CCNN_Compensate
VAR_INPUT
    joints : ARRAY[0..@N@] OF @REAL@;
    covariates : ARRAY[0..@M@] OF @REAL@;
END_VAR
VAR_OUTPUT
    command : ARRAY[0..@N@] OF @REAL@;
    deviation : ARRAY[0..@N@] OF @REAL@;
    status : INT;
END_VAR
VAR CONSTANT
@CONSTANTS@
END_VAR
VAR
    clean : CCNN_Clean_;
    delta : CCNN_Deviation_;
@KEPT@    here : ARRAY[0..@N@] OF @REAL@;
    rounding : @REAL@;
    good : BOOL;
    j, k : DINT;
END_VAR
clean(joints := joints@GIVEN@);
delta(joints := clean.joints_out@X@);
@BLANK@FOR k := 1 TO @STEPS@ DO
@NEXT@    FOR j := 0 TO @N@ DO
        here[j] := clean.joints_out[j] - @CORRECTION@[j];
    END_FOR
    delta(joints := here@X@);
END_FOR
good := clean.strange_out[0] <= @ZERO@;
FOR j := 0 TO @N@ DO
    rounding := @EPS@ * (ABS(clean.joints_out[j]) + ABS(delta.deviation_out[j]));
    good := good AND (ABS(delta.deviation_out[j]) <= limit[j])
        AND (ABS(here[j] + delta.deviation_out[j] - clean.joints_out[j]) <= slack[j] + rounding);
END_FOR
FOR j := 0 TO @N@ DO
    command[j] := SEL(good, clean.joints_out[j], here[j]);
    deviation[j] := SEL(good, @ZERO@, delta.deviation_out[j]);
END_FOR
IF clean.strange_out[0] > @ZERO@ THEN
    status := 2;
ELSIF good AND (delta.excess_out[0] <= @ZERO@) THEN
    status := 0;
ELSE
    status := 1;
END_IF
END_FUNCTION_BLOCK"""

# What changes where steps are those of Broyden's method.
SECANT = {
    "@KEPT@": """    secant : CCNN_Secant_;
    correction : ARRAY[0..@N@] OF @REAL@;
    steps : ARRAY[0..@LAST@] OF @REAL@;
""",
    "@BLANK@": """FOR j := 0 TO @N@ DO
    correction[j] := @ZERO@;
END_FOR
FOR j := 0 TO @LAST@ DO
    steps[j] := @ZERO@;
END_FOR
""",
    "@NEXT@": """    secant(found := delta.deviation_out, correction := correction, steps := steps);
    FOR j := 0 TO @N@ DO
        correction[j] := secant.correction_out[j];
    END_FOR
    FOR j := 0 TO @LAST@ DO
        steps[j] := secant.steps_out[j];
    END_FOR
""",
    "@CORRECTION@": "correction",
}
FIXED_POINT = {"@KEPT@": "", "@BLANK@": "", "@NEXT@": "", "@CORRECTION@": "delta.deviation_out"}

IDEAL = """(* The way back: ideal joints of a command, or of joints fed back. *)
FUNCTION_BLOCK CCNN_Ideal
VAR_INPUT
    command : ARRAY[0..@N@] OF @REAL@;
    covariates : ARRAY[0..@M@] OF @REAL@;
END_VAR
VAR_OUTPUT
    joints : ARRAY[0..@N@] OF @REAL@;
    status : INT;
END_VAR
VAR CONSTANT
@CONSTANTS@
END_VAR
VAR
    clean : CCNN_Clean_;
    delta : CCNN_Deviation_;
    good : BOOL;
    j : DINT;
END_VAR
clean(joints := command@GIVEN@);
delta(joints := clean.joints_out@X@);
good := clean.strange_out[0] <= @ZERO@;
FOR j := 0 TO @N@ DO
    good := good AND (ABS(delta.deviation_out[j]) <= limit[j]);
END_FOR
FOR j := 0 TO @N@ DO
    joints[j] := SEL(good, clean.joints_out[j], clean.joints_out[j] + delta.deviation_out[j]);
END_FOR
IF clean.strange_out[0] > @ZERO@ THEN
    status := 2;
ELSIF good AND (delta.excess_out[0] <= @ZERO@) THEN
    status := 0;
ELSE
    status := 1;
END_IF
END_FUNCTION_BLOCK"""

SD = """(* Standard deviation of a newly measured deviation at a command, model and noise. *)
FUNCTION_BLOCK CCNN_DeviationSd
VAR_INPUT
    command : ARRAY[0..@N@] OF @REAL@;
    covariates : ARRAY[0..@M@] OF @REAL@;
END_VAR
VAR_OUTPUT
    sd : ARRAY[0..@N@] OF @REAL@;
    status : INT;
END_VAR
VAR CONSTANT
@CONSTANTS@
END_VAR
VAR
    clean : CCNN_Clean_;
    delta : CCNN_Deviation_;
    spread : CCNN_Spread_;
    good : BOOL;
    j : DINT;
END_VAR
clean(joints := command@GIVEN@);
delta(joints := clean.joints_out@X@);
spread(joints := clean.joints_out@X@);
good := clean.strange_out[0] <= @ZERO@;
FOR j := 0 TO @N@ DO
    sd[j] := SEL(good, fallback_sd[j], spread.sd_out[j]);
END_FOR
IF NOT good THEN
    status := 2;
ELSIF delta.excess_out[0] <= @ZERO@ THEN
    status := 0;
ELSE
    status := 1;
END_IF
END_FUNCTION_BLOCK"""

SELFTEST = """(* Some golden vectors of the model: call it once; passed is then TRUE. *)
FUNCTION_BLOCK CCNN_SelfTest
VAR_OUTPUT
    passed : BOOL;
    failed : INT;
END_VAR
VAR CONSTANT
@CONSTANTS@
END_VAR
VAR
    compensate : CCNN_Compensate;
    given : ARRAY[0..@N@] OF @REAL@;@XVAR@
    bad : BOOL;
    j, k : DINT;
END_VAR
failed := 0;
FOR k := 0 TO @LAST@ DO
    FOR j := 0 TO @N@ DO
        given[j] := golden_joints[@COUNT@ * k + j];
    END_FOR@SETX@
    compensate(joints := given@X@);
    bad := compensate.status <> golden_status[k];
    FOR j := 0 TO @N@ DO
        bad := bad OR NOT (ABS(compensate.deviation[j] - golden_deviation[@COUNT@ * k + j]) <= golden_tolerance[j]);
        bad := bad OR NOT (ABS(compensate.command[j] - golden_command[@COUNT@ * k + j])
            <= golden_tolerance[j] + @EPS@ * ABS(given[j]));
    END_FOR
    IF bad THEN
        failed := failed + 1;
    END_IF
END_FOR
passed := failed = 0;
END_FUNCTION_BLOCK"""

README = """# Compensation as Structured Text

`compensator.st` holds function blocks in {real}. `CCNN_Compensate` and `CCNN_Ideal` are for use; those whose names end
in `_` are their parts.

1. TwinCAT 3, CODESYS 3: add one POU (function block) for each FUNCTION_BLOCK; what stands up to the last END_VAR goes
   into the upper window, the statements after it into the lower one.
2. In a cyclic task: `VAR comp : CCNN_Compensate; END_VAR`, then `comp(joints := ideal, covariates := more);` in SI
   units; command the axes by `comp.command`; act on `comp.status` (0 inside, 1 outside, 2 input not finite).
3. TwinCAT: switch off "Floating point exceptions" of the PLC project, since the check for what is no number compares
   it; CODESYS: likewise the FPU exceptions of the runtime.
4. Arrays start as `[a, b]` (IEC 61131-3, third edition); CODESYS 2.3 wants that without brackets.
5. Call `CCNN_SelfTest` of `selftest.st` once after the transfer: `passed` must be TRUE.
"""
