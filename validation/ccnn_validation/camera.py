"""A six-axis arm calibrated by a camera on its hand over a printed board, judged on the true machine.

`python -m ccnn_validation.camera [--seed N] [--machines N]`. True arm, camera and lens are simulated here, in numpy,
and share no code with the package; beside it stands a plain SciPy fit of the same rows with the same unknowns. Both are
asked for pixels of images that were held out, and for commands to new poses of the camera: ours by the written file.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from ccnn_torch.api import identify
from ccnn_torch.compensation import load_compensation

Array = NDArray[np.float64]
# Denavit-Hartenberg parameters as drawn: a, alpha, d, theta [m, rad], and what a machine as built is off by.
DRAWN = np.array(
    [
        [0, -0.6127, -0.5716, 0, 0, 0],
        [np.pi / 2, 0, 0, np.pi / 2, -np.pi / 2, 0],
        [0.1273, 0, 0, 0.163941, 0.1157, 0.0922],
        np.zeros(6),
    ]
)
OFF = np.array([[0.5e-3], [1e-3], [0.5e-3], [3e-3]])
# By what the links of the plain fit are held: the default tolerance of `ccnn identify`, 1 mm and 10 mrad.
PRIOR = np.repeat([1e-3, 1e-2, 1e-3, 1e-2], 6)
CAMERA, BOARD = np.array([0.1, -0.05, 0.3, 0.03, 0.05, 0.08]), np.array([0.02, 0.01, 0.4, -0.7, -0.15, 0.05])
# Focal lengths and centre [pixels], radial distortion: true, and as the data sheet has them.
LENS, SHEET = np.array([905, 903, 646, 362, -0.08, 0.03]), np.array([900, 900, 640, 360, 0, 0])
CORNERS = np.array([[i * 0.03, j * 0.03, 0] for i in range(6) for j in range(5)])
NOISE = 0.2
TRAINING, HELD_OUT, NEW = 45, 15, 60
# Weight of orientation against position where a pose is not quite reached [m/rad].
TURN = 0.3
FILE = """dof: 6
convention: standard Denavit-Hartenberg
units: {{length: m, angle: rad}}
a: {0}
alpha: {1}
d: {2}
theta: {3}
base_frame: unknown
tool_frame: unknown
"""


def frame(twist: Array) -> Array:
    """Rotation vector and place as `4 x 4`."""
    at = np.eye(4)
    at[:3, :3], at[:3, 3] = Rotation.from_rotvec(twist[:3]).as_matrix(), twist[3:]
    return at


def flanges(joints: Array, links: Array) -> Array:
    """Flanges in the arm's base, `s x 4 x 4`; joints `s x 6`, links `4 x 6`."""
    at = np.broadcast_to(np.eye(4), (len(joints), 4, 4))
    for q, a, alpha, d, theta in zip(joints.T, *links, strict=True):
        c, s, ca, sa = np.cos(q + theta), np.sin(q + theta), np.cos(alpha), np.sin(alpha)
        none, one = 0 * c, 1 + 0 * c
        rows = [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [none, sa * one, ca * one, d * one]]
        link = np.array([*rows, [none, none, none, one]]).transpose(2, 0, 1)
        at = at @ link
    return at


def pixels(cameras: Array, points: Array, lens: Array) -> Array:
    """Where cameras `s x 4 x 4` see points `s x 3`, all in the board's frame; `s x 2`."""
    seen = np.einsum("sji,sj->si", cameras[:, :3, :3], points - cameras[:, :3, 3])
    ratio = seen[:, :2] / seen[:, 2:]
    square = (ratio**2).sum(1, keepdims=True)
    found: Array = ratio * (1 + lens[4] * square + lens[5] * square**2) * lens[:2] + lens[2:4]
    return found


def gap(there: Array, wanted: Array) -> Array:
    """From one pose to another, `6`: place [m], rotation vector [rad]."""
    turn = Rotation.from_matrix(there[:3, :3] @ wanted[:3, :3].T).as_rotvec()
    return np.concatenate([there[:3, 3] - wanted[:3, 3], turn])


def images(rng: np.random.Generator, links: Array, count: int) -> Array:
    """Rows of images: number of the image, joints, corner of the board, pixel; `s x 12`."""
    middle, board, mount = frame(BOARD)[:3] @ [*CORNERS.mean(0), 1], np.linalg.inv(frame(BOARD)), frame(CAMERA)
    found: list[Array] = []
    while len(found) < count:
        # A camera over the board that looks at it.
        eye = middle + rng.uniform([-0.25, -0.25, 0.3], [0.25, 0.25, 0.55])
        ahead = middle + rng.normal(0, 0.03, 3) - eye
        ahead /= np.linalg.norm(ahead)
        right = np.cross(rng.normal(size=3), ahead)
        right /= np.linalg.norm(right)
        wanted = np.eye(4)
        wanted[:3] = np.stack([right, np.cross(ahead, right), ahead, eye], 1)
        start = np.array([0, -1.2, 1.6, -1.9, -1.57, 0]) + rng.normal(0, 0.3, 6)
        flange = wanted @ np.linalg.inv(mount)
        near = least_squares(lambda q, flange=flange: gap(flanges(q[None], DRAWN)[0], flange), start)
        joints = np.arctan2(np.sin(near.x), np.cos(near.x))
        camera = board @ flanges(joints[None], links) @ mount
        uv = pixels(np.repeat(camera, len(CORNERS), 0), CORNERS, LENS)
        inside = ((uv > 0) & (uv < [1280, 720])).all(1)
        if near.cost > 1e-12 or inside.sum() < 8:
            continue
        uv = uv[inside] + rng.normal(0, NOISE, (inside.sum(), 2))
        found.append(np.c_[np.full(len(uv), len(found)), np.tile(joints, (len(uv), 1)), CORNERS[inside], uv])
    return np.concatenate(found)


