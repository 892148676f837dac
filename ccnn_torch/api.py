"""The main jobs, each as one Python call."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ccnn_torch.calibration.calibrate import Calibration, calibrate as _calibrate
from ccnn_torch.calibration.config import RunConfig
from ccnn_torch.calibration.prepare import prepare
from ccnn_torch.compensation import load_compensation
from ccnn_torch.config.split import given_records, name_given
from ccnn_torch.diagnosis.config import DiagnoseConfig
from ccnn_torch.identification.config import IdentifyConfig
from ccnn_torch.identification.identify import Identification, identify as _identify
from ccnn_torch.motion import MotionDiagnosis
from ccnn_torch.motion.job import diagnosed
from ccnn_torch.report.results.verify import SinceResults, VerifyResults
from ccnn_torch.study.sweep import Row, load_sweep, run_sweep
from ccnn_torch.verification.job import verify_model
from ccnn_torch.verification.since import what_changed


def calibrate(**keys: Any) -> Calibration:
    """Train on measured records or on a case study, judge on held-out rows; nothing is written.

    Args:
        keys: those of a config (`ccnn keys` lists them); `records` may also be a pandas DataFrame with headers
            ``name[unit]``, or what `load_records` gave. For example `records="robot.csv", mechanism="robot.yaml"`,
            `case="tripod"`, `seed=3`, `split={"kind": "group"}`, `ccnn={"generations": 200}`.

    Returns:
        A `Calibration`: `results` (as in results.json), `compensator()`, `mechanism()`, `save(folder)`.

    Raises:
        InputError: a key, the records or the mechanism cannot be used; the sentence says what to change.
    """
    given = given_records(keys.get("records"))
    if given is None:
        return _calibrate(RunConfig.from_keys(**keys))
    config = RunConfig.from_keys(**{**keys, "records": name_given(given)})
    config = config.model_copy(update={"records": name_given(given)})
    return _calibrate(config, prepared=prepare(config, given))


def diagnose_motion(**keys: Any) -> MotionDiagnosis:
    """Diagnose logs of a machine in motion; nothing is written.

    Args:
        keys: those of `ccnn diagnose`, for example `motion=["sine.csv", "steps.csv"], mechanism="servo",
            mechanism_keys={"gain": 0.9, "mass": 0.49, "length": 0.1}, effects=["delay", "coulomb"]`.

    Returns:
        A `MotionDiagnosis`; its `content` is that of diagnosis.json.

    Raises:
        InputError: a key, the logs or the model cannot be used; the sentence says what to change.
    """
    return diagnosed(DiagnoseConfig.from_keys(**keys))


def identify(**keys: Any) -> Identification:
    """Identify geometric parameters from measured records or simulated machines; nothing is written.

    Args:
        keys: those of a config (`ccnn identify --keys` lists them); `records` may also be a pandas DataFrame with
            headers ``name[unit]``, or what `load_records` gave. For example `mechanism="five_bar",
            simulate={"machines": 10, "poses": 36}`, or `mechanism="arm.yaml", records="measured.csv", methods=["lm"]`.

    Returns:
        An `Identification`: `results` (as in identified.json), `mechanism()`, `save(folder)`.

    Raises:
        InputError: a key, the records or the mechanism cannot be used; the sentence says what to change.
    """
    given = given_records(keys.get("records"))
    if given is None:
        return _identify(IdentifyConfig.from_keys(**keys))
    config = IdentifyConfig.from_keys(**{**keys, "records": name_given(given)})
    return _identify(config.model_copy(update={"records": name_given(given)}), given=given)


def sweep(config: str | Path | None, *changes: str, out: str | Path, engine: str = "local") -> list[Row]:
    """Run a config with every combination of some keys' values, as `ccnn sweep`.

    Args:
        config: a YAML config; None for defaults.
        changes: `key=a,b,c` for a key that varies, `key=value` for all jobs.
        out: folder, with `sweep.csv` and one run folder a job; finished jobs in it are kept.
        engine: `local`, `processes`, `dask`, or the address of a Dask scheduler, `tcp://HOST:PORT`.

    Returns:
        A row for each job: its name, its keys, the best method and its figures in SI; `failed` has the reason of a job
        without figures.

    Raises:
        InputError: a key or value cannot be used, or the folder holds other runs.
        MethodFailedError: not a single job could be run.
    """
    return run_sweep(load_sweep(config, [*changes, f"engine={engine}"], out), quiet=True)[1]


def verify(
    model: str | Path,
    records: Any,
    mechanism: str | None = None,
    compensated: bool = False,
    refit_frames: bool = False,
    allow_code: bool = False,
    public_key: str | Path | None = None,
) -> VerifyResults:
    """Test a model on new rows, against the error promised by its held-out rows; nothing is written.

    Args:
        model: a .safetensors or .onnx file, or identified.yaml.
        records: new rows, as `load_records` takes them.
        mechanism: name or file; the one that the model names when None.
        compensated: the machine was commanded by the model while it was measured; the joints are then those wanted.
        refit_frames: the measuring device was moved since the model was made.
        allow_code: run the Python file that the model names for a user's own mechanism.
        public_key: PEM file with an Ed25519 key, by which the model must be signed.

    Returns:
        The content of verify.json; its `kept` says whether the promise is kept.

    Raises:
        InputError: the model or the rows cannot be used; the sentence says what to change.
    """
    loaded = load_compensation(model, public_key=public_key, allow_code=allow_code)
    return verify_model(loaded, records, mechanism, compensated, refit_frames, allow_code=allow_code)[0]


def since(
    model: str | Path,
    records: Any,
    mechanism: str | None = None,
    allow_code: bool = False,
    public_key: str | Path | None = None,
    seed: int = 0,
) -> SinceResults:
    """What changed on a machine since its model was made, from ten new rows or so; nothing is written.

    Args:
        model, records, mechanism, allow_code, public_key: as for `verify`; the rows are of the uncompensated machine.
        seed: of the poses that are proposed.

    Returns:
        The content of since.json; its `changed` lists what changed, with its numbers.

    Raises:
        InputError: the model or the rows cannot be used; the sentence says what to change.
    """
    loaded = load_compensation(model, public_key=public_key, allow_code=allow_code)
    return what_changed(loaded, records, mechanism, allow_code=allow_code, seed=seed)[0]
