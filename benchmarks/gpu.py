"""`python -m benchmarks.gpu [PART ...] [--quick]`: the same work on the processor and on the CUDA card, side by side.

Wall-clock seconds, the median of the rounds; the card is waited for before the clock is read. Prints the table of
docs/benchmarks.md. "waits" are the operations of one call that made the processor wait for the card.
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import torch

from benchmarks.fitness import ROWS, SIZES, networks
from benchmarks.generation import toy_rows
from ccnn_torch.calibration.early_stop import moved
from ccnn_torch.evolution import CCNNSettings
from ccnn_torch.evolution.coevolution import advance, make_task, network_errors, start
from ccnn_torch.learners import LEARNERS, TrainingData
from ccnn_torch.numerics.trees import mapped
from ccnn_torch.training import train

CARD = "cuda"
Line = tuple[str, str, float, float, int, float]
"""Task, size, seconds of the processor and of the card, waits, largest difference between the results."""


def seconds_on(device: str, call: Callable[[], Any], rounds: int) -> float:
    """Wall-clock seconds of a call, the median; the first, which compiles and allocates, does not count."""
    times = []
    for _ in range(rounds + 1):
        began = time.perf_counter()
        call()
        if device == CARD:
            torch.cuda.synchronize()
        times.append(time.perf_counter() - began)
    return statistics.median(times[1:])


def waits_of(call: Callable[[], Any]) -> int:
    """Operations of a call that make the processor wait for the card."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        call()
        torch.cuda.set_sync_debug_mode("default")
    return sum("synchron" in str(one.message) for one in said)


def of_fitness(quick: bool) -> Iterator[Line]:
    """Errors of so many joined networks."""
    inputs, targets = (torch.from_numpy(part)[None] for part in toy_rows(SIZES, ROWS))
    for count in (1000, 10_000) if quick else (1000, 10_000, 100_000, 1_000_000):
        seconds, results = {}, {}
        for device in ("cpu", CARD):
            layers = mapped(lambda value, device=device: value.to(device), networks(count))
            task = make_task(inputs.to(device), targets.to(device), torch.ones(1, ROWS, dtype=torch.float64).to(device))
            call = partial(network_errors, layers, task)
            seconds[device], results[device] = seconds_on(device, call, 3), call().cpu()
        far = float((results["cpu"] - results[CARD]).abs().max())
        size = f"{count:,} networks {'-'.join(map(str, SIZES))}, {ROWS} rows"
        yield "fitness", size, seconds["cpu"], seconds[CARD], waits_of(call), far


def of_generation(quick: bool) -> Iterator[Line]:
    """One generation of the coevolution."""
    rows = [torch.from_numpy(part) for part in toy_rows(SIZES, ROWS)]
    for population, repeats in ((80, 1),) if quick else ((80, 1), (80, 32), (800, 1), (8000, 1), (80_000, 1)):
        settings = CCNNSettings(hidden=tuple(SIZES[1:-1]), population=population, generations=120)
        seconds, best = {}, {}
        for device in ("cpu", CARD):
            inputs, targets = (part.expand(repeats, -1, -1).to(device) for part in rows)
            task = make_task(inputs, targets, torch.ones(repeats, ROWS, dtype=torch.float64, device=device))
            seeds = torch.arange(repeats, device=device)
            first = start(SIZES, task, settings, seeds)
            call = partial(advance, first, task, settings, seeds)
            seconds[device], best[device] = seconds_on(device, call, 3), call().best_fitness.cpu()
        far = float((best["cpu"] - best[CARD]).abs().max())
        size = f"3 x {population:,} individuals, {repeats} repeats"
        yield "generation", size, seconds["cpu"], seconds[CARD], waits_of(call), far


def of_learners(quick: bool) -> Iterator[Line]:
    """A whole training of each learner with its defaults; the difference is of the error on rows not trained on."""
    count = 200 if quick else 2000
    x = 2 * torch.rand(1, 2 * count, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 1
    y = torch.stack([(3 * x[..., 0]).sin() * x[..., 1], x[..., 2].square() - x[..., 3], (2 * x[..., 4]).cos()], -1)
    y = (y - y.mean(1, keepdim=True)) / y.std(1, keepdim=True)
    weights = torch.ones(1, count, dtype=torch.float64)
    data = TrainingData(x[:, :count], y[:, :count], weights, torch.zeros(1, dtype=torch.int64))
    for name in LEARNERS:
        seconds, errors = {}, {}
        for device in ("cpu", CARD):
            here, unseen = moved(data, device), x[:, count:].to(device)
            learner = LEARNERS[name]()
            began = time.perf_counter()
            train(learner, here)
            said = learner.predict(unseen).cpu()
            seconds[device] = time.perf_counter() - began
            errors[device] = float((said - y[:, count:]).square().mean().sqrt())
        far = abs(errors[CARD] / errors["cpu"] - 1)
        yield f"training of {name}", f"{count:,} rows, 6 inputs, 3 outputs", seconds["cpu"], seconds[CARD], -1, far


def of_run(quick: bool) -> Iterator[Line]:
    """`ccnn run` as a command; the difference is of the held-out error, as a share."""
    for config, *keys in (("tripod.yaml", f"repeats={2 if quick else 30}"), ("ur10.yaml",)):
        seconds, errors = {}, {}
        for device in ("cpu", CARD):
            with tempfile.TemporaryDirectory() as folder:
                command = ["run", f"experiments/{config}", *keys, f"device={device}", f"out={folder}/run", "--quiet"]
                began = time.perf_counter()
                subprocess.run([sys.executable, "-m", "ccnn_torch", *command], check=True)
                seconds[device] = time.perf_counter() - began
                result = json.loads((Path(folder) / "run" / "results.json").read_text(encoding="utf-8"))
                errors[device] = result["methods"]["ccnn"]["test"]["all"]["mse"]["median"]
        far = abs(errors[CARD] / errors["cpu"] - 1)
        yield f"ccnn run {config}", " ".join(keys), seconds["cpu"], seconds[CARD], -1, far


PARTS = {"fitness": of_fitness, "generation": of_generation, "learners": of_learners, "run": of_run}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gpu", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="small sizes, a minute")
    parser.add_argument("parts", nargs="*", choices=[[], *PARTS], metavar="PART", help=f"of {', '.join(PARTS)}")
    given = parser.parse_args()
    if not torch.cuda.is_available():
        sys.exit("no CUDA card is found here: nothing to compare")
    print(
        f"{torch.cuda.get_device_name()}, torch {torch.__version__}; {torch.get_num_threads()} threads of "
        f"{platform.processor() or platform.machine()}\n"
    )
    print("| task | size | processor [s] | card [s] | ratio | waits | largest difference |")
    print("| --- | --- | ---: | ---: | ---: | ---: | ---: |")
    for part in given.parts or PARTS:
        for task, size, cpu, card, waits, far in PARTS[part](given.quick):
            told = "" if waits < 0 else str(waits)
            print(f"| {task} | {size} | {cpu:.4f} | {card:.4f} | {cpu / card:.2f} | {told} | {far:.1e} |", flush=True)


if __name__ == "__main__":
    main()
