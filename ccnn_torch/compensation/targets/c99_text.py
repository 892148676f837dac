"""The parts of the C files that are the same for every model: functions around the programs, self-test, Makefile."""

from __future__ import annotations

__all__ = [
    "COVARIATES",
    "DECLARATIONS",
    "DRIVER",
    "FIXED_POINT",
    "GIVEN",
    "MAKEFILE",
    "SD_DECLARATION",
    "SD_DRIVER",
    "SD_TEST",
    "SECANT",
    "SELFTEST",
    "SMALLER",
]

DECLARATIONS = """/*
 * Command for ideal joints: command + deviation = joints. Returns 0 where the command is inside the domain
 * of the training rows; 1 outside, where the deviation fades into the safe one, or where the model broke
 * its limit, and then command = joints; 2 where an input is not finite or the covariates are missing, and
 * then command = joints, with the middle of the domain for what is no number and its edge for infinity.
 */
int ccnn_compensate(const ccnn_real joints[], const ccnn_real covariates[], ccnn_real command[], ccnn_real deviation[]);

/* The way back: ideal joints of a command, or of joints fed back. Returns the same codes. */
int ccnn_ideal(const ccnn_real command[], const ccnn_real covariates[], ccnn_real joints[]);
"""

SD_DECLARATION = """
/* Standard deviation of a newly measured deviation at a command, model and noise. Returns the same codes. */
int ccnn_deviation_sd(const ccnn_real command[], const ccnn_real covariates[], ccnn_real sd[]);
"""

SMALLER = """static inline ccnn_real ccnn_{name}(ccnn_real a, ccnn_real b)
{{
    return a {sign} b ? a : b;
}}
"""

COVARIATES = {"@X@": ", x", "@XSET@": ", given", "@XDECLARE@": "    ccnn_real x[CCNN_COVARIATES];\n"}

GIVEN = """    ccnn_real given[CCNN_COVARIATES];
    for (int j = 0; j < CCNN_COVARIATES; j++) {
        given[j] = covariates == NULL ? (ccnn_real)NAN : covariates[j];
    }
"""

DRIVER = """int ccnn_compensate(const ccnn_real joints[], const ccnn_real covariates[], ccnn_real command[],
                    ccnn_real deviation[])
{
    ccnn_real q[CCNN_JOINTS], at[CCNN_JOINTS], found[CCNN_JOINTS], strange[1], excess[1];
@KEPT@@XDECLARE@@GIVEN@    ccnn_clean(joints@XSET@, q@X@, strange);
    int good = !(strange[0] > @ZERO@);
    if (good) {
        ccnn_deviation(q@X@, found, excess);
        for (int k = 0; k < @STEPS@; k++) {
@NEXT@            for (int j = 0; j < CCNN_JOINTS; j++) {
                at[j] = q[j] - @CORRECTION@[j];
            }
            ccnn_deviation(at@X@, found, excess);
        }
        /* Written so that what is no number is not good. */
        for (int j = 0; j < CCNN_JOINTS; j++) {
            const ccnn_real rounding = @EPS@ * (fabs(q[j]) + fabs(found[j]));
            good = good && fabs(found[j]) <= ccnn_limit[j] && fabs(at[j] + found[j] - q[j]) <= ccnn_slack[j] + rounding;
        }
    }
    for (int j = 0; j < CCNN_JOINTS; j++) {
        command[j] = good ? at[j] : q[j];
        deviation[j] = good ? found[j] : @ZERO@;
    }
    return strange[0] > @ZERO@ ? 2 : (good && excess[0] <= @ZERO@ ? 0 : 1);
}

int ccnn_ideal(const ccnn_real command[], const ccnn_real covariates[], ccnn_real joints[])
{
    ccnn_real q[CCNN_JOINTS], found[CCNN_JOINTS], strange[1], excess[1];
@XDECLARE@@GIVEN@    ccnn_clean(command@XSET@, q@X@, strange);
    ccnn_deviation(q@X@, found, excess);
    int good = !(strange[0] > @ZERO@);
    for (int j = 0; j < CCNN_JOINTS; j++) {
        good = good && fabs(found[j]) <= ccnn_limit[j];
    }
    for (int j = 0; j < CCNN_JOINTS; j++) {
        joints[j] = good ? q[j] + found[j] : q[j];
    }
    return strange[0] > @ZERO@ ? 2 : (good && excess[0] <= @ZERO@ ? 0 : 1);
}
"""

