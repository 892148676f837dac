"""The parts of the LinuxCNC component that are the same for every model, and its README."""

from __future__ import annotations

__all__ = ["COMPONENT", "NOTHING", "ONE_WAY", "README", "SERIAL_WAY", "VECTOR"]

COMPONENT = """component ccnnkins "Kinematics with learned compensation";
description
\"\"\"
Nominal kinematics of the machine, and the compensation of its joints around them. Forward kinematics begin with the
way back of the compensation. Add the function to the servo thread, so that its pins are served.
\"\"\";
pin out s32 state "0 inside the domain, 1 outside or fallback, 2 an input is not finite, -1 no joints for this pose";
@PINS@function serve;
license "GPL";
option singleton yes;
;;
/*
@ABOUT@
 *
 * Machine units of LinuxCNC: millimetres and degrees. Change CCNN_UNITS_PER_METRE for LINEAR_UNITS = inch.
 */
#include <rtapi.h>
#include <rtapi_app.h>
#include <rtapi_math.h>
#include <hal.h>
#include <kinematics.h>
#include <float.h>
#include <stddef.h>

#ifndef NAN
#define NAN (__builtin_nan(""))
#endif
#ifndef INFINITY
#define INFINITY (__builtin_inf())
#endif

#define CCNN_UNITS_PER_METRE 1000.0
#define CCNN_DEGREES 57.295779513082323

typedef double ccnn_real;

enum { CCNN_JOINTS = @N@, CCNN_COVARIATES = @K@ };

@SOURCE@
@NOMINAL@

/* Rows of what is solved for: a pose or the joints. */
enum { CCNN_ROWS = @P@ };

static const double ccnn_units[CCNN_JOINTS] = { @UNITS@ };
/* Where a search starts: the last one found, at first the middle of the workspace. */
static double ccnn_last[CCNN_JOINTS] = { @HOME@ };
static double ccnn_covariates[@M@] = { @UNREAD@ };
static int ccnn_state = 0;

static void ccnn_gap(const double at[], const double wanted[], double gap[]);

/* Gauss-Newton with differences and a little damping, from ccnn_last. Returns 0, or -1 where nothing is found. */
static int ccnn_solve(const double wanted[], double found[])
{
    double gap[CCNN_ROWS], moved[CCNN_ROWS], slope[CCNN_ROWS][CCNN_JOINTS];
    double normal[CCNN_JOINTS][CCNN_JOINTS + 1], step[CCNN_JOINTS], left = 0.0;
    int i, j, k, times;
    for (j = 0; j < CCNN_JOINTS; j++) found[j] = ccnn_last[j];
    for (times = 0; times < 50; times++) {
        double largest = 0.0;
        ccnn_gap(found, wanted, gap);
        for (j = 0; j < CCNN_JOINTS; j++) {
            const double kept = found[j];
            found[j] = kept + 1e-6;
            ccnn_gap(found, wanted, moved);
            found[j] = kept;
            for (i = 0; i < CCNN_ROWS; i++) slope[i][j] = (moved[i] - gap[i]) / 1e-6;
        }
        for (j = 0; j < CCNN_JOINTS; j++) {
            for (k = 0; k <= CCNN_JOINTS; k++) {
                normal[j][k] = j == k ? 1e-10 : 0.0;
                for (i = 0; i < CCNN_ROWS; i++) normal[j][k] += slope[i][j] * (k < CCNN_JOINTS ? slope[i][k] : gap[i]);
            }
        }
        for (k = 0; k < CCNN_JOINTS; k++) {
            for (j = k + 1; j < CCNN_JOINTS; j++) {
                const double share = normal[j][k] / normal[k][k];
                for (i = k; i <= CCNN_JOINTS; i++) normal[j][i] -= share * normal[k][i];
            }
        }
        for (j = CCNN_JOINTS - 1; j >= 0; j--) {
            step[j] = normal[j][CCNN_JOINTS];
            for (k = j + 1; k < CCNN_JOINTS; k++) step[j] -= normal[j][k] * step[k];
            step[j] /= normal[j][j];
            if (!(fabs(step[j]) < 1e3)) return -1;
            largest = fabs(step[j]) > largest ? fabs(step[j]) : largest;
        }
        for (j = 0; j < CCNN_JOINTS; j++) found[j] -= step[j] * (largest > 0.5 ? 0.5 / largest : 1.0);
        if (largest < 1e-12) break;
    }
    ccnn_gap(found, wanted, gap);
    for (i = 0; i < CCNN_ROWS; i++) left = fabs(gap[i]) > left || gap[i] != gap[i] ? fabs(gap[i]) : left;
    if (!(left < 1e-9)) return -1;
    for (j = 0; j < CCNN_JOINTS; j++) ccnn_last[j] = found[j];
    return 0;
}

@WAYS@
int kinematicsInverse(const EmcPose *world, double *joint, const KINEMATICS_INVERSE_FLAGS *iflags,
                      KINEMATICS_FORWARD_FLAGS *fflags)
{
    double ideal[CCNN_JOINTS], command[CCNN_JOINTS], deviation[CCNN_JOINTS];
    int j;
    (void)iflags;
    (void)fflags;
    if (ccnn_joints_of(world, ideal) != 0) {
        ccnn_state = -1;
        return -1;
    }
    ccnn_state = ccnn_compensate(ideal, ccnn_covariates, command, deviation);
    for (j = 0; j < CCNN_JOINTS; j++) joint[j] = command[j] * ccnn_units[j];
    return 0;
}

int kinematicsForward(const double *joint, EmcPose *world, const KINEMATICS_FORWARD_FLAGS *fflags,
                      KINEMATICS_INVERSE_FLAGS *iflags)
{
    double command[CCNN_JOINTS], ideal[CCNN_JOINTS];
    int j;
    (void)fflags;
    (void)iflags;
    for (j = 0; j < CCNN_JOINTS; j++) command[j] = joint[j] / ccnn_units[j];
    ccnn_ideal(command, ccnn_covariates, ideal);
    return ccnn_pose_of(ideal, world);
}

KINEMATICS_TYPE kinematicsType(void)
{
    return KINEMATICS_BOTH;
}

KINS_NOT_SWITCHABLE
EXPORT_SYMBOL(kinematicsType);
EXPORT_SYMBOL(kinematicsForward);
EXPORT_SYMBOL(kinematicsInverse);

FUNCTION(serve)
{
    state = ccnn_state;
@READ@}
"""