def cameras_of(found: Array, joints: Array) -> Array:
    """Cameras in the board's frame by the unknowns `42`: links, base in the board's frame, mount, lens."""
    return frame(found[24:30]) @ flanges(joints, DRAWN + found[:24].reshape(4, 6)) @ frame(found[30:36])


def by_scipy(rows: Array, rng: np.random.Generator) -> Array:
    """The unknowns by least squares with weak priors, as one would write it in an hour; from a mount and a board that
    were measured with a tape, 2 cm and 30 mrad off."""

    def left(found: Array) -> Array:
        seen = pixels(cameras_of(found, rows[:, 1:7]), rows[:, 7:10], found[36:])
        whole: Array = np.r_[((seen - rows[:, 10:]) / NOISE).ravel(), found[:24] / PRIOR]
        return whole

    base = np.linalg.inv(frame(BOARD))
    placed = np.r_[Rotation.from_matrix(base[:3, :3]).as_rotvec(), base[:3, 3], CAMERA]
    tape = rng.normal(0, np.tile([0.03, 0.03, 0.03, 0.02, 0.02, 0.02], 2))
    start = np.r_[np.zeros(24), placed + tape, SHEET]
    answer: Array = least_squares(left, start, x_scale="jac", max_nfev=200).x
    return answer


def by_package(folder: Path, rows: Array, held: Array, wanted: Array, near: Array) -> tuple[float, Array, Array]:
    """Held-out pixels, commands to wanted poses `s x 4 x 4` by the written file, and those of the drawing with the same
    frames; near: joints `s x 6`."""
    header = [f"q{i + 1}[rad]" for i in range(6)] + [f"board_{axis}[m]" for axis in "xyz"] + ["u[px]", "v[px]"]
    for name, table in (("training", rows), ("held", held)):
        np.savetxt(folder / f"{name}.csv", table[:, 1:], "%.12g", ",", header=",".join(header), comments="")
    (folder / "arm.yaml").write_text(FILE.format(*DRAWN.tolist()))
    fx, _, cx, cy, *_ = SHEET.tolist()
    found = identify(
        mechanism="instrument",
        mechanism_keys={"mechanism": str(folder / "arm.yaml"), "kind": "camera", "fx": fx, "cx": cx, "cy": cy},
        records=str(folder / "training.csv"),
        split={"test": str(folder / "held.csv")},
        noise=f"{NOISE} px",
        save_report=False,
    )
    found.save(folder / "found")
    model = load_compensation(folder / "found" / "identified.yaml")
    assert model.machine is not None
    turns = Rotation.from_matrix(wanted[:, :3, :3]).as_rotvec()
    poses = torch.from_numpy(np.c_[wanted[:, :3, 3], turns])
    ideal = model.machine.nominal.solve_inverse(poses, guess=torch.from_numpy(near)).numpy()
    return 1e6 * found.results["test"]["position"]["after"], model(ideal)["command"], ideal


def judged(seed: int) -> dict[str, tuple[float, float, float]]:
    """Of one machine, by who calibrated it: held-out pixels, and error of the true camera at new poses [mm], [mrad]."""
    rng = np.random.default_rng(seed)
    links = DRAWN + OFF * rng.normal(size=(4, 6))
    rows = images(rng, links, TRAINING + HELD_OUT)
    held, rows = rows[rows[:, 0] >= TRAINING], rows[rows[:, 0] < TRAINING]
    stood = np.unique(rows[:, 1:7], axis=0)
    one, other = stood[rng.integers(len(stood), size=(2, NEW))]
    near = one + 0.15 * (other - one)
    board, mount = np.linalg.inv(frame(BOARD)), frame(CAMERA)
    wanted = board @ flanges(near, links) @ mount

    def off(commands: Array) -> tuple[float, float]:
        there = board @ flanges(commands, links) @ mount
        gaps = np.array([gap(*pair) for pair in zip(there, wanted, strict=True)])
        size = [np.sqrt((gaps[:, part] ** 2).sum(1).mean()) for part in (slice(3), slice(3, 6))]
        return 1e3 * float(size[0]), 1e3 * float(size[1])

    plain = by_scipy(rows, rng)
    weight = np.array([1, 1, 1, TURN, TURN, TURN])
    sent = [
        least_squares(lambda q, w=w: weight * gap(cameras_of(plain, q[None])[0], w), q).x
        for q, w in zip(near, wanted, strict=True)
    ]
    left = pixels(cameras_of(plain, held[:, 1:7]), held[:, 7:10], plain[36:]) - held[:, 10:]
    with TemporaryDirectory() as folder:
        ours, commands, drawn = by_package(Path(folder), rows, held, wanted, near)
    pixel = float(np.sqrt((left**2).sum(1).mean()))
    return {
        "links as drawn": (np.nan, *off(drawn)),
        "SciPy": (pixel, *off(np.array(sent))),
        "ours": (ours, *off(commands)),
    }


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--machines", type=int, default=5)
    given = options.parse_args()
    found = []

    def tell(what: str, values: Array) -> None:
        held = "" if np.isnan(values[0]) else f"held out {values[0]:6.3f} px   "
        print(f"{what:<28} {held:<22} new poses {values[1]:7.4f} mm {values[2]:7.4f} mrad", flush=True)

    for seed in range(given.seed, given.seed + given.machines):
        found.append(judged(seed))
        for what, values in found[-1].items():
            tell(f"machine {seed}, {what}", np.array(values))
    for what in found[0]:
        tell(f"median, {what}", np.median([one[what] for one in found], axis=0))


if __name__ == "__main__":
    main()