# What changes where steps are those of Broyden's method: the printed function returns what it took, one step on.
SECANT = {
    "@KEPT@": "    ccnn_real correction[CCNN_JOINTS] = {@ZERO@}, steps[@SIZE@] = {@ZERO@};\n"
    "    ccnn_real next[CCNN_JOINTS], done[@SIZE@];\n",
    "@NEXT@": """            ccnn_secant(found, correction, steps, next, done);
            for (int j = 0; j < CCNN_JOINTS; j++) {
                correction[j] = next[j];
            }
            for (int j = 0; j < @SIZE@; j++) {
                steps[j] = done[j];
            }
""",
    "@CORRECTION@": "correction",
}
FIXED_POINT = {"@KEPT@": "", "@NEXT@": "", "@CORRECTION@": "found"}

SD_DRIVER = """
int ccnn_deviation_sd(const ccnn_real command[], const ccnn_real covariates[], ccnn_real sd[])
{
    ccnn_real q[CCNN_JOINTS], found[CCNN_JOINTS], strange[1], excess[1];
@XDECLARE@@GIVEN@    ccnn_clean(command@XSET@, q@X@, strange);
    ccnn_deviation(q@X@, found, excess);
    ccnn_spread(q@X@, found);
    int good = !(strange[0] > @ZERO@);
    for (int j = 0; j < CCNN_JOINTS; j++) {
        good = good && found[j] >= @ZERO@ && found[j] - found[j] == @ZERO@;
    }
    for (int j = 0; j < CCNN_JOINTS; j++) {
        sd[j] = good ? found[j] : ccnn_fallback_sd[j];
    }
    return strange[0] > @ZERO@ ? 2 : (good && excess[0] <= @ZERO@ ? 0 : 1);
}
"""

SD_TEST = """        bad += ccnn_deviation_sd(given, x, found) != golden_ideal_status[k];
        for (int j = 0; j < CCNN_JOINTS; j++) {
            const ccnn_real sd = golden_sd[k * CCNN_JOINTS + j];
            bad += !(fabs(found[j] - sd) <= tolerance[j] + @RELATIVE@ * sd);
        }
"""

SELFTEST = """/* Golden vectors of the model: random, edges of the domain, far outside, no numbers and infinities. */
#include "compensator.h"

#include <math.h>
#include <stddef.h>
#include <stdio.h>

@TABLES@

static ccnn_real worst = @ZERO@;

/* Whether a number is not the wanted one to the tolerance and `rounding`. */
static int differs(ccnn_real found, ccnn_real wanted, int j, ccnn_real rounding)
{
    const ccnn_real apart = fabs(found - wanted);
    if (rounding <= @ZERO@ && tolerance[j] > @ZERO@ && !(apart / tolerance[j] <= worst)) {
        worst = apart / tolerance[j];
    }
    return !(apart <= tolerance[j] + rounding);
}

int main(void)
{
    int failed = 0;
    for (int k = 0; k < @COUNT@; k++) {
        const ccnn_real *given = golden_joints + k * CCNN_JOINTS;
        const ccnn_real *x = @COVARIATES@;
        ccnn_real command[CCNN_JOINTS], found[CCNN_JOINTS];
        int bad = ccnn_compensate(given, x, command, found) != golden_status[k];
        for (int j = 0; j < CCNN_JOINTS; j++) {
            const ccnn_real wanted = golden_command[k * CCNN_JOINTS + j];
            bad += differs(command[j], wanted, j, @EPS@ * fabs(wanted));
            bad += differs(found[j], golden_deviation[k * CCNN_JOINTS + j], j, @ZERO@);
        }
        bad += ccnn_ideal(given, x, found) != golden_ideal_status[k];
        for (int j = 0; j < CCNN_JOINTS; j++) {
            const ccnn_real wanted = golden_ideal[k * CCNN_JOINTS + j];
            bad += differs(found[j], wanted, j, @EPS@ * fabs(wanted));
        }
@SD@        if (bad && failed++ == 0) {
            printf("vector %d is not the model's\\n", k);
        }
    }
    printf("%d of @COUNT@ vectors failed; largest difference of a deviation %.2g of what is allowed\\n", failed,
           (double)worst);
    return failed > 0;
}
"""

MAKEFILE = """CFLAGS ?= -O2
STRICT = -std=c99 -pedantic -Wall -Wextra -Wconversion -Werror

test: selftest
\t./selftest

selftest: selftest.c compensator.c compensator.h
\t$(CC) $(CFLAGS) $(STRICT) -o $@ selftest.c compensator.c -lm

size: compensator.o
\tsize $<

compensator.o: compensator.c compensator.h
\t$(CC) $(CFLAGS) $(STRICT) -c -o $@ compensator.c

clean:
\trm -f selftest compensator.o

.PHONY: test size clean
"""