# Where the parameters of the kinematics are corrected themselves.
NOTHING = """static int ccnn_compensate(const double joints[], const double covariates[], double command[],
                           double deviation[])
{
    int j;
    (void)covariates;
    for (j = 0; j < CCNN_JOINTS; j++) {
        command[j] = joints[j];
        deviation[j] = 0.0;
    }
    return 0;
}

static int ccnn_ideal(const double command[], const double covariates[], double joints[])
{
    double nothing[CCNN_JOINTS];
    return ccnn_compensate(command, covariates, joints, nothing);
}
"""

# A machine whose joints follow from its pose.
ONE_WAY = """static void ccnn_gap(const double at[], const double wanted[], double gap[])
{
    int j;
    ccnn_nominal(at, gap);
    for (j = 0; j < CCNN_JOINTS; j++) gap[j] -= wanted[j];
}

static void ccnn_from_world(const EmcPose *world, double pose[]);
static void ccnn_to_world(const double pose[], EmcPose *world);

static int ccnn_joints_of(const EmcPose *world, double joints[])
{
    double pose[CCNN_JOINTS];
    int j;
    ccnn_from_world(world, pose);
    ccnn_nominal(pose, joints);
    for (j = 0; j < CCNN_JOINTS; j++) {
        if (!(fabs(joints[j]) < 1e6)) return -1;
    }
    return 0;
}

static int ccnn_pose_of(const double joints[], EmcPose *world)
{
    double pose[CCNN_JOINTS];
    if (ccnn_solve(joints, pose) != 0) return -1;
    ccnn_to_world(pose, world);
    return 0;
}

"""

_TURNS = """/* Rotation by roll, pitch and yaw in degrees, row after row. */
static void ccnn_rotation(const EmcPose *world, double turn[])
{
    const double a = world->a / CCNN_DEGREES, b = world->b / CCNN_DEGREES, c = world->c / CCNN_DEGREES;
    turn[0] = cos(c) * cos(b);
    turn[1] = cos(c) * sin(b) * sin(a) - sin(c) * cos(a);
    turn[2] = cos(c) * sin(b) * cos(a) + sin(c) * sin(a);
    turn[3] = sin(c) * cos(b);
    turn[4] = sin(c) * sin(b) * sin(a) + cos(c) * cos(a);
    turn[5] = sin(c) * sin(b) * cos(a) - cos(c) * sin(a);
    turn[6] = -sin(b);
    turn[7] = cos(b) * sin(a);
    turn[8] = cos(b) * cos(a);
}

static void ccnn_angles(const double turn[], EmcPose *world)
{
    world->a = atan2(turn[7], turn[8]) * CCNN_DEGREES;
    world->b = atan2(-turn[6], sqrt(turn[0] * turn[0] + turn[3] * turn[3])) * CCNN_DEGREES;
    world->c = atan2(turn[3], turn[0]) * CCNN_DEGREES;
}

"""

# A pose with a rotation vector.
VECTOR = (
    _TURNS
    + """static void ccnn_from_world(const EmcPose *world, double pose[])
{
    double turn[9], axis[3], sine, angle;
    int k;
    ccnn_rotation(world, turn);
    axis[0] = (turn[7] - turn[5]) / 2.0;
    axis[1] = (turn[2] - turn[6]) / 2.0;
    axis[2] = (turn[3] - turn[1]) / 2.0;
    sine = sqrt(axis[0] * axis[0] + axis[1] * axis[1] + axis[2] * axis[2]);
    angle = atan2(sine, (turn[0] + turn[4] + turn[8] - 1.0) / 2.0);
    for (k = 0; k < 3; k++) pose[3 + k] = axis[k] * (sine > 1e-9 ? angle / sine : 1.0);
    pose[0] = world->tran.x / CCNN_UNITS_PER_METRE;
    pose[1] = world->tran.y / CCNN_UNITS_PER_METRE;
    pose[2] = world->tran.z / CCNN_UNITS_PER_METRE;
}

static void ccnn_to_world(const double pose[], EmcPose *world)
{
    const double x = pose[3], y = pose[4], z = pose[5], angle = sqrt(x * x + y * y + z * z);
    const double s = angle > 1e-9 ? sin(angle) / angle : 1.0;
    const double v = angle > 1e-9 ? (1.0 - cos(angle)) / (angle * angle) : 0.5;
    const double turn[9] = { 1.0 - v * (y * y + z * z), v * x * y - s * z, v * x * z + s * y,
                             v * x * y + s * z, 1.0 - v * (x * x + z * z), v * y * z - s * x,
                             v * x * z - s * y, v * y * z + s * x, 1.0 - v * (x * x + y * y) };
    ccnn_angles(turn, world);
    world->tran.x = pose[0] * CCNN_UNITS_PER_METRE;
    world->tran.y = pose[1] * CCNN_UNITS_PER_METRE;
    world->tran.z = pose[2] * CCNN_UNITS_PER_METRE;
}
"""
)

# An arm: its pose follows from its joints. `wanted` and what ccnn_nominal gives: position, then rotation.
SERIAL_WAY = (
    _TURNS
    + """static void ccnn_gap(const double at[], const double wanted[], double gap[])
{
    static const int row[3] = { 2, 0, 1 }, column[3] = { 1, 2, 0 };
    double here[12];
    int k, m;
    ccnn_nominal(at, here);
    for (k = 0; k < 3; k++) gap[k] = here[k] - wanted[k];
    for (k = 0; k < CCNN_ROWS - 3; k++) {
        /* Vector of the skew part of here * wanted'. */
        double sum = 0.0;
        for (m = 0; m < 3; m++) {
            sum += here[3 + 3 * row[k] + m] * wanted[3 + 3 * column[k] + m];
            sum -= here[3 + 3 * column[k] + m] * wanted[3 + 3 * row[k] + m];
        }
        gap[3 + k] = sum / 2.0;
    }
}

static int ccnn_joints_of(const EmcPose *world, double joints[])
{
    double wanted[12];
    wanted[0] = world->tran.x / CCNN_UNITS_PER_METRE;
    wanted[1] = world->tran.y / CCNN_UNITS_PER_METRE;
    wanted[2] = world->tran.z / CCNN_UNITS_PER_METRE;
    ccnn_rotation(world, wanted + 3);
    return ccnn_solve(wanted, joints);
}

static int ccnn_pose_of(const double joints[], EmcPose *world)
{
    double found[12];
    int k;
    ccnn_nominal(joints, found);
    for (k = 0; k < 12; k++) {
        if (!(fabs(found[k]) < 1e6)) return -1;
    }
    for (k = 0; k < CCNN_JOINTS; k++) ccnn_last[k] = joints[k];
    world->tran.x = found[0] * CCNN_UNITS_PER_METRE;
    world->tran.y = found[1] * CCNN_UNITS_PER_METRE;
    world->tran.z = found[2] * CCNN_UNITS_PER_METRE;
    ccnn_angles(found + 3, world);
    return 0;
}
"""
)

README = """# Compensation in LinuxCNC

`ccnnkins.comp` holds the machine's nominal kinematics and the compensation around them.

1. `sudo halcompile --install ccnnkins.comp` (Debian: linuxcnc-uspace-dev).
2. In the INI file: `[KINS] KINEMATICS = ccnnkins`, `JOINTS = {count}`; lengths in mm, angles in degrees.
3. Axes: {axes}.
4. In the HAL file, after the threads: `addf ccnnkins.serve servo-thread`; `ccnnkins.state` is 0 inside the domain
   of the training rows, 1 outside or where the model broke its limit, 2 where an input is not finite, -1 where the
   pose cannot be reached. Link covariates to the pins `ccnnkins.in-NAME` (SI units).
5. Searches (forward kinematics of a parallel machine, inverse kinematics of an arm) start where the last one ended, at
   first in the middle of the workspace.
"""
